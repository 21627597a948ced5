"""The manifest of one tokenised dataset: what it was made from, how, and what it holds.

Owns the facts and their JSON. It holds no path and no time, so tokenising the same data in
the same way gives the same manifest, and its hash identifies the data of a run.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.registry import FRAME_RATE, DatasetSpec
from data_pipelines.tokens.moments import Moments
from hma_jax.config import ConfigError, require
from hma_jax.config.json import from_dict, stable_hash, to_dict
from hma_jax.model.embodiments import Embodiment

FILE = "manifest.json"
SPLITS = ("train", "val")
LISTS = ("episodes", "steps")
"""Lists with an entry per episode: up to millions, so no code looks at them one by one."""

LATER = (("spec", "rate", None), ("settings", "max_val_fraction", 0.5))
"""Fields that stores of earlier versions lack, and what holds for those: their hash stays what it was."""

FORMAT = 2
"""Of the store's layout; 1 had one file per split."""


@dataclass(frozen=True)
class TokenizerFacts:
    """Which tokenizer, and the shape of what it makes."""

    identity: str  # hash of its configuration and weights
    image_size: int
    grid: int
    tokens: int  # S
    vocab_size: int  # 0, as the next two, where tokens are latents
    factors: int  # Q
    factor_vocab: int  # V
    channels: int = 0  # C of latents; 0: tokens are ids


@dataclass(frozen=True)
class JobSettings:
    """What a tokenising job may choose. Equal settings on equal input give equal stores."""

    val_fraction: float = 0.05
    min_val: int = 2
    max_val: int = 200
    keep_frames: str = "val"  # which splits keep raw frames: none, val or all
    frame_step: int = 1  # stored frames are every frame_step-th native one
    max_val_fraction: float = 0.5  # of a dataset, whatever min_val says

    def __post_init__(self):
        require(0 <= self.val_fraction < 1, f"val_fraction must lie in [0, 1), got {self.val_fraction}")
        require(0 <= self.min_val <= self.max_val, f"min_val {self.min_val} exceeds max_val {self.max_val}")
        require(
            0 < self.max_val_fraction <= 0.5,
            f"max_val_fraction must lie in (0, 0.5], got {self.max_val_fraction}",
        )
        require(
            self.keep_frames in ("none", "val", "all"),
            f"keep_frames must be none, val or all, got {self.keep_frames!r}",
        )


@dataclass(frozen=True)
class SplitFacts:
    """The episodes of one split, in store order."""

    episodes: tuple[int, ...] = ()  # index in the source
    steps: tuple[int, ...] = ()  # native frames N
    content: str = ""  # hash over all records
    parts: tuple[int, ...] = ()  # episodes in each part; there is no file for 0

    @property
    def native_frames(self) -> int:
        return sum(self.steps)


@dataclass(frozen=True)
class Loss:
    """Episodes that could not be used."""

    reason: str
    file: str = ""  # name of the shard or file they lie in
    offset: int = -1  # of the record's first byte there; -1: unknown
    episodes: int = 1


@dataclass(frozen=True)
class Manifest:
    """Everything a reader must know of `<store>/<dataset>`."""

    spec: DatasetSpec
    tokenizer: TokenizerFacts
    settings: JobSettings
    source: str  # fingerprint of the shards
    source_version: str
    action_mean: tuple[float, ...]  # over native actions of the train split, raw units
    action_std: tuple[float, ...]
    train: SplitFacts
    val: SplitFacts
    action_min: tuple[float, ...] = ()
    action_max: tuple[float, ...] = ()
    skipped: tuple[Loss, ...] = ()  # what was left out
    format: int = FORMAT

    def stride_at(self, rate: float | None = FRAME_RATE) -> int:
        """Native frames per model frame at `rate` Hz (None: native). ConfigError if such frames are not stored."""
        stride = self.spec.stride_at(rate)
        own = rate if self.spec.rate is None else self.spec.rate
        require(
            stride % self.frame_step == 0,
            f"{self.spec.name}: {rate_in_words(own)} is every {ordinal(stride)} recorded frame, the "
            f"token store keeps every {ordinal(self.frame_step)}. Tokenise it again with frames for any rate, "
            "`hma tokenize ... --set store.frame_step=1 --replace tokens`, or choose another rate.",
        )
        return stride

    @property
    def frame_step(self) -> int:
        """Native frames per stored frame."""
        return self.settings.frame_step

    @property
    def lost(self) -> int:
        """Episodes left out."""
        return sum(loss.episodes for loss in self.skipped)

    def split(self, name: str) -> SplitFacts:
        require(name in SPLITS, f"split must be 'train' or 'val', got {name!r}")
        return self.train if name == "train" else self.val

    def _without_lists(self) -> Manifest:
        """Small, however many episodes there are."""
        empty = dict.fromkeys(LISTS, ())
        return replace(self, train=replace(self.train, **empty), val=replace(self.val, **empty))

    def embodiment(self, rate: float | None = FRAME_RATE, moments: Moments | None = None) -> Embodiment:
        """The model's view of this dataset's actions at `rate`; `moments` are of the actions that count, if
        those are not all of the train split's."""
        return Embodiment(
            self.spec.name,
            self.spec.action_dim,
            self.stride_at(rate),
            self.action_mean if moments is None else moments.mean,
            self.action_std if moments is None else moments.std,
            self.spec.video_targets,
            self.spec.action_layout(),
        )

    def hash(self) -> str:
        lists = (getattr(self.split(s), name) for s in SPLITS for name in LISTS)
        digests = [hashlib.sha256(np.asarray(x, "<i8").tobytes()).hexdigest() for x in lists]
        facts = to_dict(self._without_lists())
        for group, field, as_before in LATER:
            if facts[group][field] == as_before:
                del facts[group][field]
        return stable_hash([facts, digests])

    def to_text(self) -> str:
        """Deterministic JSON, long lists on one line."""
        values = to_dict(self._without_lists())
        for split in SPLITS:
            values[split] |= {name: getattr(self.split(split), name) for name in LISTS}
        lines = [f" {json.dumps(k)}: {json.dumps(v, sort_keys=True)}" for k, v in sorted(values.items())]
        return "{\n" + ",\n".join(lines) + "\n}\n"


def rate_in_words(rate: float | None) -> str:
    return "the native rate" if rate is None else f"{rate:g} Hz"


def ordinal(number: int) -> str:
    """'1st', '2nd', ..."""
    ending = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{ending}"


def part_name(split: str, part: int, parts: int) -> str:
    """The file with a part's episodes of one split."""
    return f"{split}-{part:05d}-of-{parts:05d}.array_record"


def load_manifest(path: Path) -> Manifest:
    """Reads a manifest. Raises DataError if it is missing, damaged or of another format."""
    advice = "Remove the dataset from the store and tokenise it again."
    try:
        values = json.loads(path.read_text())
        if values.get("format") != FORMAT:
            raise DataError(
                f"{path}: manifest format {values.get('format')!r}; this reads {FORMAT}. {advice}"
            )
        lists = {s: {name: _integers(values[s].pop(name), f"{s}.{name}") for name in LISTS} for s in SPLITS}
        manifest = from_dict(Manifest, values)
        return replace(manifest, **{s: replace(manifest.split(s), **lists[s]) for s in SPLITS})
    except OSError as error:
        raise DataError(f"{path}: the manifest cannot be read ({error.strerror}). {advice}") from error
    except (ValueError, AttributeError, TypeError, KeyError) as error:
        if isinstance(error, ConfigError):
            raise DataError(f"{path}: not a manifest of this program: {error}. {advice}") from error
        raise DataError(f"{path}: the manifest is damaged ({error}). {advice}") from error


def _integers(values: list, name: str) -> tuple[int, ...]:
    array = np.asarray(values or np.zeros(0, np.int64))
    require(array.ndim == 1 and array.dtype.kind == "i", f"{name}: expected a list of integers")
    return tuple(array.tolist())
