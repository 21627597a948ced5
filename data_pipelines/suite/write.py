"""One dataset of the suite on disk, laid out as tensorflow_datasets writes RLDS.

Owns features, records, shards and metadata of one dataset. What happens in an episode comes
from `rollout`, its pictures from `render`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import simplejpeg

from data_pipelines.example import encode_example
from data_pipelines.suite.appearance import Appearance, draw_appearance
from data_pipelines.suite.render import frame_index, render_frames
from data_pipelines.suite.rollout import Rollout, simulate
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.tfrecord import write_shard

VERSION = "1.0.0"
JPEG_QUALITY = 95
SHARD_FRAMES = 4000
"""About this many native frames go into one shard."""

BLOCK = 16
"""Episodes rendered together."""


def build_features(spec: EmbodimentSpec) -> Any:
    """The tfds features of this embodiment's episodes."""
    # Costs over a second and is not needed to simulate or to read the table.
    from tensorflow_datasets import features as tf

    def tensor(size: int) -> Any:
        return tf.Tensor(shape=(size,), dtype=np.float32)

    images = {
        c.key: tf.Image(shape=(c.height, c.width, 3), dtype=np.uint8, encoding_format="jpeg")
        for c in spec.cameras
    }
    if spec.dict_actions:
        action = tf.FeaturesDict({key: tensor(dim) for key, dim in spec.action_layout})
    else:
        action = tensor(spec.action_dim)
    step = {
        "observation": tf.FeaturesDict(images | {"state": tensor(spec.body.size)}),
        "action": action,
        "discount": tf.Scalar(dtype=np.float32),
        "reward": tf.Scalar(dtype=np.float32),
        "is_first": tf.Scalar(dtype=np.bool_),
        "is_last": tf.Scalar(dtype=np.bool_),
        "is_terminal": tf.Scalar(dtype=np.bool_),
        "language_instruction": tf.Text(),
    }
    episode = {
        "file_path": tf.Text(),
        "success": tf.Scalar(dtype=np.bool_),
        "seed": tf.Scalar(dtype=np.int64),
    }
    return tf.FeaturesDict({"steps": tf.Dataset(step), "episode_metadata": tf.FeaturesDict(episode)})


def write_dataset(spec: EmbodimentSpec, directory: Path, *, episodes: int, seed: int, metadata: dict) -> int:
    """Simulates and writes a whole dataset into `directory`; returns its native frames.

    `seed` is the dataset's own. Not atomic: `generate` gives a directory aside.
    """
    rollout, looks = simulate(spec, episodes, seed), draw_appearance(spec, episodes, seed)
    frames = int(rollout.lengths.sum())
    shards = max(1, min(episodes, round(frames / SHARD_FRAMES)))
    bounds = np.linspace(0, episodes, shards + 1).astype(int)
    lengths, size = [], 0
    for k in range(shards):
        path = directory / f"{spec.name}-train.tfrecord-{k:05d}-of-{shards:05d}"
        records = episode_records(spec, rollout, looks, bounds[k], bounds[k + 1], seed)
        lengths.append(write_shard(path, records))
        size += path.stat().st_size - 16 * lengths[-1]  # tfds counts payload bytes, not framing
    description = f"Simulated embodiment ({spec.kind}, {spec.convention} actions, {spec.hz} Hz)."
    write_info(directory, spec.name, build_features(spec), lengths, size, description, metadata)
    return frames


def episode_records(
    spec: EmbodimentSpec, rollout: Rollout, looks: Appearance, start: int, stop: int, seed: int
) -> Iterator[bytes]:
    """Serialised examples of episodes start..stop-1."""
    for first in range(start, stop, BLOCK):
        block = list(range(first, min(first + BLOCK, stop)))
        which, step = frame_index(rollout, block)
        views = {c.key: render_frames(spec, rollout, looks, c, which, step) for c in spec.cameras}
        ends = np.cumsum(rollout.lengths[block])
        for i, end in zip(block, ends, strict=True):
            images = {key: frames[end - rollout.lengths[i] : end] for key, frames in views.items()}
            yield encode_example(episode_features(spec, rollout, images, i, seed))


def episode_features(
    spec: EmbodimentSpec, rollout: Rollout, images: dict[str, np.ndarray], i: int, seed: int
) -> dict[str, np.ndarray | list[bytes]]:
    """Flattened tf.Example features of episode i; `images[key]` is uint8 [T, H, W, 3]."""
    steps = int(rollout.lengths[i])
    flags = np.zeros((2, steps), np.int64)
    flags[0, 0] = flags[1, -1] = 1
    reward = np.zeros(steps, np.float32)
    if rollout.success[i]:
        reward[rollout.reached[i]] = 1.0
    features: dict[str, np.ndarray | list[bytes]] = {
        "steps/observation/state": rollout.q[i, :steps].astype(np.float32).ravel(),
        "steps/discount": np.ones(steps, np.float32),
        "steps/reward": reward,
        "steps/is_first": flags[0],
        "steps/is_last": flags[1],
        "steps/is_terminal": flags[1],
        "steps/language_instruction": [spec.instruction.encode()] * steps,
        "episode_metadata/file_path": [f"suite/{spec.name}/{i:06d}".encode()],
        "episode_metadata/success": np.array([rollout.success[i]], np.int64),
        "episode_metadata/seed": np.array([seed], np.int64),
    }
    for key, frames in images.items():
        features[f"steps/observation/{key}"] = [
            simplejpeg.encode_jpeg(frame, quality=JPEG_QUALITY, colorsubsampling="444") for frame in frames
        ]
    start = 0
    for key, dim in spec.action_layout:
        name = f"steps/action/{key}" if spec.dict_actions else "steps/action"
        features[name] = np.ascontiguousarray(rollout.actions[i, :steps, start : start + dim]).ravel()
        start += dim
    return features


def write_info(
    directory: Path,
    name: str,
    features: Any,
    lengths: list[int],
    size: int,
    description: str,
    metadata: dict,
    module: str = "data_pipelines.suite",
) -> None:
    """features.json, dataset_info.json and metadata.json of one split, by tfds itself.

    `lengths`: records of each shard; `size`: bytes of all their payloads; `module` made them.
    """
    import tensorflow_datasets as tfds
    from tensorflow_datasets.core.dataset_info import DatasetIdentity

    identity = DatasetIdentity(
        name=name,
        version=tfds.core.Version(VERSION),
        data_dir=str(directory),
        module_name=module,
    )
    template = tfds.core.ShardedFileTemplate(
        data_dir=directory, dataset_name=name, split="train", filetype_suffix="tfrecord"
    )
    split = tfds.core.SplitInfo(
        name="train", shard_lengths=lengths, num_bytes=size, filename_template=template
    )
    info = tfds.core.DatasetInfo(
        builder=identity,
        description=description,
        features=features,
        metadata=tfds.core.MetadataDict(metadata),
    )
    info.set_file_format("tfrecord")
    info.set_splits(tfds.core.splits.SplitDict([split]))
    info.write_to_directory(directory)
    features.save_config(str(directory))
