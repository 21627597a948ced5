"""Several datasets as one `EpisodeSource`: the recordings of one robot in several directories, of any formats.

Owns what holds for all parts together: the order and names of their episodes, and the limit on damaged ones. An episode
is named by its part and by its name there, so that it keeps its name whatever else is joined.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from data_pipelines.sources.source import Corrupt, EpisodeSource, OpenEpisode, same_rate
from hma_jax.config import ConfigError, require

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location


@dataclass(frozen=True)
class Parts:
    """Locations of the parts of a joined dataset, in the order of its entry."""

    name: str  # name of the joined dataset
    places: tuple[Location, ...]


class JoinedSource(EpisodeSource):
    """The episodes of `parts`, one part after the other. Raises ConfigError for parts of different rates, DataError for
    more unusable episodes in all of them than `max_skipped`."""

    def __init__(self, name: str, parts: Sequence[EpisodeSource], corrupt: Corrupt, max_skipped: float):
        super().__init__(corrupt, max_skipped)
        first = parts[0]
        self.name, self.parts = name, tuple(parts)
        self.split, self.location, self.schema = first.split, first.location, first.schema
        self.version = ", ".join(dict.fromkeys(part.version for part in parts if part.version))
        self.features = {key: f for key, f in first.features.items() if all(key in part.features for part in parts)}
        self.runs = tuple(replace(run, file=f"{part.name}/{run.file}") for part in parts for run in part.runs)
        self.files = sum(part.files for part in parts)
        self._ends = np.cumsum([len(part) for part in parts])
        self._check_rates()
        for part in parts:
            for reason, episodes in part.skipped.items():
                self.count_skipped(reason, episodes)

    def __len__(self) -> int:
        return int(self._ends[-1])

    @property
    def numbers(self) -> np.ndarray:
        named = [sum(run.count for run in part.runs) for part in self.parts]
        firsts = np.cumsum([0, *named[:-1]])
        return np.concatenate([first + part.numbers for first, part in zip(firsts, self.parts, strict=True)])

    @property
    def hz(self) -> float | None:
        return next((part.hz for part in self.parts if part.hz is not None), None)

    def fingerprint(self) -> str:
        """Hash over the parts' names and fingerprints, in order."""
        return self._hash([part.fingerprint() for part in self.parts])

    def fingerprint_with_texts(self) -> str:
        return self._hash([part.fingerprint_with_texts() for part in self.parts])

    def _hash(self, fingerprints: Sequence[str]) -> str:
        text = ";".join(f"{part.name}:{own}" for part, own in zip(self.parts, fingerprints, strict=True))
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def sizes(self) -> np.ndarray:
        return np.concatenate([part.sizes() for part in self.parts])

    def steps(self) -> np.ndarray:
        return np.concatenate([part.steps() for part in self.parts])

    def save_steps(self) -> None:
        for part in self.parts:
            part.save_steps()

    def open_episode(self, i: int, image_key: str, action_keys: Sequence[str]) -> AbstractContextManager[OpenEpisode]:
        part, own = self._part(i)
        return part.open_episode(own, image_key, action_keys)

    def frames(self, i: int, image_key: str, choose: Callable[[int], Sequence[int]]) -> list[np.ndarray]:
        part, own = self._part(i)
        return part.frames(own, image_key, choose)

    def record(self, i: int, keys: Sequence[str]) -> dict[str, Any]:
        part, own = self._part(i)
        return part.record(own, keys)

    def check_keys(self, image_key: str, action_keys: Sequence[str], action_dims: Sequence[int] | None = None) -> None:
        """Like `EpisodeSource.check_keys`, for every part."""
        for n, part in enumerate(self.parts):
            try:
                part.check_keys(image_key, action_keys, action_dims)
            except ConfigError as error:
                if not n:
                    raise
                before = ", ".join(f"{other.name} ({other.schema})" for other in self.parts[:n])
                raise ConfigError(
                    f"{error} {self.name} joins it with {before}, where the same keys are right; if it cannot be read "
                    f"by them, leave {part.name} out of `joins`."
                ) from error

    def without_location(self, reason: str) -> str:
        """`reason` with the name of the part in place of its location."""
        for part in sorted(self.parts, key=lambda part: len(str(part.location)), reverse=True):
            reason = reason.replace(str(part.location), part.name) if part.location.name else reason
        return reason

    def _part(self, i: int) -> tuple[EpisodeSource, int]:
        """The part that contains episode `i`, and the episode's position there."""
        if not 0 <= i < len(self):
            raise IndexError(f"{self.name}: episode {i} of {len(self)}")
        k = int(np.searchsorted(self._ends, i, side="right"))
        return self.parts[k], i - (int(self._ends[k - 1]) if k else 0)

    def _check_rates(self) -> None:
        known = [part for part in self.parts if part.hz is not None]
        for part in known:
            require(
                same_rate(part.hz, known[0].hz),
                f"{self.name} joins recordings of different rates: {known[0].location} at {known[0].hz:g} Hz, "
                f"{part.location} at {part.hz:g} Hz. Leave one of them out of `joins`, with an entry of its own.",
            )
