"""tf.train.Example without TensorFlow: bytes to arrays and back.

Owns the wire format of that one message, nothing of RLDS. Only the wanted features are decoded, and long lists with
numpy, which is faster than a general protobuf parser if a record holds cameras and embeddings that are not needed;
if the record is a view of a file, these are not even read.

Message (protobuf field numbers): Example{1: Features}, Features{1: map entries {1: key,
2: Feature}}, Feature{1: BytesList | 2: FloatList | 3: Int64List}, each list {1: values}.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.errors import CorruptRecordError, DataError, UnreachableError

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location
    from data_pipelines.sources.rlds.tfrecord import FileView

Feature = np.ndarray | Sequence[bytes]

MAX_FEATURES = 10_000
"""Largest number of features of a record: a feature of a few bytes in the file takes hundreds in memory."""

BATCH = 2**16
"""Bytes of varints that are decoded at a time, which takes fifty times as much memory."""

_BYTES, _FLOAT, _INT = 1, 2, 3  # field numbers inside Feature
_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5  # wire types


class LazyBytes(Sequence[bytes]):
    """The n values of a bytes feature, each read from the record on access."""

    def __init__(self, data: bytes | FileView, spans: np.ndarray):
        self._data, self.spans = data, spans  # int64 [n, 2]

    def __len__(self) -> int:
        return len(self.spans)

    def __getitem__(self, i: int) -> bytes:
        start, end = self.spans[i].tolist()
        return self._data[start:end]


def parse_record(
    payload: bytes | FileView,
    path: Location,
    offset: int,
    keys: Collection[str] | None,
    lazy: bool,
) -> dict[str, Feature]:
    """`parse_example` of the record at byte `offset` of `path`, which a CorruptRecordError names."""
    try:
        return parse_example(payload, keys, lazy)
    except UnreachableError:
        raise
    except DataError as error:
        raise CorruptRecordError(path, offset, str(error)) from error


def parse_example(
    data: bytes | FileView, keys: Collection[str] | None = None, lazy: bool = False
) -> dict[str, Feature]:
    """The features of a serialized tf.train.Example, by flat key.

    A float feature is float32 [n], an integer feature int64 [n], a bytes feature a list of
    n `bytes`. A feature without a value is an empty list. With `keys`, other features are
    skipped unread; a wanted key that the record lacks is absent from the result. With `lazy`,
    bytes features are `LazyBytes`, which read from `data` on access.

    Raises DataError if `data` is not such a message.
    """
    wanted = None if keys is None else {k.encode() for k in keys}
    found: dict[str, Feature] = {}
    try:
        for number, start, end in _messages(data, 0, len(data)):
            if number != 1:
                continue
            for entry, entry_start, entry_end in _messages(data, start, end):
                if entry != 1:
                    continue
                key, value = b"", (entry_end, entry_end)
                for field, a, b in _messages(data, entry_start, entry_end):
                    if field == 1:
                        key = data[a:b]
                    elif field == 2:
                        value = (a, b)
                if wanted is None or key in wanted:
                    found[key.decode()] = _parse_feature(data, *value, lazy)
                    if len(found) > MAX_FEATURES:
                        raise ValueError(f"more than {MAX_FEATURES:,} features")
    except (IndexError, ValueError, struct.error) as error:
        raise DataError(f"the record is not a tf.train.Example ({error})") from error
    return found


def encode_example(features: Mapping[str, np.ndarray | list[bytes]]) -> bytes:
    """A serialized tf.train.Example; the same features always give the same bytes.

    Float arrays become float32 lists, integer and bool arrays int64 lists (both flattened),
    lists of `bytes` bytes lists. Keys are written in sorted order.
    """
    entries = []
    for key in sorted(features):
        feature = _encode_feature(key, features[key])
        entry = _field(1, key.encode()) + _field(2, feature)
        entries.append(_field(1, entry))
    return _field(1, b"".join(entries))


# --- reading ---------------------------------------------------------------------------------


def _varint(data: bytes | FileView, at: int) -> tuple[int, int]:
    """(value, next position) of the varint at `at`."""
    byte = data[at]
    at += 1
    if byte < 0x80:
        return byte, at
    value, shift = byte & 0x7F, 7
    while True:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
        if shift > 63:
            raise ValueError(f"a varint longer than 10 bytes at byte {at}")


def _messages(data: bytes | FileView, at: int, end: int):
    """(field number, start, end) of each length-delimited field in data[at:end]."""
    while at < end:
        tag, at = _varint(data, at)
        wire = tag & 7
        if wire == _LENGTH:
            length, at = _varint(data, at)
            stop = at + length
            if stop > end:
                raise ValueError(f"a field at byte {at} runs past the end of its message")
            yield tag >> 3, at, stop
            at = stop
        else:  # unknown to this message; skip it as protobuf does
            at = _skip(data, at, wire)


def _skip(data: bytes | FileView, at: int, wire: int) -> int:
    if wire == _VARINT:
        return _varint(data, at)[1]
    if wire == _FIXED64:
        return at + 8
    if wire == _FIXED32:
        return at + 4
    raise ValueError(f"unknown wire type {wire} at byte {at}")


def _parse_feature(data: bytes | FileView, start: int, end: int, lazy: bool) -> Feature:
    kind, parts = 0, array("q")
    for number, a, b in _messages(data, start, end):
        if number != kind:  # a oneof: the last kind wins, pieces of one kind are joined
            kind, parts = number, array("q")
        parts.extend((a, b))
    if kind == _FLOAT:
        return np.frombuffer(_numbers(data, parts, _FIXED32), "<f4")
    if kind == _INT:
        return _varints(np.frombuffer(_numbers(data, parts, _VARINT), np.uint8))
    found = array("q")
    for k in range(0, len(parts), 2):
        for number, x, y in _messages(data, parts[k], parts[k + 1]):
            if number == 1:
                found.extend((x, y))
    values = LazyBytes(data, np.frombuffer(found, np.int64).reshape(-1, 2))
    return values if lazy else list(values)


def _numbers(data: bytes | FileView, parts: array, single: int) -> bytes | bytearray:
    """The encoded numbers of the lists that lie at `parts`, joined: packed as every writer does it, or
    one by one with the wire type `single`."""
    spans = array("q")
    for k in range(0, len(parts), 2):
        at, end = parts[k], parts[k + 1]
        while at < end:
            tag, at = _varint(data, at)
            start = at
            if tag == (1 << 3 | _LENGTH):
                length, start = _varint(data, at)
                at = start + length
            elif tag == (1 << 3 | single):
                at = _skip(data, at, single)
            else:
                at = _skip(data, at, tag & 7)
                continue
            if at > end:
                raise ValueError(f"a list of numbers runs past the end of its message at byte {end}")
            if single == _FIXED32 and (at - start) % 4:
                raise ValueError(
                    f"a list of floats at byte {start} is {at - start} bytes long, which is not a multiple of 4"
                )
            if single == _VARINT and at > start and data[at - 1] >= 0x80:
                raise ValueError("a varint is cut off")
            spans.extend((start, at))
    if len(spans) == 2:
        return data[spans[0] : spans[1]]
    joined = bytearray()
    for k in range(0, len(spans), 2):
        joined += data[spans[k] : spans[k + 1]]
    return joined


def _varints(raw: np.ndarray) -> np.ndarray:
    """int64 values of packed varints (uint8 bytes), the last of which is whole; many at once."""
    last = raw < 0x80
    if last.all():  # flags and small numbers
        return raw.astype(np.int64)
    values = np.empty(np.count_nonzero(last), np.int64)
    start = done = 0
    while start < raw.size:
        ends = np.flatnonzero(last[start : start + BATCH])
        if not ends.size:
            raise ValueError("a varint is longer than 10 bytes")
        starts = np.concatenate([[0], ends[:-1] + 1])
        if (ends - starts).max() > 9:
            raise ValueError("a varint is longer than 10 bytes")
        piece = raw[start : start + ends[-1] + 1]
        position = np.arange(piece.size) - np.repeat(starts, ends - starts + 1)
        bits = (piece & 0x7F).astype(np.uint64) << (7 * position).astype(np.uint64)
        values[done : done + ends.size] = np.bitwise_or.reduceat(bits, starts).view(np.int64)
        start, done = start + piece.size, done + ends.size
    return values


# --- writing ---------------------------------------------------------------------------------


def _encode_feature(key: str, value: np.ndarray | list[bytes]) -> bytes:
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return _field(_FLOAT, _field(1, np.ascontiguousarray(value, "<f4").tobytes()))
    if isinstance(value, np.ndarray) and value.dtype.kind in "iub":
        flat = value.reshape(-1)
        small = flat.size == 0 or (flat.min() >= 0 and flat.max() < 0x80)
        packed = flat.astype(np.uint8).tobytes() if small else b"".join(map(_encode_varint, flat.tolist()))
        return _field(_INT, _field(1, packed))
    if isinstance(value, list) and all(isinstance(v, bytes) for v in value):
        return _field(_BYTES, b"".join(_field(1, v) for v in value))
    raise DataError(
        f"feature {key!r} cannot be stored in a tf.train.Example: give a float, integer or bool array "
        f"or a list of bytes, not {type(value).__name__}"
    )


def _encode_varint(value: int) -> bytes:
    value &= (1 << 64) - 1  # negative numbers as two's complement
    out = bytearray()
    while value >= 0x80:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _field(number: int, payload: bytes) -> bytes:
    return _encode_varint(number << 3 | _LENGTH) + _encode_varint(len(payload)) + payload
