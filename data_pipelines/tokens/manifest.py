"""The manifest of one tokenised dataset: what it was made from, how, and what it holds.

Owns its two files: `manifest.json`, and `episodes.columns` with the columns that have an entry per episode; columns are
read when they are used. A manifest holds no path and no time, so tokenising the same data in the same way gives the
same manifest, and its hash identifies the data of a run.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.columns import Column, write_columns
from data_pipelines.errors import DataError
from data_pipelines.names import MANIFEST
from data_pipelines.registry import DatasetSpec
from data_pipelines.sampling.splits import HeldOut
from data_pipelines.sources.identity import EpisodeRun, runs_of_parts
from data_pipelines.tokens.moments import Moments
from data_pipelines.tokens.row_sample import ActionRange, quantiles_vary
from hma_jax.config import require
from hma_jax.config.base import later
from hma_jax.config.json import identity_of, stable_hash
from hma_jax.config.training import ActionScale
from hma_jax.model.embodiments import Embodiment

FILE = MANIFEST
SPLITS = ("train", "val")
COLUMNS_FILE = "episodes.columns"
EPISODE_COLUMNS = ("episodes", "steps")
"""Columns of `SplitFacts` with an entry per episode: up to millions, so no code loops over them."""

RECIPE_VERSION = 1
"""Raise it when a change to the code alters what `tokenize_job` stores for the same source: tokens of an older version
are then refused if new ones are asked for."""

FORMAT_VERSION = 3
"""The version of the store's layout; no other can be read."""


@dataclass(frozen=True)
class TokenizerFacts:
    """Which tokenizer was used, and the shape of its tokens."""

    identity: str  # hash of its configuration and weights
    image_size: int
    grid: int
    tokens: int  # S
    vocab_size: int  # 0, like the next two, if tokens are latents
    factors: int  # Q
    factor_vocab: int  # V
    channels: int = 0  # C of latents; 0: tokens are ids


@dataclass(frozen=True)
class JobSettings(HeldOut):
    """The settings of a tokenising job. Equal settings on equal input give equal stores; `max_train` is set only if it
    leaves episodes out."""

    max_val_fraction: float = later(0.5)  # new stores use the value of `HeldOut`
    keep_frames: str = "val"  # which splits keep raw frames: none, val or all
    frame_step: int = 1  # stored frames are every frame_step-th native one

    def __post_init__(self):
        self.check()
        require(self.frame_step >= 1, f"frame_step must be at least 1, got {self.frame_step}")
        require(
            self.keep_frames in ("none", "val", "all"),
            f"keep_frames must be none, val or all, got {self.keep_frames!r}",
        )


@dataclass(frozen=True)
class SplitFacts:
    """The episodes of one split, in store order."""

    episodes: Sequence[int] = ()  # number in the source, counting damaged ones
    steps: Sequence[int] = ()  # native frames N
    content: str = ""  # hash over all records
    parts: tuple[int, ...] = ()  # episodes in each part; there is no file for 0

    def __post_init__(self):
        for name in EPISODE_COLUMNS:
            values = getattr(self, name)
            if len(values) and not isinstance(values, Column):
                object.__setattr__(self, name, Column(values))

    @property
    def native_frames(self) -> int:
        return int(np.sum(self.steps, dtype=np.int64))


@dataclass(frozen=True)
class SkippedEpisodes:
    """Unusable episodes of one file, or a single one, and why they were left out."""

    reason: str
    file: str = ""  # name of the shard or file they lie in
    offset: int = -1  # of the record's first byte there; -1: unknown
    episodes: int = 1


@dataclass(frozen=True)
class Manifest:
    """Everything that reading `<store>/<dataset>` needs."""

    spec: DatasetSpec
    tokenizer: TokenizerFacts
    settings: JobSettings
    source: str  # fingerprint of the shards
    source_version: str
    action_mean: tuple[float, ...]  # statistics over native actions of the train split, raw units
    action_std: tuple[float, ...]
    train: SplitFacts
    val: SplitFacts
    action_min: tuple[float, ...] = ()
    action_max: tuple[float, ...] = ()
    action_quantiles: tuple[tuple[float, ...], ...] = later(())  # one row per `row_sample.QUANTILES`
    skipped: tuple[SkippedEpisodes, ...] = ()  # what was left out
    # Names of all episodes of the source, by number; (): only numbers.
    runs: tuple[EpisodeRun, ...] = later(())
    recipe: int = later(1)  # RECIPE_VERSION of the code that made it
    format: int = FORMAT_VERSION

    def stride_at(self, rate: float | None) -> int:
        """Native frames per model frame at `rate` Hz (None: native). Raises ConfigError if such frames are not
        stored."""
        stride = self.spec.stride_at(rate)
        own = rate if self.spec.rate is None else self.spec.rate
        require(
            stride % self.frame_step == 0,
            f"{self.spec.name}: {rate_in_words(own)} needs every {ordinal(stride)} recorded frame, but the token "
            f"store keeps every {ordinal(self.frame_step)}. Tokenise all frames, with `hma tokenize ... --set "
            "store.frame_step=1 --replace tokens`, or choose another rate.",
        )
        return stride

    @property
    def frame_step(self) -> int:
        """Native frames per stored frame."""
        return self.settings.frame_step

    @property
    def skipped_count(self) -> int:
        """Number of episodes left out."""
        return sum(entry.episodes for entry in self.skipped)

    @property
    def left_out(self) -> int:
        """Number of episodes of the source that the setting `max_train` leaves out."""
        return sum(self.episodes_of_parts) - len(self.train.episodes) - len(self.val.episodes) - self.skipped_count

    @property
    def episodes_of_parts(self) -> list[int]:
        """How many episodes the source has, including left out and skipped ones; for a joined dataset, of each part."""
        if self.runs:
            return [sum(run.count for run in own) for own in runs_of_parts(self.runs).values()]
        return [len(self.train.episodes) + len(self.val.episodes) + self.skipped_count]

    def split(self, name: str) -> SplitFacts:
        require(name in SPLITS, f"split must be 'train' or 'val', got {name!r}")
        return self.train if name == "train" else self.val

    def _without_episodes(self) -> Manifest:
        """This manifest without the columns that have an entry per episode."""
        empty = dict.fromkeys(EPISODE_COLUMNS, ())
        return replace(self, train=replace(self.train, **empty), val=replace(self.val, **empty))

    def embodiment(
        self,
        rate: float | None,
        moments: Moments | None = None,
        scale: ActionScale = "deviation",
        action_range: ActionRange | None = None,
    ) -> Embodiment:
        """The model's view of this dataset's actions at `rate`. `moments` and `action_range` are those of the
        trajectories that are used; by default, of the whole train split.

        With the scale `quantiles`, a value that varies, but is the same number up to rounding (`DEAD_STD`) from its 1 %
        to its 99 % quantile, is scaled by its extremes. Raises DataError for a manifest without quantiles.
        """
        return self._embodiment(self.stride_at(rate), moments, scale, action_range)

    def check(self) -> None:
        """Raises ConfigError unless its parts fit each other."""
        self._embodiment(self.frame_step, None, "deviation", None)

    def _embodiment(
        self,
        stride: int,
        moments: Moments | None,
        scale: ActionScale,
        action_range: ActionRange | None,
    ) -> Embodiment:
        action_range = action_range or ActionRange(self.action_quantiles, self.action_min, self.action_max)
        low, high = self._quantile_scale(action_range) if scale == "quantiles" else ((), ())
        return Embodiment(
            self.spec.name,
            self.spec.action_dim,
            stride,
            self.action_mean if moments is None else moments.mean,
            self.action_std if moments is None else moments.std,
            self.spec.video_targets,
            low=low,
            high=high,
            layout=self.spec.action_layout(),
        )

    def _quantile_scale(self, action_range: ActionRange) -> tuple[tuple[float, ...], tuple[float, ...]]:
        if not self.action_mean:
            return (), ()
        if not action_range.quantiles:
            raise DataError(
                f"{self.spec.name}: the manifest of its tokens has no quantiles of actions. "
                "Remove the dataset from the store and tokenise it again, or use --set train.action_scale=deviation."
            )
        first, last, vary = (
            action_range.quantiles[0],
            action_range.quantiles[-1],
            quantiles_vary(action_range.quantiles),
        )
        low = np.where(vary, first, action_range.low or first)
        high = np.where(vary, last, action_range.high or last)
        return tuple(low.tolist()), tuple(high.tolist())

    def hash(self) -> str:
        return stable_hash([self._facts(), list(self._digests().values())])

    def _facts(self) -> dict[str, Any]:
        """All except the episode columns, as plain JSON: equal for stores that differ only in their version."""
        return identity_of(self._without_episodes())

    def _columns(self) -> dict[str, Column]:
        return {f"{s}.{name}": getattr(self.split(s), name) or Column() for s in SPLITS for name in EPISODE_COLUMNS}

    def _digests(self) -> dict[str, str]:
        """SHA-256 of each column; format 2 hashed 64-bit integers."""
        columns = self._columns()
        if self.format == 2:
            columns = {name: Column(np.asarray(values), "<i8") for name, values in columns.items()}
        return {name: values.digest() for name, values in columns.items()}

    def save(self, directory: Path, scratch: Path) -> None:
        """Writes the manifest's files to `directory`, the manifest itself last. `scratch` holds temporary files, on the
        same disk. Raises OSError."""
        write_columns(scratch / COLUMNS_FILE, {}, {k: np.asarray(v) for k, v in self._columns().items()})
        os.replace(scratch / COLUMNS_FILE, directory / COLUMNS_FILE)
        values = self._facts() | {"columns": self._digests()}
        for split in SPLITS:
            values[split] = {k: v for k, v in values[split].items() if k not in EPISODE_COLUMNS}
        lines = [f" {json.dumps(k)}: {json.dumps(v, sort_keys=True)}" for k, v in sorted(values.items())]
        with open(scratch / FILE, "w") as out:
            out.write("{\n" + ",\n".join(lines) + "\n}\n")
            out.flush()
            os.fsync(out.fileno())
        os.replace(scratch / FILE, directory / FILE)


def rate_in_words(rate: float | None) -> str:
    return "the native rate" if rate is None else f"{rate:g} Hz"


def ordinal(number: int) -> str:
    """'1st', '2nd', ..."""
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def part_name(split: str, part: int, parts: int) -> str:
    """The file with a part's episodes of one split."""
    return f"{split}-{part:05d}-of-{parts:05d}.array_record"
