"""The frozen evaluation set: the held-out windows on which every trial of a study is measured.

Owns the choice of windows, its file, and their batches. Measures nothing.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.registry import FRAME_RATE
from data_pipelines.sampling.order import hash64, stream_seed
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.counterfactual import CounterfactualFrames
from data_pipelines.windows.other_actions import OtherWindows
from data_pipelines.windows.slicer import make_slicer
from data_pipelines.windows.windows import least_judged, require_windows, val_windows
from hma_jax.config import ConfigError, require
from hma_jax.config.json import from_dict, stable_hash, to_dict
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.runtime.files import write_file


@dataclass(frozen=True)
class DatasetWindows:
    """The windows of one dataset: (episode position in the val split, start) pairs."""

    dataset: str
    windows: tuple[tuple[int, int], ...]
    reason: str = ""  # why there are none


@dataclass(frozen=True)
class ChoiceSettings:
    """The settings of `EvalConfig` that bound a choice of windows. Different settings may lead to the same choice."""

    windows_per_dataset: int
    prompt_frames: int | None  # None: all windows are whole


@dataclass(frozen=True)
class EvalManifest:
    """A frozen choice of held-out windows. Datasets are sorted by name. Its hash is over the compared fields."""

    frames: int  # T
    seed: int
    spacing: int  # model frames between starts of windows in one episode
    store: str  # hash of the datasets' manifests
    datasets: tuple[DatasetWindows, ...] = field(default_factory=tuple)
    rate: float | None = FRAME_RATE  # frame rate in Hz; None: native
    least: int = 0  # real frames of the shortest window
    settings: ChoiceSettings | None = field(default=None, compare=False)  # None: not recorded

    def hash(self) -> str:
        return stable_hash({f.name: getattr(self, f.name) for f in fields(self) if f.compare})

    @property
    def names(self) -> tuple[str, ...]:
        """Datasets that have windows."""
        return tuple(d.dataset for d in self.datasets if d.windows)

    @property
    def empty(self) -> dict[str, str]:
        """Datasets without a window, and why."""
        return {d.dataset: d.reason for d in self.datasets if not d.windows}

    def subsampled(self, max_windows: int) -> EvalManifest:
        """This set with at most `max_windows` of each dataset, as `subsample_windows` chooses them."""
        datasets = (replace(d, windows=subsample_windows(d.windows, max_windows)) for d in self.datasets)
        return replace(self, datasets=tuple(datasets))

    def save(self, path: str | Path) -> None:
        """Writes JSON with its own hash, completely or not at all. Raises ConfigError if it cannot be written."""
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, json.dumps({"hash": self.hash(), **to_dict(self)}, indent=1) + "\n")
        except OSError as error:
            reason = error.strerror or error
            raise ConfigError(f"{path}: cannot be written ({reason}). Choose another path.") from error

    @classmethod
    def load(cls, path: str | Path) -> EvalManifest:
        """Reads what `save` wrote. Raises DataError if it is missing, damaged or was edited."""
        advice = "Freeze the evaluation set again; results on the old one are not comparable."
        try:
            values = json.loads(Path(path).read_text())
            stated, manifest = values.pop("hash", None), from_dict(cls, values)
            values.pop("settings", None)
            found = stable_hash(values)
        except OSError as error:
            reason = error.strerror or error
            raise DataError(f"{path}: the evaluation set cannot be read ({reason}). {advice}") from error
        except (ValueError, AttributeError, TypeError) as error:
            raise DataError(f"{path}: not an evaluation set ({error}). {advice}") from error
        if found != stated:  # hash of the file's own fields, without those that came later
            raise DataError(f"{path}: its contents do not match the hash in it, {stated}: it was changed. {advice}")
        return manifest


def subsample_windows(frozen: Sequence[tuple[int, int]], count: int) -> tuple[tuple[int, int], ...]:
    """Up to `count` of the windows (episode, start), from as many episodes as possible: errors are clustered by
    episode.

    Every episode gives one window before any gives a second. If there are more episodes than windows to choose, they
    are taken at equal distances, since neighbouring episodes share a scene or a day.
    """
    seen: defaultdict[int, int] = defaultdict(int)
    rounds: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)  # a window of each episode that has one left
    for window in frozen:
        rounds[seen[window[0]]].append(window)
        seen[window[0]] += 1
    chosen: list[tuple[int, int]] = []
    for windows in rounds.values():
        taken = min(len(windows), count - len(chosen))
        chosen += [windows[i * len(windows) // taken] for i in range(taken)]
    return tuple(sorted(chosen))


def freeze_manifest(
    store: TokenStore,
    datasets: Sequence[str],
    frames: int,
    windows_per_dataset: int,
    seed: int,
    *,
    rate: float | None,
    prompt: int | None = None,
) -> EvalManifest:
    """Chooses up to `windows_per_dataset` held-out windows of each dataset, by hash.

    A window has at least `prompt` + 1 real frames; all `frames` if there is no prompt, or if the prompt fills the
    window, as a policy's may. Windows are disjoint, so that standard errors do not count the same pixels twice.
    DIFFERS: the release evaluates the first windows of each dataset (reference section 6.1).

    Raises DataError if no dataset has a window.
    """
    require(windows_per_dataset >= 1, f"windows_per_dataset must be at least 1, got {windows_per_dataset}")
    require(len(datasets) >= 1, "no dataset was given to evaluate on")
    least = frames if prompt is None else least_judged(prompt, frames)
    sets = {name: val_windows(store, name, frames, least, rate=rate) for name in sorted(set(datasets))}
    require_windows(sets)
    chosen, shortest, settings = [], frames, ChoiceSettings(windows_per_dataset, prompt)
    for name, windows in sets.items():
        apart = np.flatnonzero(windows.start % (frames * windows.slicer.spacing) == 0)
        order = np.argsort(hash64(apart, stream_seed(seed, "evaluation", name)), kind="stable")
        picked = np.sort(apart[order[:windows_per_dataset]])
        pairs = tuple(windows.locate(int(i)) for i in picked)
        steps = store.manifest(name).val.steps
        shortest = min([shortest, *(int(windows.slicer.max_real(steps[episode])) for episode, _ in pairs)])
        chosen.append(DatasetWindows(name, pairs, "" if pairs else windows.why_empty()))
    return EvalManifest(frames, seed, frames, store.hash(tuple(sets)), tuple(chosen), rate, shortest, settings)


def eval_batches(
    store: TokenStore,
    table: EmbodimentTable,
    manifest: EvalManifest,
    batch: int,
    datasets: Sequence[str] | None = None,
    *,
    first: int | None = None,
    other_actions: int = 0,
    counterfactual: CounterfactualFrames | None = None,
    prompt: int | None = None,
) -> Iterator[dict]:
    """Batches of the frozen windows (of each dataset the `first` ones, or all), dataset by dataset.

    A batch may hold windows of several datasets; the last one is padded to `batch` rows.
    `tokens` int32 [B, T, S] or, for latents, float32 [B, T, S, C], `actions` float32 [B, T, U] (raw units),
    `embodiment` int32 [B], `images` uint8 [B, T, H, W, 3] (recorded), `valid` bool [B] (False for padding, which
    repeats the last window), and what names a window, the same whatever the batch size and the choice of datasets:
    `dataset`, a list of B names, `episode` int32 [B] (its number in the source) and `start` int32 [B] (native frame).
    `action_mean` and `action_std` float32 [B, U] are those of all training actions of the dataset, whichever of them a
    model was trained on; random actions are drawn from them. If the manifest has short windows, `real` bool [B, T] says
    which frames are not padding.

    `other_actions` adds this many action sequences per window, from other episodes of the same robot (see
    `OtherWindows`): `other_actions` float32 [B, other_actions, T, U], and `other_valid` bool [B, other_actions], False
    where there are fewer. `counterfactual`, made for these windows and for the `prompt` (EvalConfig.prompt_frames) that
    they are judged after, adds the frames that the first of these sequences leads to: `other_images` uint8 [B, T, H, W,
    3] (the recorded ones up to the prompt), and `other_seen` bool [B], False for robots that are not simulated and for
    windows that no other episode's actions cover.

    Raises ConfigError if the store differs from the frozen one, lacks raw frames, or a
    dataset is not in the manifest or in `table`, and for a `counterfactual` of other windows, of another prompt, or
    without `other_actions`.
    """
    require(batch >= 1, f"batch must be at least 1, got {batch}")
    frozen = {d.dataset: d for d in manifest.datasets}
    wanted = manifest.names if datasets is None else tuple(datasets)
    unknown = [name for name in wanted if name not in frozen]
    require(not unknown, f"not in the evaluation set: {', '.join(unknown)}; it has {', '.join(frozen)}")
    require(
        store.hash(tuple(frozen)) == manifest.store,
        f"{store.root}: the token store is not the one on which the evaluation set was frozen. Freeze the set again, "
        "or restore the store.",
    )
    for name in wanted:
        require(
            store.manifest(name).settings.keep_frames != "none",
            f"{store.root / name}: no raw frames to compare with. Tokenise it with keep_frames='val'.",
        )
    store.check_table(table, wanted, manifest.rate)
    require(
        counterfactual is None or counterfactual.manifest == manifest.hash(),
        "the frames under other actions were made for other windows than the frozen ones; prepare the study again",
    )
    require(
        counterfactual is None or other_actions > 0,
        "the frames under other actions need these actions; ask for other_actions of at least 1",
    )
    require(
        counterfactual is None or counterfactual.prompt == prompt,
        f"the frames under other actions were made for prompt {counterfactual and counterfactual.prompt}, so they "
        f"cannot be compared with what follows prompt {prompt}; prepare the study again with this eval.prompt_frames",
    )
    windows = [(name, *window) for name in wanted for window in frozen[name].windows[:first]]
    return _batches(_Rows(store, table, manifest, wanted, other_actions, counterfactual), batch, windows)


def _batches(rows_of: _Rows, batch: int, windows: Sequence[tuple[str, int, int]]) -> Iterator[dict]:
    for at in range(0, len(windows), batch):
        rows = [rows_of(*window) for window in windows[at : at + batch]]
        count = len(rows)
        rows += rows[-1:] * (batch - count)
        columns = {key: [row[key] for row in rows] for key in rows[0]}
        names = columns.pop("dataset")
        yield {
            **{key: np.stack(column) for key, column in columns.items()},
            "dataset": names,
            "valid": np.arange(batch) < count,
        }


class _Rows:
    """(dataset, episode, start) to one row of a batch."""

    def __init__(
        self,
        store: TokenStore,
        table: EmbodimentTable,
        manifest: EvalManifest,
        names: Sequence[str],
        other_actions: int,
        counterfactual: CounterfactualFrames | None,
    ):
        self._table, self._names = table, tuple(names)
        # A record holds all frames of an episode, and its windows follow one another.
        self._episode = lru_cache(1)(store.episode)
        self._slicers = {name: make_slicer(store, name, manifest.frames, manifest.rate) for name in names}
        self._some_are_short = 0 < manifest.least < manifest.frames
        self._count, self._counterfactual = other_actions, counterfactual
        self._other_windows = OtherWindows(store, self._slicers, manifest.frames, manifest.rate, manifest.seed)
        self._at = {(d.dataset, *window): i for d in manifest.datasets for i, window in enumerate(d.windows)}
        if names:
            self._statistics = store.embodiment_table(names, manifest.rate).statistics()

    def __call__(self, name: str, episode: int, start: int) -> dict:
        slicer, item = self._slicers[name], self._episode(name, "val", episode)
        width = self._table.action_width
        mean, std = (x[self._names.index(name)] for x in self._statistics)
        row = {
            "tokens": slicer.tokens(item, start),
            "actions": slicer.chunks(item.actions, start, width),
            "images": slicer.slice_frames(item.frames, item, start),
            "embodiment": np.int32(self._table.index(name)),
            "dataset": name,
            "episode": np.int32(item.episode),
            "start": np.int32(start * slicer.frame_step),
            "action_mean": np.pad(mean, (0, width - len(mean))),
            "action_std": np.pad(std, (0, width - len(std))),
        }
        if self._some_are_short:
            row["real"] = slicer.real_mask(item, start)
        if self._count:
            row |= self._other_actions(name, episode, start, width)
        return row | self._other_images(name, episode, start, row) if self._counterfactual else row

    def _other_actions(self, name: str, episode: int, start: int, width: int) -> dict:
        chosen = self._other_windows.choose(name, episode, start, self._count)
        actions = self._other_windows.actions(name, chosen, width)
        missing = self._count - len(chosen)
        return {
            "other_actions": np.pad(actions, [(0, missing), (0, 0), (0, 0)]),
            "other_valid": np.arange(self._count) < len(chosen),
        }

    def _other_images(self, name: str, episode: int, start: int, row: dict) -> dict:
        images, frames = row["images"], self._counterfactual.frames.get(name)
        if frames is None or not row["other_valid"][0]:
            return {"other_images": images, "other_seen": np.False_}
        seen = np.concatenate([images[: self._counterfactual.prompt], frames[self._at[name, episode, start]]])
        return {"other_images": seen, "other_seen": np.True_}
