"""Pretrained tokenizers without the training: random weights in small networks, and their published form."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from hma_jax.config import Magvit2Config, PixelsConfig, SvdVaeConfig
from hma_jax.convert.pretrained import MAGVIT2, SVD_VAE, Source, tokenizer_shapes
from hma_jax.convert.tensors import write_safetensors
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.io import KINDS

MAGVIT2_SMALL = Magvit2Config(image_size=16, channels=4, multipliers=(1, 2), res_blocks=1, bits=6, groups=2)
VAE_SMALL = SvdVaeConfig(image_size=16, channels=(4, 8), layers=1, groups=2)
PIXELS_SMALL = PixelsConfig(image_size=16, patch=4)

OFFICIAL = {
    "magvit2": (MAGVIT2, {"base_channels": 4, "ch_mult": [1, 2], "num_res_blocks": 1, "z_channels": 6,
                          "norm_num_groups": 2, "disc_start": 0}),
    "svd-vae": (SVD_VAE, {"_class_name": "AutoencoderKLTemporalDecoder", "block_out_channels": [4, 8],
                          "layers_per_block": 1, "latent_channels": 4, "norm_num_groups": 2,
                          "scaling_factor": 0.18215, "force_upcast": True}),
}  # fmt: skip
"""What describes the small networks in config.json."""


def make(config: Any, seed: int = 0, piece: int | None = None) -> Tokenizer:
    cls = KINDS[config.kind]
    return cls(config, cls.declare(config).init(seed), piece=piece)


def noise(count: int, size: int = 16, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, size, size, 3), np.uint8)


def official_tensors(kind: str, seed: int = 0) -> dict[str, np.ndarray]:
    source, settings = OFFICIAL[kind]
    rng = np.random.default_rng(seed)
    shapes = small_shapes(source, settings)
    return {name: (0.3 * rng.standard_normal(shape)).astype(np.float32) for name, shape in shapes.items()}


def small_shapes(source: Source, settings: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    config = source.config(settings, "test", image_size=16)
    return tokenizer_shapes(source, source.tokenizer.declare(config))


def write_published(folder: Path, kind: str, **changes: Any) -> Path:
    """A directory as it is published, with config.json."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(OFFICIAL[kind][1] | changes))
    name = "model.safetensors" if kind == "magvit2" else "diffusion_pytorch_model.safetensors"
    write_safetensors(folder / name, official_tensors(kind))
    return folder
