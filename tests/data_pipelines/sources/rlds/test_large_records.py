"""Records larger than memory should hold: read in pieces, and only where they are wanted."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from data_pipelines.errors import CorruptRecordError
from data_pipelines.sources.rlds import tfrecord
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.example import LazyBytes, encode_example, parse_example
from data_pipelines.sources.rlds.tfrecord import FileView
from data_pipelines.tokens import read_ahead
from tests.data_pipelines.fakes import make_spec, png, write_rlds

SPEC = make_spec(hz=4)
KEYS = (SPEC.image_key, SPEC.action_keys)


GROWTH = 200  # MB: read_ahead.PREFETCH_BYTES, and half as much again for copies


class Bytes:
    """A file in memory that counts what is read."""

    def __init__(self, data: bytes):
        self.data, self.size, self.read_bytes = data, len(data), 0

    def read(self, offset: int, length: int) -> bytes:
        self.read_bytes += length
        return self.data[offset : offset + length]


def test_features_nobody_asks_for_are_not_read():
    features = {
        "embedding": np.ones(500_000, np.float32),
        "other camera": [bytes(100_000)] * 20,
        "camera": [bytes([i]) * 1000 for i in range(20)],
        "action": np.arange(60, dtype=np.float32),
    }
    file = Bytes(b"head" + encode_example(features) + b"tail")
    view = FileView(file, 4, file.size - 8)
    record = parse_example(view, ["camera", "action"], lazy=True)
    assert isinstance(record["camera"], LazyBytes) and len(record["camera"]) == 20
    assert np.array_equal(record["action"], features["action"])
    assert file.read_bytes < 60_000  # of 4 MB: headers, and blocks of 4 KiB around them
    assert record["camera"][7] == features["camera"][7] and list(record["camera"]) == features["camera"]
    everything = parse_example(view)
    assert everything.keys() == features.keys() and everything["other camera"] == features["other camera"]


@pytest.fixture
def directory(tmp_path, monkeypatch):
    monkeypatch.setattr(tfrecord, "MAX_WHOLE_READ", 100)
    monkeypatch.setattr(tfrecord, "CHUNK", 256)
    return write_rlds(tmp_path, SPEC, [5, 6, 7])


def test_episode_is_the_same_in_pieces(directory, monkeypatch):
    pieces = RldsDataset(directory).episode(2, *KEYS)
    monkeypatch.setattr(tfrecord, "MAX_WHOLE_READ", 2**20)
    whole = RldsDataset(directory).episode(2, *KEYS)
    assert np.array_equal(pieces.images, whole.images) and np.array_equal(pieces.actions, whole.actions)


def test_checksum_is_verified_in_pieces(directory):
    dataset = RldsDataset(directory)
    shard = next(directory.glob("*.tfrecord*"))
    data = bytearray(shard.read_bytes())
    data[-20] ^= 1
    shard.write_bytes(data)
    dataset.episode(1, *KEYS)
    with pytest.raises(CorruptRecordError, match="checksum of the record's data"):
        dataset.episode(2, *KEYS)
    shard.write_bytes(data[:-500])
    with pytest.raises(CorruptRecordError, match="shorter since it was indexed"):
        dataset.episode(2, *KEYS)


def test_frames_under_way_are_bounded_in_bytes(tmp_path, monkeypatch):
    """A consumer that stops holds up the reader, whatever the size of an episode."""
    noise = np.random.default_rng(0).integers(0, 255, (32, 32, 3)).astype(np.uint8)
    frame = png(noise)

    def change(episode, features):
        features["steps/observation/image"] = [frame] * 200

    lengths = [200] * 3
    dataset = RldsDataset(write_rlds(tmp_path, SPEC, lengths, change=change))
    monkeypatch.setattr(read_ahead, "PREFETCH_BYTES", 20 * len(frame))
    cut = []

    def open_episode(i):
        return dataset.open_episode(i, *KEYS)

    def fit(image):
        cut.append(1)
        return image

    items = read_ahead.frames_ahead(range(3), open_episode, fit, 32 * 32 * 3)
    for _ in range(50):
        next(items)
    assert len(cut) <= 50 + 21
    items.close()
    items = list(read_ahead.frames_ahead(range(3), open_episode, fit, 32 * 32 * 3))
    assert [type(x).__name__ for x in items].count("ndarray") == 600


@pytest.mark.slow
@pytest.mark.parametrize("records, size", [(2, 150), (7, 300)])  # the second 2 GB, of disk too
def test_memory_does_not_grow_with_records(tmp_path, records, size):
    """Peak memory of a process that tokenises, JAX and the tokenizer included; and its growth by
    frames that are under way, but not by whole records (480 MB for the larger ones)."""
    command = [sys.executable, "-m", "tests.data_pipelines.sources.rlds.memory", str(tmp_path), str(records), str(size)]
    shown = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    peak, growth = (float(shown.split(word)[1].split()[0]) for word in ("peak", "growth"))
    assert 100 < peak < 1500 and growth < GROWTH, shown
