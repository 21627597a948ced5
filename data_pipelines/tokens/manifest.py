"""The manifest of one tokenised dataset: what it was made from, how, and what it holds.

Owns the facts and their JSON. It holds no path and no time, so tokenising the same data in
the same way gives the same manifest, and its hash identifies the data of a run.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.registry import DatasetSpec
from hma_jax.config import ConfigError, require
from hma_jax.config.json import from_dict, stable_hash, to_dict
from hma_jax.config.training import ActionScale
from hma_jax.model.embodiments import Embodiment

FILE = "manifest.json"
SPLITS = ("train", "val")
LISTS = ("episodes", "steps")
"""Lists with an entry per episode: up to millions, so no code looks at them one by one."""

LATER = ("angles", "angle_form", "angle_unit", "episodes", "median_steps", "mean_steps")
"""Fields of a spec that manifests of earlier versions lack: where they say nothing, the hash stays what it was."""

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

    def __post_init__(self):
        require(0 <= self.val_fraction < 1, f"val_fraction must lie in [0, 1), got {self.val_fraction}")
        require(0 <= self.min_val <= self.max_val, f"min_val {self.min_val} exceeds max_val {self.max_val}")
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
    action_quantiles: tuple[tuple[float, ...], ...] = ()  # one row per `row_sample.QUANTILES`
    skipped: tuple[Loss, ...] = ()  # what was left out
    format: int = FORMAT

    @property
    def stride(self) -> int:
        """Native frames per model frame."""
        return self.spec.stride

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

    def embodiment(
        self, scale: ActionScale = "deviation", quantiles: Sequence[Sequence[float]] | None = None
    ) -> Embodiment:
        """The model's view of this dataset's actions. `quantiles`, as `row_sample.QUANTILES` lists them, are of the
        actions that count, if those are not all of the train split's.

        By `quantiles`, a value that is one number from 1 % to 99 % and yet varies is measured by its
        extremes. Raises DataError for a manifest of a version that kept no quantiles.
        """
        low, high = self._quantile_scale(quantiles or self.action_quantiles) if scale == "quantiles" else ((), ())
        return Embodiment(
            self.spec.name,
            self.spec.action_dim,
            self.stride,
            self.action_mean,
            self.action_std,
            self.spec.video_targets,
            low,
            high,
        )

    def _quantile_scale(
        self, quantiles: Sequence[Sequence[float]]
    ) -> tuple[tuple[float, ...], tuple[float, ...]]:
        if not self.action_mean:
            return (), ()
        if not quantiles:
            raise DataError(
                f"{self.spec.name}: its tokens were made by a version that kept no quantiles of actions. Remove the "
                "dataset from the store and tokenise it again, or use --set train.action_scale=deviation."
            )
        pairs = zip(quantiles[0], quantiles[-1], self.action_min, self.action_max, strict=True)
        chosen = [(a, b) if b > a else (least, most) for a, b, least, most in pairs]
        return tuple(a for a, _ in chosen), tuple(b for _, b in chosen)

    def hash(self) -> str:
        lists = (getattr(self.split(s), name) for s in SPLITS for name in LISTS)
        digests = [hashlib.sha256(np.asarray(x, "<i8").tobytes()).hexdigest() for x in lists]
        facts = to_dict(self._without_lists())
        said = to_dict(DatasetSpec("", "", (), (), 1.0))
        for name in LATER:
            if facts["spec"][name] == said[name]:
                del facts["spec"][name]
        if not facts["action_quantiles"]:
            del facts["action_quantiles"]
        return stable_hash([facts, digests])

    def to_text(self) -> str:
        """Deterministic JSON, long lists on one line."""
        values = to_dict(self._without_lists())
        for split in SPLITS:
            values[split] |= {name: getattr(self.split(split), name) for name in LISTS}
        lines = [f" {json.dumps(k)}: {json.dumps(v, sort_keys=True)}" for k, v in sorted(values.items())]
        return "{\n" + ",\n".join(lines) + "\n}\n"


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
