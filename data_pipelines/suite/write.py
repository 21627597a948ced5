"""One dataset of the suite on disk, laid out as tensorflow_datasets writes RLDS.

Owns fields, records and shards of one dataset. What happens in an episode comes
from `rollout`, its pictures from `render`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.sources.rlds import writer as rlds_writer
from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.tfrecord import write_shard
from data_pipelines.sources.rlds.writer import (
    STEP_FIELDS,
    TEXT,
    Field,
    encode_jpeg,
    image_field,
    shard_name,
    step_features,
    vector_field,
    write_info,
)
from data_pipelines.suite.appearance import Appearance, draw_appearance
from data_pipelines.suite.render import frame_index, render_frames
from data_pipelines.suite.rollout import Rollout, simulate
from data_pipelines.suite.spec import EmbodimentSpec

SHARD_FRAMES = 4000
"""About this many native frames go into one shard."""

BLOCK = 16
"""Episodes rendered together."""


def build_features(spec: EmbodimentSpec) -> Any:
    """The tfds features of this embodiment's episodes."""
    prefix = "action/" if spec.dict_actions else ""
    step = {f"observation/{c.key}": image_field(c.height, c.width) for c in spec.cameras}
    step["observation/state"] = vector_field(spec.body.size)
    step |= {prefix + key: vector_field(dim) for key, dim in spec.action_layout}
    episode = {"file_path": Field(TEXT), "success": Field("bool"), "seed": Field("int64")}
    return rlds_writer.build_features(step | STEP_FIELDS, episode)


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
        path = directory / shard_name(spec.name, k, shards)
        records = episode_records(spec, rollout, looks, bounds[k], bounds[k + 1], seed)
        lengths.append(write_shard(path, records))
        size += path.stat().st_size - 16 * lengths[-1]  # tfds counts payload bytes, not framing
    write_info(
        directory,
        name=spec.name,
        features=build_features(spec),
        lengths=lengths,
        size=size,
        description=f"Simulated embodiment ({spec.kind}, {spec.convention} actions, {spec.hz} Hz).",
        metadata=metadata,
    )
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
    reward = np.zeros(steps, np.float32)
    if rollout.success[i]:
        reward[rollout.reached[i]] = 1.0
    features: dict[str, np.ndarray | list[bytes]] = {
        **step_features(reward, [spec.instruction] * steps),
        "steps/observation/state": rollout.q[i, :steps].astype(np.float32).ravel(),
        "episode_metadata/file_path": [f"suite/{spec.name}/{i:06d}".encode()],
        "episode_metadata/success": np.array([rollout.success[i]], np.int64),
        "episode_metadata/seed": np.array([seed], np.int64),
    }
    for key, frames in images.items():
        features[f"steps/observation/{key}"] = [encode_jpeg(frame) for frame in frames]
    start = 0
    for key, dim in spec.action_layout:
        name = f"steps/action/{key}" if spec.dict_actions else "steps/action"
        features[name] = np.ascontiguousarray(rollout.actions[i, :steps, start : start + dim]).ravel()
        start += dim
    return features
