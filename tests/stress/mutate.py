"""Inputs for parsers: seeds changed at random, by byte and by structure.

Every function takes the random state that decides, so an input is made again from its number.
"""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable
from typing import Any

LARGEST = 2**20
"""Bytes of an input that was blown up; others stay near the size of their seed."""

JUNK: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 255, 2**31 - 1, 2**31, -(2**31), 2**63 - 1, 2**63, 2**64, 10**400, 0.5, -0.0,
    1e308, float("inf"), float("nan"), "", "x", "0", "-1", "7", "1e999", "9" * 30, "../x", "/etc/passwd", "a/b", ".x",
    "\0", "\n", "\ud800", "ä", "x" * 300, "{0}", "{DATASET.__class__}", "{SPLIT:>99999}", "float32", "int64",
    "string", "bool", "train", [], {}, [[]], [None], [{}], {"": {}}, {"a": 1},
)  # fmt: skip

BYTES = (b"", b"\0", b"\xff", b"\x7f", b"\x80", b"\xff\xff\xff\xff", b"\x80" * 9, b"\x80" * 10 + b"\x01", b"\x0a\0",
         b"\xff" * 9 + b"\x01", b"{", b"[", b'"', b",", b":", b"[" * 200, b'{"a":' * 50, b"1e400", b"9" * 400)  # fmt: skip


def change_bytes(rng: random.Random, data: bytes, other: bytes = b"") -> bytes:
    """`data` after one to a few small changes; `other` may lend it a part."""
    out = bytearray(data)
    for _ in range(1 + int(rng.expovariate(1))):
        at = rng.randrange(len(out) + 1)
        end = min(len(out), at + int(rng.expovariate(0.2)))
        action = rng.randrange(7)
        if action == 0 and at < len(out):
            out[at] ^= 1 << rng.randrange(8)
        elif action == 1 and at < len(out):
            out[at] = rng.randrange(256)
        elif action == 2:
            del out[at:end]
        elif action == 3:
            out[at:at] = rng.choice(BYTES)
        elif action == 4:
            out[at:at] = out[at:end]
        elif action == 5 and other:
            start = rng.randrange(len(other))
            out[at:end] = other[start : start + int(rng.expovariate(0.05))]
        else:
            del out[rng.randrange(len(out) + 1) :]
    return bytes(out)


def blow_up(rng: random.Random, data: bytes) -> bytes:
    """A part of `data` again and again, up to LARGEST bytes."""
    at = rng.randrange(len(data) + 1)
    part = data[at : at + 1 + int(rng.expovariate(0.1))] or b"["
    return data[:at] + part * (LARGEST // len(part)) + data[at:]


def change_json(rng: random.Random, text: bytes) -> bytes:
    """The JSON of `text` with a few of its values changed; other bytes where it holds none."""
    try:
        tree = [json.loads(text)]
    except (ValueError, RecursionError):
        return change_bytes(rng, text)
    for _ in range(1 + int(rng.expovariate(0.7))):
        _change_value(rng, tree)
    try:
        return json.dumps(tree[0]).encode()
    except (ValueError, RecursionError):
        return text


def _change_value(rng: random.Random, tree: list) -> None:
    places = list(_places(tree))
    holder, key = rng.choice(places)
    value = holder[key]
    action = rng.randrange(9)
    if action <= 2:
        holder[key] = copy.deepcopy(rng.choice(JUNK))
    elif action == 3:
        other, name = rng.choice(places)
        holder[key] = copy.deepcopy(other[name])
    elif action == 4 and isinstance(holder, dict):
        holder[rng.choice(("", "x", "../x", "name", "type", "shape", "\ud800", "text"))] = holder.pop(key)
    elif action == 5 and holder is not tree:
        del holder[key]
    elif action == 6:
        holder[key] = [value] if rng.randrange(2) else {"a": value}
    elif action == 7 and isinstance(value, list):
        holder[key] = value * rng.choice((2, 100, 1000))
    elif isinstance(value, (int, float)) and not isinstance(value, bool):
        holder[key] = rng.choice((value + 1, -value, str(value)))
    elif isinstance(value, str):
        holder[key] = rng.choice((value + "x", value[:-1], value * 50, f"../{value}"))


def _places(holder: Any):
    """(list or dict, index or key) of every value below."""
    items = list(enumerate(holder)) if isinstance(holder, list) else list(holder.items())
    for key, value in items[:200]:
        yield holder, key
        if isinstance(value, (list, dict)):
            yield from _places(value)


def make_input(
    rng: random.Random,
    seeds: list[bytes],
    structured: Callable[[random.Random, bytes], bytes],
    large: float = 0.0005,
) -> bytes:
    """One input from a seed; `large` is the share of those that are blown up."""
    seed = rng.choice(seeds)
    if rng.random() < large:
        return blow_up(rng, seed)
    if rng.random() < 0.6:
        seed = structured(rng, seed)
        if rng.random() < 0.8:
            return seed
    return change_bytes(rng, seed, rng.choice(seeds))
