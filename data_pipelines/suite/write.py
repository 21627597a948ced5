"""One dataset of the suite on disk, laid out as tensorflow_datasets writes RLDS.

Owns fields and records of one dataset. What happens in an episode comes
from `rollout`, its pictures from `render`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.sources.rlds import writer as rlds_writer
from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.writer import (
    STEP_FIELDS,
    TEXT,
    Field,
    encode_jpeg,
    image_field,
    step_features,
    vector_field,
    write_info,
    write_shards,
)
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import positions_of, render_frames
from data_pipelines.suite.rollout import Rollout, episode_seeds, simulate
from data_pipelines.suite.spec import IMAGE_KEY, IMAGE_SIZE, EmbodimentSpec

BLOCK = 16
"""Episodes rendered together."""


def build_features(spec: EmbodimentSpec) -> Any:
    """The tfds features of this robot's episodes."""
    step = {
        f"observation/{IMAGE_KEY}": image_field(IMAGE_SIZE, IMAGE_SIZE),
        "observation/state": vector_field(spec.body.size),
        "observation/position": Field("float32", (len(spec.points), 2)),
    }
    step |= {key: vector_field(dim) for key, dim in spec.action_layout}
    episode = {"file_path": Field(TEXT), "success": Field("bool"), "seed": Field("int64")}
    return rlds_writer.build_features(step | STEP_FIELDS, episode)


def write_dataset(
    spec: EmbodimentSpec, directory: Path, *, episodes: Mapping[str, int], seed: int, metadata: Mapping[str, Any]
) -> None:
    """Simulates and writes a whole dataset into `directory`. `episodes` counts them by split. Not atomic: `generate`
    passes a scratch directory."""
    seeds = {split: episode_seeds(spec, count, seed, split) for split, count in episodes.items()}
    rollout = simulate(spec, np.concatenate(list(seeds.values())))
    written, first = {}, 0
    for split, count in episodes.items():
        own = range(first, first + count)
        frames = int(rollout.lengths[own].sum())
        written[split] = write_shards(directory, spec.name, split, own, frames, partial(_records, spec, rollout))
        first = own.stop
    write_info(
        directory,
        name=spec.name,
        features=build_features(spec),
        splits=written,
        description=f"Simulated robot of the family {spec.family!r} ({spec.convention} actions, {spec.hz} Hz).",
        metadata={**metadata, "positions": list(spec.points)},
        module="data_pipelines.suite",
    )


def _records(spec: EmbodimentSpec, rollout: Rollout, start: int, stop: int) -> Iterator[bytes]:
    """Serialised examples of episodes start..stop-1."""
    for first in range(start, stop, BLOCK):
        block = np.arange(first, min(first + BLOCK, stop))
        looks = draw_appearance(spec, rollout.seeds[block])
        episode = np.repeat(np.arange(len(block)), rollout.lengths[block])
        q = np.concatenate([rollout.q[i, : rollout.lengths[i]] for i in block])
        objects = np.concatenate([rollout.objects[i, : rollout.lengths[i]] for i in block])
        frames = render_frames(spec, looks, rollout.goals[block], q, objects, episode)
        positions = positions_of(spec, q, objects)
        for k, i in enumerate(block):
            yield encode_example(_features(spec, rollout, int(i), frames[episode == k], positions[episode == k]))


def _features(
    spec: EmbodimentSpec, rollout: Rollout, i: int, frames: np.ndarray, positions: np.ndarray
) -> dict[str, np.ndarray | list[bytes]]:
    """Flattened tf.Example features of episode i with its frames uint8 [T, H, W, 3] and positions [T, P, 2]."""
    steps = int(rollout.lengths[i])
    reward = np.zeros(steps, np.float32)
    if rollout.success[i]:
        reward[rollout.reached[i]] = 1.0
    features: dict[str, np.ndarray | list[bytes]] = {
        **step_features(reward, [spec.instruction] * steps),  # is_terminal at the end, though the clock ends it
        f"steps/observation/{IMAGE_KEY}": [encode_jpeg(frame) for frame in frames],
        "steps/observation/state": rollout.q[i, :steps].astype(np.float32).ravel(),
        "steps/observation/position": positions.ravel(),
        "episode_metadata/file_path": [f"suite/{spec.name}/{rollout.seeds[i]}".encode()],
        "episode_metadata/success": np.array([rollout.success[i]], np.int64),
        "episode_metadata/seed": np.array([rollout.seeds[i]], np.int64),
    }
    start = 0
    for key, dim in spec.action_layout:
        features[f"steps/{key}"] = np.ascontiguousarray(rollout.actions[i, :steps, start : start + dim]).ravel()
        start += dim
    return features
