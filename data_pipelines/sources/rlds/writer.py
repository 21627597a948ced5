"""Writing an RLDS directory in tfds's layout: the schema, the flags of a step, and the metadata files.

Owns what all writers of episodes share; each writer decides which fields a dataset has. Records are made by
`example.encode_example`, single shards by `tfrecord.write_shard`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg

from data_pipelines.sources.rlds.tfrecord import payload_bytes, write_shard
from hma_jax.runtime.files import naming

VERSION = "1.0.0"
JPEG_QUALITY = 95

SHARD_FRAMES = 4000
"""Approximate number of native frames in one shard."""

IMAGE, TEXT = "image", "text"


@dataclass(frozen=True)
class Field:
    """One feature: a JPEG image, text, or an array of `dtype`."""

    dtype: str
    shape: tuple[int | None, ...] = ()


def image_field(height: int | None, width: int | None) -> Field:
    """An RGB image; None for sizes that differ between episodes."""
    return Field(IMAGE, (height, width, 3))


def vector_field(size: int) -> Field:
    return Field("float32", (size,))


STEP_FIELDS = {
    "discount": Field("float32"),
    "reward": Field("float32"),
    "is_first": Field("bool"),
    "is_last": Field("bool"),
    "is_terminal": Field("bool"),
    "language_instruction": Field(TEXT),
}
"""Fields of every step besides observations and actions."""


def step_features(rewards: np.ndarray, instructions: Sequence[str]) -> dict[str, np.ndarray | list[bytes]]:
    """The flat features of `STEP_FIELDS` for an episode of len(rewards) steps."""
    steps = len(rewards)
    first, last = np.zeros(steps, np.int64), np.zeros(steps, np.int64)
    first[0] = last[-1] = 1
    return {
        "steps/discount": np.ones(steps, np.float32),
        "steps/reward": np.asarray(rewards, np.float32),
        "steps/is_first": first,
        "steps/is_last": last,
        "steps/is_terminal": last,
        "steps/language_instruction": [text.encode() for text in instructions],
    }


def encode_jpeg(frame: np.ndarray) -> bytes:
    """JPEG of uint8 [H, W, 3], RGB, without chroma subsampling."""
    return simplejpeg.encode_jpeg(np.ascontiguousarray(frame), quality=JPEG_QUALITY, colorsubsampling="444")


def shard_name(dataset: str, index: int, count: int, split: str = "train") -> str:
    return f"{dataset}-{split}.tfrecord-{index:05d}-of-{count:05d}"


Split = tuple[Sequence[int], int]
"""What was written for a split: records in each shard, and bytes of all payloads."""


def write_shards(
    directory: Path,
    dataset: str,
    split: str,
    episodes: range,
    frames: int,
    records: Callable[[int, int], Iterable[bytes]],
) -> Split:
    """Writes the shards of a split. `records(first, end)` gives the records of some of its `episodes`, which have
    `frames` native frames in all."""
    shards = max(1, min(len(episodes), round(frames / SHARD_FRAMES)))
    bounds = np.linspace(episodes.start, episodes.stop, shards + 1).astype(int).tolist()
    lengths, size = [], 0
    for k, (first, end) in enumerate(pairwise(bounds)):
        path = directory / shard_name(dataset, k, shards, split)
        lengths.append(write_shard(path, records(first, end)))
        size += payload_bytes(path, lengths[-1])
    return lengths, size


def build_features(step: Mapping[str, Field], episode: Mapping[str, Field]) -> Any:
    """The tfds features of episodes; keys such as `observation/image` nest at each slash."""
    # The import takes over a second, and is needed only when a dataset is finished.
    from tensorflow_datasets import features as tf

    def leaf(field: Field) -> Any:
        if field.dtype == IMAGE:
            return tf.Image(shape=field.shape, dtype=np.uint8, encoding_format="jpeg")
        if field.dtype == TEXT:
            return tf.Text()
        dtype = np.dtype(field.dtype).type
        return tf.Tensor(shape=field.shape, dtype=dtype) if field.shape else tf.Scalar(dtype=dtype)

    def nest(fields: Mapping[str, Field]) -> Any:
        groups: dict[str, dict[str, Field]] = {}
        for key, field in fields.items():
            head, _, rest = key.partition("/")
            groups.setdefault(head, {})[rest] = field
        return tf.FeaturesDict(
            {head: leaf(inner[""]) if "" in inner else nest(inner) for head, inner in groups.items()}
        )

    return tf.FeaturesDict({"steps": tf.Dataset(nest(step)), "episode_metadata": nest(episode)})


def write_info(
    directory: Path,
    name: str,
    features: Any,
    splits: Mapping[str, Split],
    description: str,
    metadata: Mapping[str, Any],
    module: str,
) -> None:
    """Writes features.json, dataset_info.json and metadata.json with tfds itself. `metadata`: the contents of
    metadata.json; `module`: what made the dataset."""
    import tensorflow_datasets as tfds
    from tensorflow_datasets.core.dataset_info import DatasetIdentity

    identity = DatasetIdentity(
        name=name, version=tfds.core.Version(VERSION), data_dir=str(directory), module_name=module
    )
    facts = [
        tfds.core.SplitInfo(
            name=split,
            shard_lengths=list(lengths),
            num_bytes=size,
            filename_template=tfds.core.ShardedFileTemplate(
                data_dir=directory, dataset_name=name, split=split, filetype_suffix="tfrecord"
            ),
        )
        for split, (lengths, size) in splits.items()
    ]
    info = tfds.core.DatasetInfo(
        builder=identity,
        description=description,
        features=features,
        metadata=tfds.core.MetadataDict(metadata),
    )
    info.set_file_format("tfrecord")
    info.set_splits(tfds.core.splits.SplitDict(facts))
    with naming(directory):
        info.write_to_directory(directory)
        features.save_config(str(directory))
