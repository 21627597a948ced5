"""A few hundred hostile inputs for every parser, and inputs made to need much memory.

`python -m tests.stress.fuzz` runs as many as one likes.
"""

from __future__ import annotations

import re
import tracemalloc

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.json_file import MAX_BYTES, read_object
from data_pipelines.sources.rlds.example import BATCH, encode_example, parse_example
from tests.stress.fuzz import EXTRA_MEMORY, Checker, fuzz
from tests.stress.targets import TARGETS, make_target

INPUTS = 500


@pytest.mark.parametrize("name", TARGETS)
def test_hostile_input_is_refused_by_name_or_read(name, tmp_path):
    check = fuzz(make_target(name, tmp_path / name), INPUTS)
    assert check.found == {}
    assert INPUTS / 20 < check.accepted < check.count  # neither all nor nothing reaches the parser's end


@pytest.mark.parametrize(
    "problem, expected",
    [
        (ZeroDivisionError("x"), "ZeroDivisionError"),
        (DataError("something is wrong"), "a rejection that names no file"),
        (DataError("{root}: " + "x" * 5000), "a rejection of more than 4000 characters"),
    ],
)
def test_broken_promise_is_noticed_once(tmp_path, problem, expected):
    target = make_target("features", tmp_path / "features")
    problem.args = (problem.args[0].format(root=target.root),)

    def parse(data):
        raise problem

    object.__setattr__(target, "parse", parse)
    check = Checker(target, tmp_path / "failures")
    check(b"1"), check(b"2")
    assert [place.split(" at ")[0] for place in check.found] == [expected]
    assert [p.read_bytes() for p in (tmp_path / "failures").iterdir()] == [b"1"]


# --- memory: at most 64 MB and ten times the input ---------------------------------------------


def field(number: int, payload: bytes) -> bytes:
    """A length-delimited field of a message."""
    size, length = len(payload), b""
    while size >= 0x80:
        length, size = length + bytes([size & 0x7F | 0x80]), size >> 7
    return bytes([number << 3 | 2]) + length + bytes([size]) + payload


def example_of(kind: int, values: bytes) -> bytes:
    return field(1, field(1, field(1, b"a") + field(2, field(kind, values))))


N = 2**18
EXAMPLES = {
    "empty texts": lambda: example_of(1, b"\x0a\x00" * 3 * N),
    "lists of nothing": lambda: field(1, field(1, field(1, b"a") + field(2, b"\x0a\x00" * 3 * N))),
    "floats one by one": lambda: example_of(2, b"\x0d1234" * 3 * N),
    "small numbers": lambda: example_of(3, field(1, b"\x01" * 32 * N)),
    "larger numbers": lambda: example_of(3, field(1, b"\x80\x01" * 8 * N)),
    "numbers one by one": lambda: example_of(3, b"\x08\x01" * 2 * N),
    "features": lambda: field(1, b"".join(field(1, field(1, b"%06x" % n)) for n in range(2 * N))),
}
"""Made by the test that wants one: a worker that imports this file may run none of them."""


def peak_of(call) -> int:
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


SLOW = ("lists of nothing", "floats one by one", "numbers one by one")  # tracing memory is what takes long


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.slow if n in SLOW else ()) for n in EXAMPLES])
def test_example_takes_memory_in_proportion(name):
    data = EXAMPLES[name]()

    def parse():
        try:
            parse_example(data, lazy=True)
        except DataError as error:
            assert name == "features" and "more than 10,000 features" in str(error)

    assert peak_of(parse) < EXTRA_MEMORY + 10 * len(data)


@pytest.mark.parametrize(
    "unit, size",
    [(u, 2**19) for u in (b"[],", b"{},", b'{"":0},', b"0,", b"1.5,", b'"",', b'"ab",', b"[[[]]],")]
    + [(u, MAX_BYTES - 10) for u in (b"[],", b'"0123456789abcdefghijklmnopqrstuvwxyz01234567",')],
)
def test_json_takes_memory_in_proportion(tmp_path, unit, size):
    path = tmp_path / "features.json"
    path.write_bytes(b"[" + unit * (size // len(unit)) + b"0]")

    def parse():
        try:
            read_object(path, if_missing="", advice="")
        except DataError as error:
            assert re.search("features.json (has more than|holds no JSON object)", str(error))

    assert peak_of(parse) < EXTRA_MEMORY + 10 * size


def test_text_of_wide_characters_takes_memory_in_proportion(tmp_path):
    path = tmp_path / "features.json"
    path.write_bytes(b'["' + "\N{GRINNING FACE}".encode() + b"a" * (MAX_BYTES - 10) + b'"]')

    def parse():
        with pytest.raises(DataError, match="features.json holds no JSON object"):
            read_object(path, if_missing="", advice="")

    peak = peak_of(parse)
    assert peak < EXTRA_MEMORY + 10 * MAX_BYTES


@pytest.mark.parametrize("count", [1, 9, BATCH - 1, BATCH, BATCH + 1, 3 * BATCH])
def test_numbers_decoded_in_batches_are_the_same(count):
    values = np.random.default_rng(count).integers(-(2**63), 2**63 - 1, count) >> np.arange(count) % 64
    assert np.array_equal(parse_example(encode_example({"a": values}))["a"], values)
