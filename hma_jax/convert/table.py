"""The table of which official tensor is which part of which of our parameters, used in both directions.

An entry has the path of one of our parameters, the name of the official tensors that it consists of, and an einops
pattern from one of its slices to the official layout; read backwards, the pattern is the inverse. Along an axis that we
stack (layers N, robots E, factors Q), every index is a separate official tensor if the official name has a placeholder
for it. A robot's slice is cut to its own chunk along U: the rest is padding, which is zero and has no effect. Facts:
reference sections 8.3 and 8.4.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from einops import rearrange
from flax import nnx

from hma_jax.config import ModelConfig
from hma_jax.convert.tensors import Stored, read_finite
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.params import EMBODIMENT_AXIS, LAYER_AXIS, Params, ParamSpec

PLACEHOLDERS = {LAYER_AXIS: "{layer}", EMBODIMENT_AXIS: "{robot}", "Q": "{factor}"}
"""Placeholders in official names, for the index along a stacked axis or the robot's name."""

LINEAR = "i o -> o i"
SAME = "d -> d"


class Entry(NamedTuple):
    path: str  # of our parameter
    official: str  # name of its tensors, with placeholders
    pattern: str  # einops: one slice of our parameter -> the official tensor


def _linear(path: str, official: str) -> tuple[Entry, ...]:
    return (
        Entry(f"{path}/kernel", f"{official}.weight", LINEAR),
        Entry(f"{path}/bias", f"{official}.bias", SAME),
    )


def _norm(path: str, official: str) -> tuple[Entry, ...]:
    return (
        Entry(f"{path}/gain", f"{official}.weight", SAME),
        Entry(f"{path}/bias", f"{official}.bias", SAME),
    )


def _attention(path: str, official: str) -> tuple[Entry, ...]:
    return (
        Entry(f"{path}/qkv", f"{official}.qkv.weight", "d c h i -> (c h i) d"),
        Entry(f"{path}/qkv_bias", f"{official}.qkv.bias", "c h i -> (c h i)"),
        Entry(f"{path}/out", f"{official}.proj.weight", "h i d -> d (h i)"),
        Entry(f"{path}/out_bias", f"{official}.proj.bias", SAME),
        *_norm(f"{path}/norm", f"{official}.norm"),
    )


def _denoiser(path: str, official: str, depth: int) -> tuple[Entry, ...]:
    entries = [
        *_linear(f"{path}/time_in", f"{official}.time_embed.mlp.0"),
        *_linear(f"{path}/time_out", f"{official}.time_embed.mlp.2"),
        *_linear(f"{path}/condition", f"{official}.cond_embed"),
        *_linear(f"{path}/into", f"{official}.input_proj"),
        *_linear(f"{path}/modulation", f"{official}.final_layer.adaLN_modulation.1"),
        Entry(f"{path}/out", f"{official}.final_layer.linear.weight", "f k c -> (k c) f"),
        Entry(f"{path}/out_bias", f"{official}.final_layer.linear.bias", "k c -> (k c)"),
    ]
    for j in range(depth):
        block, official_block = f"{path}/blocks/{j}", f"{official}.res_blocks.{j}"
        entries += _norm(f"{block}/norm", f"{official_block}.in_ln")
        entries += _linear(f"{block}/into", f"{official_block}.mlp.0")
        entries += _linear(f"{block}/out", f"{official_block}.mlp.2")
        entries += _linear(f"{block}/modulation", f"{official_block}.adaLN_modulation.1")
    return tuple(entries)


BLOCK = "trunk/blocks"
LAYER = "decoder.layers.{layer}"
PROJECTOR = LAYER + ".action_projectors.{robot}"

SHARED = (
    Entry("positions", "pos_embed_TSC", "t p d -> 1 t p d"),
    Entry("action_mask", "action_mask_tokens", "t d -> 1 t 1 d"),
    *_linear("stem/into", "action_mlp.{robot}.model.0"),
    *_norm("stem", "action_mlp.{robot}.model.1"),
    *_linear("stem/out", "action_mlp.{robot}.model.3"),
    *_norm(f"{BLOCK}/norm_space", f"{LAYER}.norm1"),
    *_attention(f"{BLOCK}/space", f"{LAYER}.spatial_attn"),
    *_attention(f"{BLOCK}/time", f"{LAYER}.temporal_attn"),
    *_norm(f"{BLOCK}/norm_mlp", f"{LAYER}.norm2"),
    *_linear(f"{BLOCK}/mlp_in", f"{LAYER}.mlp.fc1"),
    *_linear(f"{BLOCK}/mlp_out", f"{LAYER}.mlp.fc2"),
    *_linear("frame_head/linear", "out_x_proj"),
)

DISCRETE = (
    Entry("embed/tables", "token_embed.factored_embeds.{factor}.weight", "v d -> v d"),
    Entry("embed/mask", "token_embed.mask_token_embed", "d -> 1 d"),
    *_linear("action_head/linear", "action_out_projectors.{robot}"),
)

CONTINUOUS = (
    Entry("embed/kernel", "token_embed.weight", LINEAR),
    Entry("embed/mask", "mask_token", "c -> 1 1 c"),
    Entry("frame_head/positions", "diffusion_pos_embed_learned", "t s d -> 1 (t s) d"),
    *_norm("frame_head/norm", "decoder_norm"),
    *_norm("norm", "z_proj_ln"),
)

MODULATION = (
    *_linear(f"{BLOCK}/conditioning/hidden", f"{PROJECTOR}.adaLN_modulation.0"),
    *_linear(f"{BLOCK}/conditioning/shift_scale", f"{PROJECTOR}.adaLN_modulation.2"),
    *_linear(f"{BLOCK}/conditioning/out", f"{PROJECTOR}.linear_out"),
)

CROSS_ATTENTION = (
    *(Entry(f"{BLOCK}/conditioning/{x}", f"{PROJECTOR}.to_{x}.weight", LINEAR) for x in "qkv"),
    *_linear(f"{BLOCK}/conditioning/out", f"{PROJECTOR}.proj"),
    *_norm(f"{BLOCK}/conditioning", f"{PROJECTOR}.norm"),
)


def entries_of(model: ModelConfig) -> dict[str, Entry]:
    """The entry of each of our parameters, by path, including parameters that the model's settings leave out."""
    entries = [*SHARED, *(CROSS_ATTENTION if model.conditioning == "cross_attention" else MODULATION)]
    if model.diffusion:
        depth = model.diffusion.depth
        entries += CONTINUOUS
        entries += _denoiser("denoiser", "diffloss.net", depth)
        entries += _denoiser("action_head/robots", "action_diff_losses.{robot}.net", depth)
    else:
        entries += DISCRETE
    return {entry.path: entry for entry in entries}


# --- One official tensor as a part of one parameter --------------------------------------------


@dataclass(frozen=True)
class Part:
    """`path[index]` is the official tensor `name`, up to `pattern`."""

    name: str
    index: tuple[int | slice, ...]
    sizes: dict[str, int]  # of the slice's axes, by their names in the pattern
    pattern: str

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the official tensor."""
        groups = re.findall(r"\(([^)]*)\)|(\S+)", self.pattern.split(" -> ")[1])
        names = [(group or single).split() for group, single in groups]
        return tuple(math.prod(self.sizes.get(name, 1) for name in axis) for axis in names)

    def to_official(self, parameter: np.ndarray) -> np.ndarray:
        return rearrange(parameter[self.index], self.pattern)

    def from_official(self, tensor: np.ndarray) -> np.ndarray:
        left, right = self.pattern.split(" -> ")
        return rearrange(tensor, f"{right} -> {left}", **self.sizes)


def parts_of(entry: Entry, spec: ParamSpec, table: EmbodimentTable) -> Iterator[Part]:
    """The official tensors of which a parameter consists."""
    stacked = [axis for axis in spec.axes if axis in PLACEHOLDERS and PLACEHOLDERS[axis] in entry.official]
    axes, shape = spec.axes[len(stacked) :], spec.shape[len(stacked) :]
    for index in np.ndindex(spec.shape[: len(stacked)]):
        where = dict(zip(stacked, index, strict=True))
        robot = table.entries[where[EMBODIMENT_AXIS]] if EMBODIMENT_AXIS in where else None
        own = [robot.chunk if axis == "U" else size for axis, size in zip(axes, shape, strict=True)]
        name = entry.official.format(layer=where.get(LAYER_AXIS), factor=where.get("Q"), robot=robot and robot.name)
        names = entry.pattern.split(" -> ")[0].split()
        sizes = dict(zip(names, own, strict=True))
        yield Part(name, (*index, *(slice(size) for size in own)), sizes, entry.pattern)


# --- Whole models ------------------------------------------------------------------------------


def official_parts(
    model: ModelConfig, table: EmbodimentTable, leaves: Mapping[str, ParamSpec]
) -> dict[str, list[Part]]:
    """Our path -> the official tensors of which it consists, for all declared parameters (`Declared.leaves`)."""
    entries = entries_of(model)
    return {path: list(parts_of(entries[path], spec, table)) for path, spec in leaves.items()}


def from_official(
    tensors: Mapping[str, Stored], parts: Mapping[str, list[Part]], leaves: Mapping[str, ParamSpec], where: str
) -> Params:
    """Our parameters from official tensors in the directory `where`, whose names and shapes have been checked.

    Raises ConfigError, which names a tensor that is not finite.
    """

    def assemble(path: str, spec: ParamSpec) -> np.ndarray:
        whole = np.zeros(spec.shape, np.float32)
        for part in parts[path]:
            whole[part.index] = part.from_official(read_finite(tensors, part.name, where))
        return whole

    return nested({path: assemble(path, spec) for path, spec in leaves.items()})


def to_official(params: Params, parts: Mapping[str, list[Part]]) -> dict[str, np.ndarray]:
    """Official name -> array, from our parameters or from anything shaped like them (gradients)."""
    # Each parameter is fetched only once: it may be on an accelerator.
    arrays = {path: np.asarray(x) for path, x in flat(params).items() if path in parts}
    return {part.name: part.to_official(arrays[path]) for path, own in parts.items() for part in own}


def flat(params: Params) -> dict[str, np.ndarray]:
    """'path/of/parameter' -> array."""
    return {"/".join(path): leaf for path, leaf in nnx.traversals.flatten_mapping(params).items()}


def nested(arrays: Mapping[str, np.ndarray]) -> Params:
    """The inverse of `flat`."""
    return nnx.traversals.unflatten_mapping({tuple(path.split("/")): leaf for path, leaf in arrays.items()})
