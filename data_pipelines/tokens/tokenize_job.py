"""Tokenises the episodes of any source into one dataset of the token store.

Owns what is stored of the episodes: which are held out, which frames are kept, how frames of many episodes are encoded
in batches of equal size. Prefetching is in `read_ahead`; parts, restarts, several processes and publishing are in
`dataset_writer`.
DIFFERS: in the release a bad step ends an episode whose frames and segment ids are half written, and everything after
it is misaligned (reference section 5.1). Here an episode is stored completely, or recorded as skipped with its file and
offset.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from data_pipelines.errors import MAX_LISTED, EpisodeError
from data_pipelines.registry import DatasetSpec
from data_pipelines.sampling.splits import HeldOut, used_episodes
from data_pipelines.sources.identity import EpisodeRun
from data_pipelines.sources.open import open_source
from data_pipelines.sources.rlds.images import decoding_threads, fit_image
from data_pipelines.sources.source import MAX_SKIPPED, Corrupt, EpisodeSource, count_skippable
from data_pipelines.tokens.dataset_writer import PART_SIZE, Progress, cut_parts, write_dataset
from data_pipelines.tokens.encoder import Encoder
from data_pipelines.tokens.episode_record import StoredEpisode, token_dtype
from data_pipelines.tokens.manifest import (
    RECIPE_VERSION,
    JobSettings,
    Manifest,
    SkippedEpisodes,
    SplitFacts,
    TokenizerFacts,
    rate_in_words,
)
from data_pipelines.tokens.part_files import Part, PartItem
from data_pipelines.tokens.read_ahead import Begin, End, frames_ahead
from data_pipelines.tokens.turns import TurnWatch
from hma_jax.config import require
from hma_jax.config.json import to_dict

if TYPE_CHECKING:
    from data_pipelines.sources.joined import Parts
    from data_pipelines.sources.rlds.location import Location
    from hma_jax.tokenizers.base import Tokenizer


def tokenize_dataset(
    spec: DatasetSpec,
    directory: str | Location | Parts,
    tokenizer: Tokenizer,
    store_root: str | Path,
    *,
    held_out: HeldOut,
    rate: float | None,
    keep_frames: Literal["none", "val", "all"] = "val",
    frame_step: int | None = None,
    batch: int = 256,
    threads: int | None = None,
    part_size: int = PART_SIZE,
    corrupt: Corrupt = "raise",
    max_skipped: float = MAX_SKIPPED,
    overwrite: bool = False,
    wait: bool = True,
    progress: Progress | None = None,
    warn: Callable[[str], None] | None = None,
) -> Manifest | None:
    """Tokenises one dataset into `<store_root>/<spec.name>` and returns its manifest.

    `frame_step`: native frames per stored frame; by default the stride at `rate` Hz (None: native), which it must
    divide. 1 stores all frames and serves every rate. At least `batch` images are encoded at a time (rounded up to fill
    the devices), `threads` (default: one per core, up to 8) decode. If the store already has this dataset, made from
    the same shards in the same way, nothing is done. Any number of processes may run the same call, and start and be
    killed at any time: each makes parts that no other process makes. `progress(done, total)` counts the episodes of all
    processes; `warn` is called about values of the action that look like wrapping angles, in the parts that this
    process makes. With `wait` the call waits for the parts of other processes; without, it returns None while parts are
    missing. The bytes of the dataset depend on `spec`, source, tokenizer, `part_size` and the settings of JobSettings
    only.

    Raises ConfigError for keys, settings or a store directory that cannot work, and, unless `overwrite`, for a dataset
    in its place that was made differently; DataError for damaged data (see `EpisodeSource`).
    """
    require(batch >= 1, f"batch must be at least 1, got {batch}")
    source = open_source(directory, spec.split, corrupt=corrupt, max_skipped=max_skipped)
    source.check_keys(spec.image_key, spec.action_keys, spec.action_dims)
    plan = plan_dataset(
        spec, source, tokenizer, held_out, keep_frames=keep_frames, frame_step=frame_step, rate=rate,
    )  # fmt: skip
    watch = TurnWatch(spec, warn or (lambda _: None))
    work = _Work(source, plan, tokenizer, batch, threads or decoding_threads(), watch)
    try:
        manifest = write_dataset(
            store_root,
            plan,
            cut_parts(source.sizes()[work.episodes], part_size),
            work.make,
            skipped=work.skipped,
            max_skipped=count_skippable(max_skipped, work.wanted) if corrupt == "skip" else 0,
            overwrite=overwrite,
            wait=wait,
            progress=progress,
        )
    finally:  # what was read so far is not read again if the job ends here
        watch.look()
    source.save_steps()
    return manifest


def plan_dataset(
    spec: DatasetSpec,
    source: EpisodeSource,
    tokenizer: Tokenizer,
    held_out: HeldOut,
    *,
    rate: float | None,
    keep_frames: Literal["none", "val", "all"] = "val",
    frame_step: int | None = None,
) -> Manifest:
    """The manifest of a dataset before it is made.

    Raises ConfigError for settings that cannot work."""
    frame_step = resolve_frame_step(spec, frame_step, rate)
    held_out = _without_idle_limit(spec, source.runs, held_out)
    return Manifest(
        spec=spec.facts(),
        tokenizer=tokenizer_facts(tokenizer),
        settings=JobSettings(**to_dict(held_out), keep_frames=keep_frames, frame_step=frame_step),
        source=source.fingerprint(),
        source_version=source.version,
        action_mean=(),
        action_std=(),
        train=SplitFacts(),
        val=SplitFacts(),
        runs=source.runs,
        recipe=RECIPE_VERSION,
    )


def plan_again(
    existing: Manifest,
    spec: DatasetSpec,
    held_out: HeldOut,
    *,
    rate: float | None,
    frame_step: int | None = None,
) -> Manifest:
    """The plan for an `existing` dataset with its present entry and settings, for the same recordings and tokenizer: no
    source is opened. Raises ConfigError for settings that cannot work."""
    joins = existing.spec.joins if spec.joins else ()  # those that are given
    held_out = _without_idle_limit(existing.spec, existing.runs, held_out)
    return replace(
        existing,
        spec=replace(spec.facts(), joins=joins),
        settings=replace(existing.settings, **to_dict(held_out), frame_step=resolve_frame_step(spec, frame_step, rate)),
        recipe=RECIPE_VERSION,
    )


def _without_idle_limit(spec: DatasetSpec, runs: Sequence[EpisodeRun], held_out: HeldOut) -> HeldOut:
    """The same amounts, without a `max_train` that leaves no episode out: the store is then the same as without it."""
    if held_out.max_train is None or not runs:
        return held_out
    train, val = used_episodes(spec, runs, held_out)
    return replace(held_out, max_train=None) if (train | val).all() else held_out


def resolve_frame_step(spec: DatasetSpec, frame_step: int | None, rate: float | None) -> int:
    """Native frames per stored frame: `frame_step` or, if that is None, the stride at `rate` Hz (None: native). Raises
    ConfigError if the step does not divide that stride."""
    stride = spec.stride_at(rate)
    frame_step = stride if frame_step is None else frame_step
    require(
        frame_step >= 1 and stride % frame_step == 0,
        f"dataset {spec.name!r}: frame_step {frame_step} does not divide the stride {stride} of "
        f"{rate_in_words(rate if spec.rate is None else spec.rate)}",
    )
    return frame_step


def tokenizer_facts(tokenizer: Tokenizer) -> TokenizerFacts:
    """What a manifest says about a tokenizer, which has the same fields."""
    return TokenizerFacts(**{f.name: getattr(tokenizer, f.name) for f in fields(TokenizerFacts)})


@dataclass
class _Pending:
    """An episode whose frames are being encoded."""

    begin: Begin
    keep: bool
    frame_count: int = 0  # frames given to the encoder
    frames: list[np.ndarray] = field(default_factory=list)
    end: End | None = None  # None: more frames are to come


class _Work:
    """Makes the parts of one dataset."""

    def __init__(
        self,
        source: EpisodeSource,
        plan: Manifest,
        tokenizer: Tokenizer,
        batch: int,
        threads: int,
        watch: TurnWatch,
    ):
        self._source, self._plan, self._threads, self._watch = source, plan, threads, watch
        self._tokenizer, self._batch = tokenizer, batch
        self._dtype = token_dtype(plan.tokenizer.vocab_size, plan.tokenizer.channels)
        self._numbers = source.numbers
        train, val = used_episodes(plan.spec, source.runs, plan.settings.held_out)
        self._is_val = val[self._numbers]
        self.episodes = np.flatnonzero((train | val)[self._numbers])
        """int64: positions in the source of the episodes that are read. Parts are ranges of them."""
        self.wanted = int((train | val).sum())
        """How many episodes there should be, including unreadable ones."""

    @property
    def skipped(self) -> list[SkippedEpisodes]:
        """Wanted episodes that the source cannot give, before one is opened."""
        reasons = {self._source.without_location(why): n for why, n in sorted(self._source.skipped.items())}
        if self._plan.settings.max_train is None:
            return [SkippedEpisodes(why, episodes=n) for why, n in reasons.items()]
        missing = self.wanted - len(self.episodes)  # it is not known which of the reasons belong to these
        return [SkippedEpisodes(" ".join([*reasons][:MAX_LISTED]), episodes=missing)] if missing else []

    def make(self, part: Part) -> Iterator[PartItem]:
        """The episodes of a part, in order. An unusable one is skipped, or raised, as the source's policy says."""
        spec, size = self._plan.spec, self._plan.tokenizer.image_size
        items = frames_ahead(
            self.episodes[part.first : part.end].tolist(),
            lambda i: self._source.open_episode(i, spec.image_key, spec.action_keys),
            lambda image: spec.correct(fit_image(image, size)),
            3 * size * size,
            self._plan.frame_step,
            self._threads,
        )
        pending: deque[_Pending] = deque()
        with closing(items), Encoder(self._tokenizer, self._batch) as encoder:
            for item in items:
                if isinstance(item, Begin):
                    pending.append(_Pending(item, self._keeps(item.index)))
                elif isinstance(item, End):
                    if not pending or pending[-1].begin.index != item.index:  # it could not be opened
                        pending.append(_Pending(Begin(item.index, np.zeros((0, 0)), None), False))
                    pending[-1].end = item
                else:
                    pending[-1].frame_count += 1
                    if pending[-1].keep:
                        pending[-1].frames.append(item)
                    encoder.put(item)
                yield from self._finished(pending, encoder)
            encoder.flush()
            yield from self._finished(pending, encoder)

    def _split(self, index: int) -> str:
        return "val" if self._is_val[index] else "train"

    def _keeps(self, index: int) -> bool:
        return self._plan.settings.keep_frames in ("all", self._split(index))

    def _finished(self, pending: deque[_Pending], encoder: Encoder) -> Iterator[PartItem]:
        """Takes the episodes from `pending` that have all their tokens."""
        while pending and pending[0].end is not None and encoder.ready >= pending[0].frame_count:
            episode = pending.popleft()
            tokens = encoder.take(episode.frame_count) if episode.frame_count else None
            if episode.end.error is not None:
                yield self._skip(episode.end.error)
                continue
            begin = episode.begin
            self._watch.see(begin.actions)
            frames = np.stack(episode.frames) if episode.keep else None
            episode.frames.clear()
            yield (
                self._split(begin.index),
                StoredEpisode(
                    int(self._numbers[begin.index]),
                    begin.success,
                    tokens.astype(self._dtype),
                    self._plan.spec.convert(begin.actions),
                    frames,
                ),
            )

    def _skip(self, error: EpisodeError) -> SkippedEpisodes:
        if self._source.corrupt == "raise":
            raise error
        file, offset = (error.path.name, error.offset) if error.path is not None else ("", -1)
        return SkippedEpisodes(self._source.without_location(str(error)), file, offset)
