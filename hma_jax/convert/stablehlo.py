"""Generation as a StableHLO program with fixed shapes, that runs where this project is not installed.

model.stablehlo     `jax.export` bytes; jax.export.deserialize(bytes).call(weights, prompt, actions,
                    embodiment, key) -> new frames
model.safetensors   the weights, name -> array
model.json          every input and output, in the order of the program's arguments; and of which model, with its
                    provenance
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from hma_jax.config import ConfigError, DecodeConfig, ExecutionConfig, ModelConfig, Setting, require
from hma_jax.config.json import to_dict, to_plain_json
from hma_jax.convert.atomic import atomic_directory
from hma_jax.convert.neutral import describe_tensors
from hma_jax.convert.table import flat, nested
from hma_jax.convert.tensors import write_safetensors
from hma_jax.generation import rollout
from hma_jax.kernels.random import GENERATOR
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.objective.masking import hidden_at_inference
from hma_jax.training.runs import Run, require_frames

FORMAT, VERSION = "hma-jax-stablehlo", 1
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
PROGRAM, WEIGHTS, DESCRIPTION = "model.stablehlo", "model.safetensors", "model.json"


@dataclass(frozen=True)
class ProgramConfig:
    """The fixed shapes of a program: `batch` examples are continued from `prompt` to `frames` frames."""

    batch: int = 1
    prompt: int = 4
    frames: int = 5
    decode: DecodeConfig = DecodeConfig()
    platforms: tuple[str, ...] = ("cpu", "cuda", "tpu")

    def __post_init__(self):
        require(self.batch >= 1, f"batch must be at least 1, got {self.batch}")
        require(
            1 <= self.prompt < self.frames,
            f"frames must be more than prompt, and prompt at least 1, got frames {self.frames} and prompt "
            f"{self.prompt}",
        )
        unknown = set(self.platforms) - set(PLATFORMS)
        require(
            bool(self.platforms) and not unknown,
            f"platforms {', '.join(self.platforms) or '(none)'}: choose some of {', '.join(PLATFORMS)}",
        )


def generate_function(
    model: ModelConfig, table: EmbodimentTable, setting: Setting, config: ProgramConfig
) -> Callable[..., jax.Array]:
    """generate(weights, prompt, actions, embodiment, key) -> frames prompt .. frames - 1.

    weights: path -> array. prompt int32 [B, T', S] or float32 [B, T', S, C]; actions float32
    [B, T, U], raw and padded with zeros; embodiment int32 [B]; key uint32 [2], of which every row
    of the batch derives its own random numbers. Actions that a model trained for `setting` was never shown are not
    looked at.
    """
    # One program for every platform: none of them may be a single platform's own.
    declared = declare_model(model, table, ExecutionConfig(attention="plain"))

    def generate(weights, prompt, actions, embodiment, key):
        base = jax.random.wrap_key_data(key, impl=GENERATOR)
        keys = jax.vmap(lambda row: jax.random.fold_in(base, row))(jnp.arange(config.batch))
        hma, hidden = declared.merge(nested(weights)), hidden_at_inference(table, setting, embodiment, config.frames)
        return rollout(hma, prompt, actions[:, None], embodiment, keys, config.decode, action_hidden_BT=hidden)[:, 0]

    return generate


def input_shapes(model: ModelConfig, table: EmbodimentTable, config: ProgramConfig) -> dict[str, jax.ShapeDtypeStruct]:
    """The inputs after the weights, in order."""
    b, kind = config.batch, jnp.float32 if model.diffusion else jnp.int32
    return {
        "prompt": jax.ShapeDtypeStruct((b, config.prompt, *model.frame_shape), kind),
        "actions": jax.ShapeDtypeStruct((b, config.frames, table.action_width), jnp.float32),
        "embodiment": jax.ShapeDtypeStruct((b,), jnp.int32),
        "key": jax.ShapeDtypeStruct((2,), jnp.uint32),
    }


def write_stablehlo(run: Run, directory: Path, config: ProgramConfig) -> None:
    """Raises ConfigError if `directory` exists, the model predicts no frames or they do not fit its window."""
    require_frames(run, "generate")
    model, table, masking = run.model, run.table, run.train.masking
    require(
        config.frames <= model.frames,
        f"{config.frames} frames do not fit the model's window of {model.frames}",
    )
    leaves = declare_model(model, table).leaves()
    weights = {path: jax.ShapeDtypeStruct(spec.shape, jnp.float32) for path, spec in leaves.items()}
    inputs = input_shapes(model, table, config)
    with atomic_directory(directory) as temporary:
        program = jax.jit(generate_function(model, table, masking.setting, config))
        exported = export.export(program, platforms=config.platforms)(weights, *inputs.values())
        (temporary / PROGRAM).write_bytes(exported.serialize())
        write_safetensors(temporary / WEIGHTS, {path: np.asarray(x) for path, x in flat(run.params).items()})
        description = _describe(run, config, inputs, exported)
        (temporary / DESCRIPTION).write_text(to_plain_json(description))


MEANINGS = {
    "prompt": "frames to continue: token ids, or latent patches",
    "actions": "raw action chunks of all frames, padded with zeros; chunk t is executed after frame t. Not looked at where "
    "the robot has none in `table`, or the model was trained without",
    "embodiment": "index of each example's robot in `table`",
    "key": "any two numbers, as jax.random.key_data gives them; row i of the batch draws with fold_in(key, i)",
}


def _describe(
    run: Run, config: ProgramConfig, inputs: dict[str, jax.ShapeDtypeStruct], exported: export.Exported
) -> dict[str, Any]:
    tensors = describe_tensors(declare_model(run.model, run.table).leaves())

    def of_array(x: jax.ShapeDtypeStruct) -> dict[str, Any]:
        return {"shape": list(x.shape), "dtype": x.dtype.name}

    order = [
        {"name": f"weights/{name}", "shape": t["shape"], "dtype": "float32"} for name, t in sorted(tensors.items())
    ]
    order += [{"name": name, **of_array(x), "meaning": MEANINGS[name]} for name, x in inputs.items()]
    if [tuple(i["shape"]) for i in order] != [a.shape for a in exported.in_avals]:
        raise ConfigError("the program's arguments are not in the order of their description")
    frames = {"name": "frames", **of_array(exported.out_avals[0]), "meaning": "the frames after the prompt"}
    return {
        "format": FORMAT,
        "version": VERSION,
        "call": "jax.export.deserialize(bytes).call(weights, prompt, actions, embodiment, key)",
        "calling_convention_version": exported.calling_convention_version,
        "jax": jax.__version__,
        "step": run.step,
        "weights": run.weights,
        "setting": run.train.masking.setting,
        "provenance": run.provenance,  # the tokenizer, where it is known
        "program": to_dict(config),
        "model": to_dict(run.model),
        "table": to_dict(run.table),
        "inputs": order,
        "outputs": [frames],
        "tensors": tensors,
    }
