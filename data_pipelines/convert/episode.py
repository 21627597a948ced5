"""An episode of any source as a record, and the result of a conversion."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from data_pipelines.registry import DatasetSpec
from data_pipelines.sources.convertible import Episode, Layout, UnitError
from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.writer import step_features


@dataclass(frozen=True)
class Conversion:
    """What a finished conversion wrote."""

    directory: Path
    spec: DatasetSpec  # the registry entry that reads it
    episodes: int
    shards: int
    skipped: dict[str, int] = field(default_factory=dict)  # reason -> how many


def encode(episode: Episode, layout: Layout) -> bytes:
    """The record of `episode`. Raises UnitError, naming the field, if it contradicts `layout`."""
    steps = len(episode.instructions)
    if not steps:
        raise UnitError(f"{episode.origin}: the episode has no steps.")
    rewards = np.zeros(steps, np.float32) if episode.rewards is None else np.asarray(episode.rewards)
    if rewards.shape != (steps,):
        raise UnitError(f"{episode.origin}: {rewards.shape} rewards for {steps} steps.")
    features = step_features(rewards, episode.instructions)
    features["episode_metadata/file_path"] = [episode.origin.encode()]
    if layout.knows_success:
        if episode.success is None:  # a record cannot say "unknown", and unknown must not be taken for failure
            raise UnitError(f"{episode.origin}: it does not say whether it succeeded, but other recordings do.")
        features["episode_metadata/success"] = np.array([episode.success], np.int64)
    for key in layout.images:
        frames = list(episode.images[key])
        if len(frames) != steps:
            raise UnitError(f"{episode.origin}: {len(frames)} frames in {key!r} for {steps} steps.")
        features[f"steps/{key}"] = frames
    for key, size in layout.vectors.items():
        rows = np.asarray(episode.vectors[key])
        if rows.shape != (steps, size):
            raise UnitError(
                f"{episode.origin}: {key!r} has the shape {list(rows.shape)}, but {steps} steps of {size} "
                "values were expected."
            )
        finite = np.isfinite(rows).all(axis=1)
        if not finite.all():
            step = int(np.flatnonzero(~finite)[0])
            raise UnitError(f"{episode.origin}: {key!r} is not finite at step {step}: {rows[step].tolist()}.")
        features[f"steps/{key}"] = rows.astype(np.float32).ravel()
    return encode_example(features)
