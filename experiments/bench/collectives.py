"""What devices send each other in a compiled program, and what for."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hma_jax.kernels.dense import FROM_EXAMPLES, TO_EXAMPLES
from hma_jax.runtime.sharding import GATHER, SCATTER
from hma_jax.training.optimizer import ORTHOGONALISE

RECEIVED: dict[str, Callable[[int], float]] = {
    "all-gather": lambda n: (n - 1) / n,
    "all-reduce": lambda n: 2 * (n - 1) / n,  # sums are scattered, then gathered
    "reduce-scatter": lambda n: n - 1,
    "all-to-all": lambda n: (n - 1) / n,
    "collective-permute": lambda n: 1,
}
"""What each of n devices receives from the others, over the size of its result."""
KINDS = tuple(RECEIVED)
LINE = re.compile(rf"= (?P<result>\(.*?\)|\S+) (?P<kind>{'|'.join(KINDS)})(?P<start>-start)?\(")
ARRAY = re.compile(r"\b(?:pred|[a-z]+?(?P<bits>\d+)\w*)\[(?P<shape>[\d,]*)\]")
PART = r"(?:\([^()]*\)|[^(),]+\[[\d,]*\])"
SECOND = re.compile(rf"\({PART}, ({PART})")
"""In a tuple of arrays, or of tuples of arrays."""
COMPUTATION = re.compile(r"(?:ENTRY )?%?(?P<name>[\w.-]+) \(.*\{$")
CALL = re.compile(
    r"\b(?:body|condition|calls|to_apply|true_computation|false_computation)=%?(?P<one>[\w.-]+)"
    r"|\bbranch_computations=\{(?P<many>[^}]*)\}"
)
TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"')
SMALL = 2**16
"""Bytes of what is called numbers and flags below."""


@dataclass(frozen=True)
class Collective:
    """One kind of communication for one purpose."""

    kind: str
    over: str  # mesh axes, joined by "+"; "" where the program does not say
    loops: int  # number of nested loops around it: over micro-batches, if there are several, and over layers
    purpose: str


@dataclass(frozen=True)
class Sent:
    count: int  # number in the program's text
    bytes: int  # bytes that one device receives in one pass through the text
    whole: int  # the same in a step: loops count as often as they run, if the compiler knows that


def find_collectives(text: str, mesh: Mapping[str, int]) -> dict[Collective, Sent]:
    """The collectives of a program compiled for a mesh of these sizes, those with most bytes first. A collective
    that does not list its groups is taken to be among all devices."""
    devices = math.prod(mesh.values())
    found: dict[Collective, Sent] = {}
    runs, computation = count_runs(text), ""
    channels: set[tuple[str, str]] = set()
    for line in text.splitlines():
        computation = begun[1] if (begun := COMPUTATION.match(line)) else computation
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
        group = _first_group(line, devices)
        # The start of a collective holds what is sent beside its result; that of an all-reduce, only the result.
        size = count_bytes(match["result"], started=bool(match["start"]) and kind != "all-reduce")
        over = "" if group is None else find_axes(group, mesh)
        collective = Collective(kind, over, name.count("while/body"), explain(kind, name, over, size))
        size = round(size * RECEIVED[kind](len(group or range(devices))))
        so_far, whole = found.get(collective, Sent(0, 0, 0)), size * runs.get(computation, 1)
        found[collective] = Sent(so_far.count + 1, so_far.bytes + size, so_far.whole + whole)
    return dict(sorted(found.items(), key=lambda item: (-item[1].bytes, str(item[0]))))


def count_runs(text: str) -> dict[str, int]:
    """How often each computation of a program runs. A loop counts once if the compiler does not know how often it runs;
    every branch of a conditional counts."""
    callers: dict[str, list[tuple[str, int]]] = {}
    computation = ""
    for line in text.splitlines():
        if begun := COMPUTATION.match(line):
            computation = begun[1]
            callers.setdefault(computation, [])
            continue
        trips = TRIPS.search(line)
        for call in CALL.finditer(line):
            for name in (call["one"] or call["many"]).split(","):
                callers.setdefault(name.strip().removeprefix("%"), []).append(
                    (computation, int(trips[1]) if trips else 1)
                )

    @functools.cache
    def runs(name: str) -> int:
        return sum(times * runs(caller) for caller, times in callers[name]) if callers.get(name) else 1

    return {name: runs(name) for name in callers}


def count_kinds(collectives: Mapping[Collective, Sent]) -> dict[str, int]:
    """How often each kind occurs in the program."""
    counts = {kind: sum(sent.count for c, sent in collectives.items() if c.kind == kind) for kind in KINDS}
    return {kind: count for kind, count in counts.items() if count}


def explain(kind: str, name: str, over: str, size: int) -> str:
    """What a collective is for, from the name of the operation that it comes from."""
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


def find_axes(group: Sequence[int], mesh: Mapping[str, int]) -> str:
    """The mesh axes along which the devices of a group lie."""
    places = np.stack(np.unravel_index(group, tuple(mesh.values())))
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


def count_bytes(result: str, started: bool = False) -> int:
    """Bytes of the arrays in an instruction's result type, such as 'f32[8]{0}' or '(f32[8], u32[])'. The type of an
    instruction that is only `started` is (operands, results, ...): its second part counts."""
    arrays = re.sub(r"\{[^}]*\}|/\*.*?\*/", "", result)
    second = SECOND.match(arrays) if started else None
    found = ARRAY.finditer(second[1] if second else arrays)
    return sum(int(x["bits"] or 8) * math.prod(int(n) for n in x["shape"].split(",") if n) // 8 for x in found)
