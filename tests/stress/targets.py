"""What is fuzzed: each parser of files that others write, from bytes to what the rest of the program uses.

A target lays a sound dataset into a directory, puts an input in the place of one of its files, and parses.
"""

from __future__ import annotations

import hashlib
import json
import random
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_pipelines.columns import _START as START
from data_pipelines.columns import MAGIC
from data_pipelines.errors import DataError
from data_pipelines.sources.lerobot_meta import read_meta
from data_pipelines.sources.rlds.example import encode_example, parse_record
from data_pipelines.sources.rlds.schema import FEATURES, INFO, read_features, read_info, read_metadata
from data_pipelines.sources.rlds.tfrecord import masked_crc32c, open_record, read_record, scan_shard
from data_pipelines.tokens.manifest import COLUMNS_FILE, FILE
from data_pipelines.tokens.manifest_file import load_manifest
from data_pipelines.tokens.release_folder import open_folder
from tests.data_pipelines.fakes import REAL_DATA, OneDataset, make_features, make_spec
from tests.stress.mutate import change_bytes, change_json

FOLDER_FILES = ("metadata.json", "segment_ids.bin", "video.bin", "actions/part_0.bin")


@dataclass(frozen=True)
class Target:
    """`parse(input)` raises what the parser raises; `root` is named by every rejection."""

    root: Path
    seeds: list[bytes]
    structured: Callable[[random.Random, bytes], bytes]
    parse: Callable[[bytes], object]


def make_target(name: str, root: Path) -> Target:
    root.mkdir(parents=True, exist_ok=True)
    return TARGETS[name](root)


def _tfrecord(root: Path) -> Target:
    path = root / "toy-train.tfrecord-00000-of-00001"

    def parse(data: bytes) -> None:
        path.write_bytes(data)
        index, damage = scan_shard(path)
        for offset, length in zip(index.offsets.tolist(), index.lengths.tolist(), strict=True):
            assert offset >= 0 and offset + length + 16 <= len(data)
            try:
                assert len(read_record(path, offset, length)) == length
            except DataError as error:
                damage = error
        if damage is not None:
            raise damage

    seeds = [b"".join(map(_frame, records)) for records in ([], [b""], [b"a", b"bc" * 50], [b"x" * 300] * 5)]
    return Target(path, seeds, _change_records, parse)


def _frame(record: bytes) -> bytes:
    length = struct.pack("<Q", len(record))
    ends = (struct.pack("<I", masked_crc32c(part)) for part in (length, record))
    return length + next(ends) + record + next(ends)


def _change_records(rng: random.Random, data: bytes) -> bytes:
    """Other records, lengths that lie, under checksums that are right."""
    out = []
    for _ in range(rng.randrange(6)):
        frame = bytearray(_frame(change_bytes(rng, data[:200])))
        if rng.random() < 0.3:
            frame[:8] = struct.pack("<Q", rng.choice((0, 1, len(frame), 2**31, 2**62, 2**63, 2**64 - 1, 2**64 - 16)))
            frame[8:12] = struct.pack("<I", masked_crc32c(bytes(frame[:8])))
        out.append(bytes(frame))
    return b"".join(out)


def _example(root: Path) -> Target:
    path = root / "toy-train.tfrecord-00000-of-00001"

    def parse(data: bytes) -> None:
        path.write_bytes(_frame(data))
        for lazy in (False, True):
            with open_record(path, 0, len(data)) as payload:
                for values in parse_record(payload, path, 0, None, lazy).values():
                    [values[n] for n in range(min(len(values), 100))]

    seeds = [encode_example(make_features(1, 3)), encode_example({"a": np.arange(-4, 300)}), b"", encode_example({})]
    seeds.append(encode_example({f"steps/{n}": np.arange(n, dtype=np.float32) for n in range(9)}))
    return Target(path, seeds, change_bytes, parse)


def _features(root: Path) -> Target:
    def parse(data: bytes) -> None:
        (root / FEATURES).write_bytes(data)
        for key, feature in read_features(root).items():
            assert key.isprintable() and 0 <= feature.size < 2**31

    return Target(root / FEATURES, [_real(FEATURES), _old_schema()], change_json, parse)


def _info(root: Path) -> Target:
    (root / FEATURES).write_bytes(_real(FEATURES))

    def parse(data: bytes) -> None:
        (root / INFO).write_bytes(data)
        for split in read_info(root).splits:
            for shard in read_metadata(root, split).shards:
                assert shard.parent == root

    return Target(root / INFO, [_real(INFO)], change_json, parse)


def _real(file: str) -> bytes:
    return (REAL_DATA / "1.0.0" / file).read_bytes()


def _old_schema() -> bytes:
    """A schema in the form of tfds 4.0."""
    image = {"type": "f.Image", "content": {"shape": [None, 8, 3], "dtype": "uint8", "encoding_format": "png"}}
    action = {"type": "f.Tensor", "proto_cls": "t.TensorFeature", "content": '{"shape": {"dimensions": ["7"]}}'}
    step = {"type": "f.FeaturesDict", "content": {"image": image, "action": action}}
    steps = {"type": "f.Dataset", "content": {"feature": step, "length": -1}}
    return json.dumps({"type": "f.FeaturesDict", "content": {"steps": steps}}).encode()


def _lerobot(root: Path) -> Target:
    from tests.data_pipelines.convert.sources import write_lerobot

    places = []
    for version in ("v2.1", "v3.0"):
        home = write_lerobot(root / version, version, lengths=(2, 3))
        files = sorted(p for p in (home / "meta").rglob("*") if p.is_file())
        places += [(home, path, path.read_bytes()) for path in files]

    def parse(data: bytes) -> None:
        home, path, sound = places[data[0] % len(places) if data else 0]
        path.write_bytes(data[1:])
        try:
            for entry in read_meta(home).episodes:
                for file in (entry.data, *(video for video, _ in entry.videos.values())):
                    assert file.is_relative_to(home) and ".." not in file.parts
        finally:
            path.write_bytes(sound)

    seeds = [bytes([n]) + sound for n, (_, _, sound) in enumerate(places)]
    return Target(root, seeds, _change_rest, parse)


def _release(root: Path) -> Target:
    from tests.data_pipelines.tokens.test_import_tokens import write_folder

    folders = [write_folder(root / name, lengths=(2, 3), latents=latents) for name, latents in (("a", 0), ("b", 1))]
    places = [(folder, file, (folder / file).read_bytes()) for folder in folders for file in FOLDER_FILES]

    def parse(data: bytes) -> None:
        folder, file, sound = places[data[0] % len(places) if data else 0]
        (folder / file).write_bytes(data[1:])
        try:
            found = open_folder(folder)
            assert found.bounds[-1] == len(found.video) == len(found.actions) and len(found) >= 1
            assert found.encoder and found.vocab_size >= 0
        finally:
            (folder / file).write_bytes(sound)

    seeds = [bytes([n]) + sound for n, (_, _, sound) in enumerate(places)]
    return Target(root, seeds, _change_rest, parse)


def _change_rest(rng: random.Random, data: bytes) -> bytes:
    """JSON changed as such, also line by line, behind the byte that says which file it is."""
    kind, text = data[:1], data[1:]
    if not text.startswith(b"{"):
        return kind + change_bytes(rng, text)
    lines = text.split(b"\n")
    if len(lines) > 1 and lines[0].endswith(b"}"):
        n = rng.randrange(len(lines))
        lines[n] = change_json(rng, lines[n])
        return kind + b"\n".join(lines)
    return kind + change_json(rng, text)


def _manifest(root: Path) -> Target:
    sound = replace(OneDataset([5, 6, 7]).manifest("toy"), spec=replace(make_spec(dims=(2, 1)), camera="a"))
    sound = replace(sound, train=replace(sound.train, parts=(2, 1)))
    home = root / "manifest"
    home.mkdir()
    sound.save(home, root)
    places = [(path, path.read_bytes()) for path in (home / FILE, home / COLUMNS_FILE)]

    def parse(data: bytes) -> None:
        path, there = places[data[0] % len(places) if data else 0]
        path.write_bytes(data[1:])
        try:
            manifest = load_manifest(path.with_name(FILE))
            manifest.check(), manifest.hash(), manifest.train.native_frames, list(manifest.val.episodes)
        finally:
            path.write_bytes(there)

    def structured(rng: random.Random, data: bytes) -> bytes:
        return _change_columns(rng, data) if MAGIC in data[:20] else _change_rest(rng, data)

    seeds = [bytes([n]) + there for n, (_, there) in enumerate(places)]
    return Target(root, seeds, structured, parse)


def _change_columns(rng: random.Random, data: bytes) -> bytes:
    """Another header of a file of columns, under a hash that is right."""
    kind, start, rest = data[:1], data[1 : 1 + START], data[1 + START :]
    length = int.from_bytes(start[len(MAGIC) : len(MAGIC) + 8], "little")
    header, rest = rest[:length], rest[length:]
    header = change_json(rng, header)
    lied = rng.choice((len(header), len(header), 2**40, 2**63))
    size = lied.to_bytes(8, "little")
    return kind + MAGIC + size + hashlib.sha256(header).digest() + header + rest


TARGETS: dict[str, Callable[[Path], Target]] = {
    "tfrecord": _tfrecord,
    "example": _example,
    "features": _features,
    "dataset_info": _info,
    "lerobot": _lerobot,
    "release": _release,
    "manifest": _manifest,
}
