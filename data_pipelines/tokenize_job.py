"""RLDS episodes in, one dataset of the token store out.

Owns the job: which episodes are held out, what is kept of them, action statistics, the
manifest. A dataset appears in the store only when it is complete; an interrupted job leaves
a hidden directory that the next one removes.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from array_record.python import array_record_module

from data_pipelines.episode_record import StoredEpisode, encode_episode, token_dtype
from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.images import fit_image
from data_pipelines.manifest import (
    FILE,
    SPLITS,
    JobSettings,
    Manifest,
    SplitFacts,
    TokenizerFacts,
    load_manifest,
)
from data_pipelines.registry import DatasetSpec
from data_pipelines.rlds import MAX_SKIPPED, RawEpisode, RldsDataset
from data_pipelines.splits import held_out
from hma_jax.config import ConfigError, diff, require

if TYPE_CHECKING:
    from hma_jax.tokenizers.base import Tokenizer

READ_AHEAD = 4  # episodes decoded while earlier ones are encoded


def tokenize_dataset(
    spec: DatasetSpec,
    directory: str | Path,
    tokenizer: Tokenizer,
    store_root: str | Path,
    *,
    val_fraction: float = 0.05,
    min_val: int = 2,
    max_val: int = 200,
    keep_frames: Literal["none", "val", "all"] = "val",
    frame_step: int | None = None,
    batch: int = 256,
    corrupt: Literal["raise", "skip"] = "raise",
    max_skipped: int = MAX_SKIPPED,
    progress: Callable[[int, int], None] | None = None,
) -> Manifest:
    """Tokenises one dataset into `<store_root>/<spec.name>` and returns its manifest.

    `frame_step`: every how many native frames one is stored; default the stride (the 2 Hz
    frames), 1 stores all phases; it must divide the stride. `batch` images are encoded at a
    time. `progress(done, total)` counts episodes. If the store already has this dataset made
    from the same shards in the same way, nothing is done.

    Raises ConfigError for keys, settings or a store directory that cannot work, DataError for
    damaged data (see `RldsDataset`).
    """
    frame_step = spec.stride if frame_step is None else frame_step
    require(
        frame_step >= 1 and spec.stride % frame_step == 0,
        f"dataset {spec.name!r}: frame_step {frame_step} does not divide the stride {spec.stride}",
    )
    require(batch >= 1, f"batch must be at least 1, got {batch}")
    source = RldsDataset(directory, spec.split, corrupt=corrupt, max_skipped=max_skipped)
    source.check_keys(spec.image_key, spec.action_keys, spec.action_dims)
    plan = Manifest(
        spec=spec.facts(),
        tokenizer=_facts(tokenizer),
        settings=JobSettings(val_fraction, min_val, max_val, keep_frames, frame_step),
        source=source.fingerprint(),
        source_version=source.version,
        action_mean=(),
        action_std=(),
        train=SplitFacts(),
        val=SplitFacts(),
    )
    final = Path(store_root) / spec.name
    if final.exists():
        return _reuse(final, plan)
    aside = final.with_name(f".{spec.name}.partial")
    try:
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        manifest = _write(aside, source, plan, tokenizer, batch, progress)
        (aside / FILE).write_text(manifest.to_text())
        os.replace(aside, final)
    except OSError as error:
        raise ConfigError(
            f"{final}: the token store cannot be written there ({error.strerror or error}). "
            "Choose a directory on a disk with space where you may write."
        ) from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
    return manifest


def _facts(tokenizer: Tokenizer) -> TokenizerFacts:
    return TokenizerFacts(
        identity=tokenizer.identity,
        image_size=tokenizer.image_size,
        grid=tokenizer.grid,
        tokens=tokenizer.tokens,
        vocab_size=tokenizer.vocab_size,
        factors=tokenizer.factors,
        factor_vocab=tokenizer.factor_vocab,
        channels=tokenizer.channels,
    )


def _reuse(final: Path, plan: Manifest) -> Manifest:
    """The manifest that is there, if it was made as planned; ConfigError naming what differs."""
    there = load_manifest(final / FILE)
    inputs = ("spec", "tokenizer", "settings", "source")
    changes = [line for name in inputs for line in diff(getattr(there, name), getattr(plan, name), name)]
    require(
        not changes,
        f"{final}: already tokenised in another way ({'; '.join(changes)}). "
        "Choose another store directory, or remove this dataset from the store.",
    )
    return there


def _write(
    directory: Path,
    source: RldsDataset,
    plan: Manifest,
    tokenizer: Tokenizer,
    batch: int,
    progress: Callable[[int, int], None] | None,
) -> Manifest:
    s = plan.settings
    is_val = held_out(plan.spec.name, len(source), s.val_fraction, s.min_val, s.max_val)
    splits = {name: _SplitWriter(directory, name, s.keep_frames in ("all", name)) for name in SPLITS}
    moments = _Moments(plan.spec.action_dim)
    pending: list[tuple[RawEpisode, np.ndarray]] = []  # episodes whose frames wait for a full batch
    dtype = token_dtype(plan.tokenizer.vocab_size, plan.tokenizer.channels)
    done = 0

    def flush() -> None:
        nonlocal done
        if not pending:
            return
        images = np.concatenate([frames for _, frames in pending])
        parts = [tokenizer.encode(images[i : i + batch]) for i in range(0, len(images), batch)]
        ends = np.cumsum([len(frames) for _, frames in pending])[:-1]
        for (raw, frames), tokens in zip(pending, np.split(np.concatenate(parts), ends), strict=True):
            name = "val" if is_val[raw.index] else "train"
            if name == "train":
                moments.add(raw.actions)
            splits[name].add(raw, np.asarray(tokens).astype(dtype), frames)
        done += len(pending)
        pending.clear()
        if progress is not None:
            progress(done, len(source))

    for raw, frames in _episodes(source, plan):
        pending.append((raw, frames))
        if sum(len(f) for _, f in pending) >= batch:
            flush()
    flush()
    if not moments.count:
        raise DataError(f"{source.directory}: no usable episode is left to train on.")
    mean, std = moments.result()
    return replace(
        plan,
        action_mean=mean,
        action_std=std,
        train=splits["train"].close(),
        val=splits["val"].close(),
        skipped={k.replace(f"{source.directory}/", ""): n for k, n in sorted(source.skipped.items())},
    )


def _episodes(source: RldsDataset, plan: Manifest) -> Iterator[tuple[RawEpisode, np.ndarray]]:
    """Decoded episodes in order, read ahead in a thread (image decoding releases the GIL)."""

    def read(i: int) -> tuple[RawEpisode, np.ndarray]:
        raw = source.episode(i, plan.spec.image_key, plan.spec.action_keys, plan.frame_step)
        return raw, np.stack([fit_image(image, plan.tokenizer.image_size) for image in raw.images])

    with ThreadPoolExecutor(max_workers=1) as pool:
        ahead = deque(pool.submit(read, i) for i in range(min(READ_AHEAD, len(source))))
        for i in range(len(source)):
            try:
                yield ahead.popleft().result()
            except EpisodeError as error:
                source.skip(error)
            if i + READ_AHEAD < len(source):
                ahead.append(pool.submit(read, i + READ_AHEAD))


class _SplitWriter:
    """Appends episodes to one ArrayRecord file and keeps its facts."""

    def __init__(self, directory: Path, name: str, keep_frames: bool):
        # Tokens do not compress; frames do. One record per group gives true random access.
        options = "group_size:1" if keep_frames else "group_size:1,uncompressed"
        self._writer = array_record_module.ArrayRecordWriter(str(directory / f"{name}.array_record"), options)
        self._keep_frames = keep_frames
        self._episodes: list[int] = []
        self._steps: list[int] = []
        self._content = hashlib.sha256()

    def add(self, raw: RawEpisode, tokens: np.ndarray, frames: np.ndarray) -> None:
        kept = frames if self._keep_frames else None
        record = encode_episode(StoredEpisode(raw.index, raw.success, tokens, raw.actions, kept))
        self._writer.write(record)
        self._content.update(record)
        self._episodes.append(raw.index)
        self._steps.append(raw.steps)

    def close(self) -> SplitFacts:
        try:
            self._writer.close()
        except RuntimeError as error:  # how ArrayRecord reports a full disk, if only here
            raise OSError(str(error)) from error
        return SplitFacts(tuple(self._episodes), tuple(self._steps), self._content.hexdigest()[:32])


class _Moments:
    """Mean and standard deviation over rows, merged episode by episode in float64."""

    def __init__(self, dim: int):
        self.count = 0
        self._mean = np.zeros(dim)
        self._square = np.zeros(dim)  # sum of squared deviations from the mean

    def add(self, rows: np.ndarray) -> None:
        rows = rows.astype(np.float64)
        mean = rows.mean(axis=0)
        total = self.count + len(rows)
        step = mean - self._mean
        self._square += ((rows - mean) ** 2).sum(axis=0) + step**2 * (self.count * len(rows) / total)
        self._mean += step * (len(rows) / total)
        self.count = total

    def result(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        std = np.sqrt(self._square / self.count)
        return tuple(self._mean.tolist()), tuple(std.tolist())
