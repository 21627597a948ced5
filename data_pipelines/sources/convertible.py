"""Sources that can be converted: read unit by unit, in order, each unit giving some whole episodes.

A unit is what a format reads at a time: a demonstration, an episode, a video (not a unit of measurement). Owns what
these formats have in common.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol

import numpy as np

from data_pipelines.errors import EpisodeError
from data_pipelines.sources.rlds.schema import FlatFeature, step_key
from data_pipelines.sources.rlds.writer import STEP_FIELDS, TEXT, Field, vector_field
from hma_jax.config import ConfigError


class UnitError(EpisodeError):
    """One unit of a source is unusable; `--skip-damaged`, or corrupt='skip', skips it."""


def unsupported_images_text(keys: Iterable[str]) -> str:
    """A message on image fields that cannot be read as cameras, such as depth images."""
    return f"not used as cameras: {', '.join(keys)}; docs/own_data.md says what is a camera"


@dataclass(frozen=True)
class Layout:
    """The fields of a source's steps, by flat key: cameras, and float32 vectors with their sizes."""

    images: Mapping[str, Field]
    vectors: Mapping[str, int]
    knows_success: bool

    def flat_features(self, unsupported_images: Mapping[str, tuple[int, ...]]) -> dict[str, FlatFeature]:
        """The fields as `EpisodeSource.features` has them, with the `unsupported_images` (key -> shape) first."""
        return {
            **{
                step_key(key): FlatFeature(image=False, size=0, shape=shape)
                for key, shape in unsupported_images.items()
            },
            **{step_key(key): FlatFeature(image=True, size=0, dtype="uint8") for key in self.images},
            **{step_key(key): FlatFeature(image=False, size=size) for key, size in self.vectors.items()},
        }

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
class Skipped:
    """A part of a unit that gives no episode, and why; reasons are counted and reported."""

    reason: str


class ConvertibleSource(Protocol):
    """An opened source. Every byte that is written follows from its settings and `units`."""

    layout: Layout
    hz: float
    description: str
    units: Sequence[str]

    def identity(self) -> dict[str, Any]:
        """JSON values that are different for another source or other settings."""
        ...

    def read(self, unit: int) -> Iterator[Episode | Skipped]:
        """The episodes of `units[unit]`, in order. Raises UnitError for a damaged unit."""
        ...


def require_module(name: str, needed_by: str = "this format") -> ModuleType:
    """An optional library of the extra `convert`. Raises ConfigError, saying what needs it and how to install it, if it
    is missing."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ConfigError(
            f"{needed_by} needs the package {name.partition('.')[0]!r}, which cannot be imported "
            f"({error}); install the extra with: pip install 'hma-jax[convert]'"
        ) from error


def choose(wanted: Sequence[str], available: Sequence[str], what: str, where: str) -> tuple[str, ...]:
    """`wanted`, or all that are available if none is given. Raises ConfigError for one that is not available."""
    missing = [name for name in wanted if name not in available]
    if missing:
        raise ConfigError(
            f"{where}: no {what} {', '.join(map(repr, missing))}; it has {', '.join(available) or 'none'}."
        )
    return tuple(wanted) or tuple(available)
