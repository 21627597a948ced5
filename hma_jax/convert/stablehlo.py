"""Generation as a StableHLO program with fixed shapes, which runs without this project installed.

model.stablehlo     `jax.export` bytes; jax.export.deserialize(bytes).call(weights, prompt, actions,
                    embodiment, key) -> new frames
model.safetensors   the weights, name -> array; without action heads, on which no frame depends
model.json          every input and output, in the order of the program's arguments; and of which model, with its
                    provenance
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import export

from hma_jax.config import ConfigError, DecodeConfig, Dtype, ExecutionConfig, MaskingSetting, ModelConfig, require
from hma_jax.config.json import to_dict, to_plain_json
from hma_jax.convert.atomic import atomic_directory
from hma_jax.convert.neutral import describe_tensors
from hma_jax.convert.run_directory import require_run
from hma_jax.convert.table import flat, nested
from hma_jax.convert.tensors import write_safetensors
from hma_jax.generation import rollout
from hma_jax.kernels.random import GENERATOR
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.model.params import inference_params
from hma_jax.objective.masking import hidden_at_inference
from hma_jax.training.runs import Run, require_frames

FORMAT, VERSION = "hma-jax-stablehlo", 1
PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
PROGRAM, WEIGHTS, DESCRIPTION = "model.stablehlo", "model.safetensors", "model.json"


@dataclass(frozen=True)
class ProgramConfig:
    """The fixed shapes of a program: `batch` examples are continued from `prompt` to `frames` frames. Past the model's
    window of T frames the window slides, as `decode.slide` says."""

    batch: int = 1
    prompt: int = 4
    frames: int = 5
    decode: DecodeConfig = DecodeConfig()
    platforms: tuple[str, ...] = ("cpu", "cuda", "tpu")
    dtype: Dtype = "float32"  # number format of the computation, and of the weights, which are cast to it

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
    model: ModelConfig, table: EmbodimentTable, setting: MaskingSetting, config: ProgramConfig
) -> Callable[..., jax.Array]:
    """generate(weights, prompt, actions, embodiment, key) -> frames prompt .. frames - 1.

    weights: path -> array. prompt int32 [B, T', S] or float32 [B, T', S, C]; actions float32
    [B, T, U], raw and padded with zeros; embodiment int32 [B]; key uint32 [2], from which every row of the batch
    derives its own random numbers. Actions that a model trained for `setting` was never shown are ignored.
    """
    # One program for all platforms, so no kernel may be specific to one of them.
    declared = declare_model(model, table, ExecutionConfig(config.dtype, attention="plain"))

    def generate(weights, prompt, actions, embodiment, key):
        base = jax.random.wrap_key_data(key, impl=GENERATOR)
        keys = jax.vmap(lambda row: jax.random.fold_in(base, row))(jnp.arange(config.batch))
        hma, hidden = declared.merge(nested(weights)), hidden_at_inference(table, setting, embodiment, config.frames)
        return rollout(hma, prompt, actions[:, None], embodiment, keys, config.decode, action_hidden_BT=hidden)[:, 0]

    return generate


def input_shapes(model: ModelConfig, table: EmbodimentTable, config: ProgramConfig) -> dict[str, jax.ShapeDtypeStruct]:
    """The inputs after the weights, in order."""
    b = config.batch
    return {
        "prompt": jax.ShapeDtypeStruct((b, config.prompt, *model.frame_shape), model.frame_dtype),
        "actions": jax.ShapeDtypeStruct((b, config.frames, table.action_width), jnp.float32),
        "embodiment": jax.ShapeDtypeStruct((b,), jnp.int32),
        "key": jax.ShapeDtypeStruct((2,), jnp.uint32),
    }


def write_stablehlo(run: Run, directory: Path, config: ProgramConfig) -> None:
    """Writes the three files. Raises ConfigError if `directory` exists or the model predicts no frames, and as
    `require_run`."""
    require_run(run)
    require_frames(run, "generate")
    # Most parameters of a continuous model are action heads.
    run = replace(run, model=replace(run.model, action_heads=False))
    model, table, masking = run.model, run.table, run.train.masking
    declared, params = declare_model(model, table), flat(run.params)
    read = nested({path: np.asarray(params[path]) for path in declared.leaves()})
    arrays = flat(inference_params(declared, read, config.dtype))
    weights = {path: jax.ShapeDtypeStruct(x.shape, x.dtype) for path, x in arrays.items()}
    inputs = input_shapes(model, table, config)
    with atomic_directory(directory) as temporary:
        program = jax.jit(generate_function(model, table, masking.setting, config))
        exported = export.export(program, platforms=config.platforms)(weights, *inputs.values())
        (temporary / PROGRAM).write_bytes(exported.serialize())
        write_safetensors(temporary / WEIGHTS, arrays)
        description = _describe(run, config, weights, inputs, exported)
        (temporary / DESCRIPTION).write_text(to_plain_json(description))


MEANINGS = {
    "prompt": "frames to continue: token ids, or latent patches",
    "actions": "raw action chunks of all frames, padded with zeros; chunk t is executed after frame t. Ignored where "
    "the robot has none in `table`, or the model was trained without",
    "embodiment": "index of each example's robot in `table`",
    "key": "any two numbers, as jax.random.key_data gives them; row i of the batch draws with fold_in(key, i)",
}


def _describe(
    run: Run,
    config: ProgramConfig,
    weights: dict[str, jax.ShapeDtypeStruct],
    inputs: dict[str, jax.ShapeDtypeStruct],
    exported: export.Exported,
) -> dict[str, Any]:
    def of_array(x: jax.ShapeDtypeStruct) -> dict[str, Any]:
        return {"shape": list(x.shape), "dtype": x.dtype.name}

    entries = {"embodiment": run.table.size} | ({} if run.model.diffusion else {"prompt": run.model.vocab_size})
    ranges = {name: {"minimum": 0, "maximum": count - 1} for name, count in entries.items()}
    order = [{"name": f"weights/{name}", **of_array(x)} for name, x in sorted(weights.items())]
    order += [
        {"name": name, **of_array(x), **ranges.get(name, {}), "meaning": MEANINGS[name]} for name, x in inputs.items()
    ]
    if [(tuple(i["shape"]), i["dtype"]) for i in order] != [(a.shape, a.dtype.name) for a in exported.in_avals]:
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
        "tensors": describe_tensors(declare_model(run.model, run.table).leaves()),
    }
