"""What devices send each other in a compiled program, and what for."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hma_jax.kernels.dense import FROM_EXAMPLES, TO_EXAMPLES
from hma_jax.runtime.sharding import GATHER, SCATTER
from hma_jax.training.optimizer import ORTHOGONALISE

KINDS = ("all-gather", "all-reduce", "reduce-scatter", "all-to-all", "collective-permute")
LINE = re.compile(rf"= (?P<result>\(.*?\)|\S+) (?P<kind>{'|'.join(KINDS)})(?P<start>-start)?\(")
ARRAY = re.compile(r"\b(?:pred|[a-z]+?(?P<bits>\d+)\w*)\[(?P<shape>[\d,]*)\]")
SMALL = 2**16
"""Bytes of what is called numbers and flags below."""


@dataclass(frozen=True)
class Collective:
    """One kind of communication for one purpose."""

    kind: str
    over: str  # mesh axes, joined by "+"; "" where the program does not say
    looped: bool  # in the body of a loop: once for every layer, or for every micro-batch
    purpose: str


@dataclass(frozen=True)
class Sent:
    count: int  # as they stand in the program's text
    bytes: int  # of their results on one device, once through the text


def find_collectives(text: str, mesh: Mapping[str, int]) -> dict[Collective, Sent]:
    """Those of a program compiled for a mesh of those sizes, most bytes first."""
    counts: Counter[Collective] = Counter()
    sizes: Counter[Collective] = Counter()
    channels: set[tuple[str, str]] = set()
    for line in text.splitlines():
        if (match := LINE.search(line)) is None:
            continue
        label = re.search(r'op_name="([^"]*)"', line)
        name, kind = label[1] if label else "", match["kind"]
        # TPU programs write one gather several times: with every computation during which it goes on. What `shard_map`
        # sends has one channel throughout.
        channel = re.search(r"channel_id=(\d+)", line)
        if channel and ORTHOGONALISE not in name:
            if (kind, channel[1]) in channels:
                continue
            channels.add((kind, channel[1]))
        arrays, over = count_bytes(match["result"]), find_axes(line, mesh)
        # What starts a gather or a permutation holds what is sent beside what is received.
        size = max(arrays) if match["start"] and kind in ("all-gather", "collective-permute") else sum(arrays)
        collective = Collective(kind, over, "while/body" in name, explain(kind, name, over, size))
        counts[collective] += 1
        sizes[collective] += size
    order = sorted(counts, key=lambda c: (-sizes[c], str(c)))
    return {collective: Sent(counts[collective], sizes[collective]) for collective in order}


def count_kinds(collectives: Mapping[Collective, Sent]) -> dict[str, int]:
    """How often each kind stands in the program."""
    counts = {kind: sum(sent.count for c, sent in collectives.items() if c.kind == kind) for kind in KINDS}
    return {kind: count for kind, count in counts.items() if count}


def explain(kind: str, name: str, over: str, size: int) -> str:
    """What a collective is for, by the name of the operation that it comes from."""
    backward = "transpose(" in name and "rematted_computation" not in name
    if kind == "collective-permute" and "dot_general" in name:
        # On TPUs a product next to a gather or a scatter of one side is computed part by part in a ring.
        return "gradients, sent on in a ring while their product is computed" if backward else "a product in a ring"
    for scope, purpose in (
        (GATHER, "parameters, from storage to compute"),
        (SCATTER, "gradients, from compute to storage"),
        (TO_EXAMPLES, "robots' parameters, to their examples"),
        (FROM_EXAMPLES, "robots' gradients, from their examples"),
        (ORTHOGONALISE, "Muon's matrices, to one device each and back"),
    ):
        if scope in name:
            return purpose
    if kind == "all-gather" and "convert_element_type" in name:
        return "parameters, from storage to compute"
    if kind == "all-to-all" and backward:
        return "robots' gradients, from their examples"
    if size <= SMALL:
        return "numbers and flags: losses, norms, counts, which robots are there, small gradients"
    if "tensor" in over.split("+"):
        return "activations, summed over split heads, mlp width or vocabulary"
    if kind in ("all-reduce", "reduce-scatter") and (backward or not name):
        return "gradients, summed over examples"
    return f"other: {name.removeprefix('jit(step)/')[-60:] or 'the program does not say'}"


def find_axes(line: str, mesh: Mapping[str, int]) -> str:
    """The mesh axes along which the devices of one group lie."""
    devices = _first_group(line, math.prod(mesh.values()))
    if devices is None:
        return ""
    places = np.stack(np.unravel_index(devices, tuple(mesh.values())))
    return "+".join(axis for axis, place in zip(mesh, places, strict=True) if len(set(place)) > 1)


def _first_group(line: str, devices: int) -> list[int] | None:
    """The devices of one group, by their places on the mesh, in any of the forms in which XLA writes groups."""
    if match := re.search(r"replica_groups=\{\{([\d,]+)\}|source_target_pairs=\{\{([\d,]+)\}", line):
        return [int(x) for x in (match[1] or match[2]).split(",")]
    if match := re.search(r"replica_groups=\[([\d,]+)\]<=\[([\d,]+)\](?:T\(([\d,]+)\))?", line):
        groups, shape, order = ([int(x) for x in part.split(",")] if part else None for part in match.groups())
        numbers = np.arange(math.prod(shape)).reshape(shape)
        return numbers.transpose(order).reshape(groups)[0].tolist()
    if match := re.search(r"replica_groups=mesh\[([^\]]+)\] \{((?:'\w+',?)+)\}", line):
        sizes = {name: int(size) for name, size in (part.split("=") for part in match[1].split(","))}
        numbers = np.arange(math.prod(sizes.values())).reshape(tuple(sizes.values()))
        apart = tuple(slice(None) if name in match[2].split(",") else 0 for name in sizes)
        return numbers[apart].ravel().tolist()
    return list(range(devices)) if "replica_groups={}" in line else None


def count_bytes(result: str) -> list[int]:
    """Of each array in the type of an instruction's result, such as 'f32[8]{0}' or '(f32[8], u32[])'."""
    arrays = [(int(x["bits"] or 8), x["shape"]) for x in ARRAY.finditer(re.sub(r"\{[^}]*\}|/\*.*?\*/", "", result))]
    return [bits * math.prod(int(n) for n in shape.split(",") if n) // 8 for bits, shape in arrays]
