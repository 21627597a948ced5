"""Official checkpoints made here: random tensors of the right shapes, for any robots."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hma_jax.convert.official import official_shapes
from hma_jax.convert.official_config import CONTINUOUS_DEFAULTS, DISCRETE_DEFAULTS, read_model
from hma_jax.convert.tensors import write_safetensors
from hma_jax.model.embodiments import Embodiment, EmbodimentTable

SMALL = {"d_model": 16, "num_layers": 2, "num_heads": 2, "T": 3, "action_token_size": 2, "use_mup": True}
DISCRETE = DISCRETE_DEFAULTS | SMALL | {"S": 4, "image_vocab_size": 64, "num_factored_vocabs": 2}
CONTINUOUS = CONTINUOUS_DEFAULTS | SMALL | {"S": 16, "patch_size": 2, "diffloss_w": 8, "diffloss_d": 1}
CONTINUOUS |= {"qkv_bias": True, "mlp_bias": False, "image_vocab_size": None}

Robots = Sequence[tuple[str, int, int]]
"""(name, action dimensions, stride)."""


def official_config(base: dict[str, Any], robots: Robots, **changes: Any) -> dict[str, Any]:
    return base | {
        "qk_norm": False,
        "action_network": "concat+modulate",
        "init_actions": True,
        "action_domains": [name for name, _, _ in robots],
        "d_actions": [dim * stride for _, dim, stride in robots],
        "action_stats": [[[0.1 * k for k in range(dim)], [1.5] * dim] for _, dim, _ in robots],
        "a_field_of_the_future": {"kept": True},
        **changes,
    }


def random_tensors(config: dict[str, Any], robots: Robots) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    plain = [Embodiment(name, dim, stride, (0.0,) * dim, (1.0,) * dim) for name, dim, stride in robots]
    shapes = official_shapes(read_model(config, "config"), EmbodimentTable(tuple(plain)))
    tensors = {name: rng.standard_normal(shape).astype(np.float32) for name, shape in shapes.items()}
    for robot, (mean, std) in zip(config["action_domains"], config["action_stats"], strict=True):
        tensors[f"action_preprocessor.{robot}.mean"] = np.float32(mean)
        tensors[f"action_preprocessor.{robot}.std"] = np.float32(std)
    return tensors


def write_checkpoint(folder: Path, config: dict[str, Any], tensors: dict[str, np.ndarray]) -> Path:
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(config))
    write_safetensors(folder / "model.safetensors", tensors)
    return folder


def make_checkpoint(folder: Path, base: dict[str, Any], robots: Robots, **changes: Any) -> Path:
    config = official_config(base, robots, **changes)
    return write_checkpoint(folder, config, random_tensors(config, robots))
