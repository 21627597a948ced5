"""Tiny RLDS datasets that can be checked frame by frame, and a tokenizer that reads them.

A frame's colour is (episode, step, 0); an action's values are episode, step, 0, 0, ... So a
token says which frame it came from, and an action which step it belongs to.
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from data_pipelines.registry import DatasetSpec
from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.tfrecord import write_shard
from data_pipelines.tokens.manifest import JobSettings, Manifest, SplitFacts, TokenizerFacts

REAL_DATA = Path(__file__).parent / "data" / "bridge_dataset"
GOLDEN = Path(__file__).parent.parent / "golden"


class FakeTokenizer:
    """Ids are 256 x red + green of the image's corners; S = 4 equal tokens."""

    image_size, grid, tokens = 8, 2, 4
    vocab_size, factors, factor_vocab, channels = 65536, 2, 256, 0
    at_once = 1

    def __init__(self, identity: str = "fake"):
        self.identity = identity

    def encode(self, images: np.ndarray) -> np.ndarray:
        corners = images[:, ::7, ::7].astype(np.int32).reshape(len(images), 4, 3)
        return corners[..., 0] * 256 + corners[..., 1]

    def decode(self, ids: np.ndarray) -> np.ndarray:
        image = np.zeros((len(ids), 8, 8, 3), np.uint8)
        image[..., 0], image[..., 1] = (ids[:, :1, None] // 256), (ids[:, :1, None] % 256)
        return image


class FakeLatents(FakeTokenizer):
    """Latents of C = 3 channels: the corner's red, its green, and a third of the green."""

    vocab_size, factors, factor_vocab, channels = 0, 0, 0, 3

    def encode(self, images: np.ndarray) -> np.ndarray:
        corners = images[:, ::7, ::7].astype(np.float32).reshape(len(images), 4, 3)
        corners[..., 2] = corners[..., 1] / 3  # no number of few bits
        return corners

    def decode(self, latents: np.ndarray) -> np.ndarray:
        image = np.zeros((len(latents), 8, 8, 3), np.uint8)
        image[..., :2] = latents[:, :1, None, :2]
        return image


def make_spec(name: str = "toy", dims: tuple[int, ...] = (3,), hz: float = 4) -> DatasetSpec:
    keys = ("action",) if len(dims) == 1 else tuple(f"action/part_{i}" for i in range(len(dims)))
    return DatasetSpec(name, "observation/image", keys, dims, hz)


def count_open(directory: Path) -> int:
    """Descriptors of this process, in all its threads, that are files below `directory`."""
    places = {(s.st_dev, s.st_ino) for s in (p.stat() for p in directory.rglob("*") if p.is_file())}
    found = 0
    for fd in os.listdir("/dev/fd"):
        try:
            status = os.fstat(int(fd))
        except OSError:  # closed meanwhile, as that of the listing is
            continue
        found += (status.st_dev, status.st_ino) in places
    return found


def png(image: np.ndarray) -> bytes:
    out = io.BytesIO()
    Image.fromarray(image).save(out, "PNG", compress_level=1)
    return out.getvalue()


def make_features(episode: int, steps: int, dims: tuple[int, ...] = (3,)) -> dict:
    """The flat features of one episode."""
    frames = np.zeros((steps, 8, 8, 3), np.uint8)
    frames[..., 0], frames[..., 1] = episode % 256, np.arange(steps)[:, None, None]
    actions = np.zeros((steps, sum(dims)), np.float32)
    actions[:, 0], actions[:, 1] = episode, np.arange(steps)
    columns = np.split(actions, np.cumsum(dims)[:-1], axis=1)
    keys = make_spec(dims=dims).action_keys
    return {
        "steps/observation/image": [png(f) for f in frames],
        **{f"steps/{key}": column for key, column in zip(keys, columns, strict=True)},
        "steps/is_last": np.arange(steps) == steps - 1,
        "steps/language_instruction": [b"push"] * steps,
        "episode_metadata/success": np.array([episode % 2], np.int64),
    }


def write_rlds(
    root: Path,
    spec: DatasetSpec,
    lengths: list[int],
    shards: int = 1,
    change: Callable[[int, dict], None] | None = None,
    rewards: Callable[[int], Sequence[float]] | None = None,
) -> Path:
    """Writes `<root>/<name>/1.0.0` with one episode per length; returns that directory.

    `change(episode, features)` may spoil an episode before it is written. `rewards(episode)` are those of its steps,
    which otherwise have none.
    """
    directory = root / spec.name / "1.0.0"
    directory.mkdir(parents=True)
    records = []
    for i, steps in enumerate(lengths):
        features = make_features(i, steps, spec.action_dims)
        if rewards is not None:
            features["steps/reward"] = np.asarray(rewards(i), np.float32)
        if change is not None:
            change(i, features)
        records.append(encode_example(features))
    counts = []
    for k, part in enumerate(np.array_split(np.arange(len(records)), shards)):
        path = directory / f"{spec.name}-train.tfrecord-{k:05d}-of-{shards:05d}"
        counts.append(write_shard(path, [records[i] for i in part]))
    write_metadata(directory, spec, counts, rewards is not None)
    return directory


def write_metadata(directory: Path, spec: DatasetSpec, counts: list[int], rewarded: bool = False) -> None:
    from tensorflow_datasets import features as tf

    def tensor(size: int):
        return tf.Tensor(shape=(size,), dtype=np.float32)

    parts = [tensor(dim) for dim in spec.action_dims]
    named = {f"part_{i}": part for i, part in enumerate(parts)}
    image = tf.Image(shape=(8, 8, 3), encoding_format="png")
    features = tf.FeaturesDict(
        {
            "steps": tf.Dataset(
                {
                    "observation": tf.FeaturesDict({"image": image}),
                    "action": parts[0] if len(parts) == 1 else tf.FeaturesDict(named),
                    "is_last": tf.Scalar(dtype=np.bool_),
                    "language_instruction": tf.Text(),
                }
                | ({"reward": tf.Scalar(dtype=np.float32)} if rewarded else {})
            ),
            "episode_metadata": tf.FeaturesDict({"success": tf.Scalar(dtype=np.bool_)}),
        }
    )
    features.save_config(str(directory))
    info = {
        "fileFormat": "tfrecord",
        "name": spec.name,
        "version": "1.0.0",
        "splits": [
            {
                "filepathTemplate": "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
                "name": "train",
                "numBytes": "1",
                "shardLengths": [str(n) for n in counts],
            }
        ],
    }
    (directory / "dataset_info.json").write_text(json.dumps(info))


class OneDataset:
    """A store of one dataset that has a manifest only."""

    def __init__(self, steps, hz=2.0, frame_step=1, episodes=None, dims=(3,)):
        self._manifest = Manifest(
            spec=DatasetSpec("toy", "observation/image", ("action",), dims, hz),
            tokenizer=TokenizerFacts("fake", 8, 4, 16, 65536, 2, 256),
            settings=JobSettings(frame_step=frame_step),
            source="",
            source_version="1.0.0",
            action_mean=(0.0,) * sum(dims),
            action_std=(1.0,) * sum(dims),
            train=SplitFacts(tuple(episodes or range(len(steps))), tuple(steps)),
            val=SplitFacts((), ()),
        )

    def manifest(self, name):
        return self._manifest
