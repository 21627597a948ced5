"""What a converter reads and the writer writes: a source made of units, each of some episodes.

A unit is what a source reads in one go: a demonstration, an episode, a video. Conversion can stop
and go on between units.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.registry import DatasetSpec
from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.writer import STEP_FIELDS, TEXT, Field, step_features, vector_field
from hma_jax.config import ConfigError


class UnitError(DataError):
    """One unit of a source is unusable; `--skip-damaged` leaves it out."""


@dataclass(frozen=True)
class Layout:
    """The fields of a source's steps, by flat key: cameras, and float32 vectors with their sizes."""

    images: Mapping[str, Field]
    vectors: Mapping[str, int]
    knows_success: bool

    def step_fields(self) -> dict[str, Field]:
        vectors = {key: vector_field(size) for key, size in self.vectors.items()}
        return {**self.images, **vectors, **STEP_FIELDS}

    def episode_fields(self) -> dict[str, Field]:
        success = {"success": Field("bool")} if self.knows_success else {}
        return {"file_path": Field(TEXT), **success}


@dataclass(frozen=True)
class Episode:
    """One episode of N steps. `images`: encoded frames; `vectors`: float [N, size]."""

    origin: str  # for people: where in the source it came from
    images: Mapping[str, Sequence[bytes]]
    vectors: Mapping[str, np.ndarray]
    instructions: Sequence[str]
    rewards: np.ndarray | None = None
    success: bool | None = None


@dataclass(frozen=True)
class LeftOut:
    """A stretch of a unit that makes no episode, and why; reasons are counted and reported."""

    reason: str


class Source(Protocol):
    """An opened source. Its settings and `units` decide every byte that is written."""

    layout: Layout
    hz: float
    description: str
    units: Sequence[str]

    def identity(self) -> dict[str, Any]:
        """JSON facts that tell another source or other settings apart."""
        ...

    def read(self, unit: int) -> Iterator[Episode | LeftOut]:
        """The episodes of `units[unit]`, in order. Raises UnitError for a damaged unit."""
        ...


@dataclass(frozen=True)
class Conversion:
    """What a finished conversion wrote."""

    directory: Path
    spec: DatasetSpec  # the registry entry that reads it
    episodes: int
    shards: int
    left_out: dict[str, int] = field(default_factory=dict)


def encode(episode: Episode, layout: Layout) -> bytes:
    """The record of `episode`. Raises UnitError where it contradicts `layout`, naming the field."""
    steps = len(episode.instructions)
    if not steps:
        raise UnitError(f"{episode.origin}: an episode without a step; leave it out.")
    rewards = np.zeros(steps, np.float32) if episode.rewards is None else np.asarray(episode.rewards)
    if rewards.shape != (steps,):
        raise UnitError(f"{episode.origin}: {rewards.shape} rewards for {steps} steps.")
    features = step_features(rewards, episode.instructions)
    features["episode_metadata/file_path"] = [episode.origin.encode()]
    if layout.knows_success:
        features["episode_metadata/success"] = np.array([bool(episode.success)], np.int64)
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


def require_module(name: str) -> ModuleType:
    """An optional library of the extra `convert`; ConfigError that says how to get it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(
            f"this conversion needs the package {name.partition('.')[0]!r}, which cannot be imported "
            f"({error}); install the extra with: pip install 'hma-jax[convert]'"
        ) from error


def choose(wanted: Sequence[str], there: Sequence[str], what: str, where: str) -> tuple[str, ...]:
    """`wanted`, or all that are there; ConfigError for one that is not."""
    missing = [name for name in wanted if name not in there]
    if missing:
        raise ConfigError(
            f"{where}: no {what} {', '.join(map(repr, missing))}; it has {', '.join(there) or 'none'}."
        )
    return tuple(wanted) or tuple(there)
