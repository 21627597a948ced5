"""Writes any source as one RLDS directory, resumable after every shard.

`<out>/<name>/1.0.0` appears when it is complete. Until then shards lie in a hidden directory beside it, with a
journal of the finished ones. An interrupted conversion continues after the last of them, and the result has the
same bytes as an uninterrupted one. One process at a time converts to a directory (see `publishing`).
"""

from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError, without_advice
from data_pipelines.publishing.files import publish, sync
from data_pipelines.publishing.fingerprint import FINGERPRINT, read_metadata, shard_lengths
from data_pipelines.publishing.journal import Journal
from data_pipelines.publishing.output_lock import lock_output
from data_pipelines.registry import DatasetSpec
from data_pipelines.sources.convertible import ConvertibleSource, Episode, Layout, Skipped, UnitError
from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.schema import RATE_KEY
from data_pipelines.sources.rlds.tfrecord import write_shard
from data_pipelines.sources.rlds.writer import VERSION, build_features, shard_name, step_features, write_info
from data_pipelines.sources.source import action_fields
from hma_jax.config import require
from hma_jax.config.json import stable_hash

CONVERTER_VERSION = 1
"""Raise it when a converter writes other bytes for the same source."""

SHARD_BYTES = 256 * 2**20
"""A shard ends with the unit that reaches this size."""

JOURNAL = "journal.jsonl"

Progress = Callable[[int, int, str], None]
"""Called with (units done, of how many, the unit just read)."""


@dataclass(frozen=True)
class Conversion:
    """What a finished conversion wrote."""

    directory: Path
    spec: DatasetSpec  # the registry entry that reads it
    episodes: int
    shards: int
    skipped: dict[str, int] = field(default_factory=dict)  # reason -> how many


@dataclass(frozen=True)
class _Shard:
    """A line of the journal: a finished shard. The names of the fields are those in the file."""

    units: int  # of the source, read by the end of this shard
    records: int
    size: int  # bytes of payload
    left_out: dict[str, int]  # reason -> how many were skipped


def suggest_spec(source: ConvertibleSource, name: str) -> DatasetSpec:
    """The registry entry of a converted dataset: its first camera and its action."""
    layout = source.layout
    actions = action_fields(layout.vectors)
    return DatasetSpec(
        name,
        image_key=next(iter(layout.images)),
        action_keys=tuple(actions),
        action_dims=tuple(layout.vectors[key] for key in actions),
        hz=source.hz,
        note=source.description,
    )


def convert(
    source: ConvertibleSource,
    out: str | Path,
    name: str,
    *,
    skip_damaged: bool = False,
    shard_bytes: int = SHARD_BYTES,
    origin: Mapping[str, Any] = {},
    progress: Progress | None = None,
) -> Conversion:
    """Writes every episode of `source` into `<out>/<name>/1.0.0`.

    With the same source and settings again it resumes, or returns at once if the dataset is finished. With
    `skip_damaged`, which may be added after an error, damaged units are skipped and counted; without it they raise
    UnitError. `origin` is added to metadata.json. Raises DataError if no episode is left, ConfigError for a name or
    directory that cannot be used.
    """
    require(
        re.fullmatch(r"[a-z][a-z0-9_]*", name) is not None,
        f"--name {name!r} cannot be a dataset's name: use lower-case letters, digits and _ only",
    )
    final = Path(out) / name / VERSION
    fingerprint = stable_hash(
        {
            "converter": CONVERTER_VERSION,
            "name": name,
            "shard": shard_bytes,
            **source.identity(),
        }
    )
    if final.exists():
        return _finished(final, fingerprint, source, name)
    new = [directory for directory in (final.parent, Path(out)) if not directory.exists()]
    with ExitStack() as stack:
        stack.callback(_remove_empty, new)
        stack.enter_context(lock_output(final.with_name(f".{VERSION}"), called=final.parent))
        if final.exists():  # another process has made it meanwhile
            return _finished(final, fingerprint, source, name)
        partial = final.with_name(f".{VERSION}.{fingerprint[:16]}.partial")
        partial.mkdir(exist_ok=True)
        shards = _write_shards(source, partial, skip_damaged, shard_bytes, progress)
        return _finish(source, partial, final, name, shards, {**origin, FINGERPRINT: fingerprint})


def _write_shards(
    source: ConvertibleSource, partial: Path, skip_damaged: bool, shard_bytes: int, progress: Progress | None
) -> list[_Shard]:
    journal = Journal(partial / JOURNAL)
    shards = [_Shard(**line) for line in journal.read()]
    if not shards:
        for stray in partial.iterdir():
            stray.unlink()
    total = len(source.units)
    while (shards[-1].units if shards else 0) < total:
        unit = shards[-1].units if shards else 0
        skipped: Counter[str] = Counter()
        size = 0

        def records() -> Iterator[bytes]:
            nonlocal unit, size
            while unit < total and size < shard_bytes:
                try:
                    for item in source.read(unit):
                        if isinstance(item, Skipped):
                            skipped[item.reason] += 1
                            continue
                        record = encode(item, source.layout)
                        size += len(record)
                        yield record
                except UnitError as error:
                    if not skip_damaged:
                        raise
                    skipped[without_advice(str(error))] += 1
                unit += 1
                if progress is not None:
                    progress(unit, total, source.units[unit - 1])

        count = write_shard(partial / _part(len(shards)), records())
        shards.append(_Shard(unit, count, size, dict(sorted(skipped.items()))))
        sync(partial / _part(len(shards) - 1))  # the journal's line below states that it exists
        journal.append(vars(shards[-1]))
    return shards


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


def _finish(
    source: ConvertibleSource, partial: Path, final: Path, name: str, shards: list[_Shard], metadata: Mapping[str, Any]
) -> Conversion:
    episodes = sum(s.records for s in shards)
    skipped = dict(sorted(sum((Counter(s.left_out) for s in shards), Counter()).items()))
    if not episodes:
        reasons = "; ".join(f"{n} x {reason.rstrip('.')}" for reason, n in skipped.items()) or "it has no recordings"
        shutil.rmtree(partial)
        raise DataError(f"{source.description.rstrip('.')}: no episode can be made from it: {reasons}.")
    kept = [(k, s) for k, s in enumerate(shards) if s.records]
    for to, (k, _) in enumerate(kept):
        target = partial / shard_name(name, to, len(kept))
        if not target.exists():  # else a run that was stopped here has moved it
            os.replace(partial / _part(k), target)
    write_info(
        partial,
        name=name,
        features=build_features(source.layout.step_fields(), source.layout.episode_fields()),
        splits={"train": ([s.records for _, s in kept], sum(s.size for _, s in kept))},
        description=source.description,
        metadata={**metadata, RATE_KEY: source.hz, "left_out": skipped},
        module="data_pipelines.convert",
    )
    for stray in [*partial.glob("part-*"), *partial.glob(".*")]:  # hidden files were left by killed writers
        stray.unlink(missing_ok=True)
    publish(partial, final)
    (final / JOURNAL).unlink(missing_ok=True)  # only now: a run that finds shards without it makes all again
    return Conversion(final, suggest_spec(source, name), episodes, len(kept), skipped)


def _remove_empty(directories: Sequence[Path]) -> None:
    """Removes those of `directories` that are empty; each lies in the next."""
    for directory in directories:
        with suppress(OSError):
            directory.rmdir()


def _finished(final: Path, fingerprint: str, source: ConvertibleSource, name: str) -> Conversion:
    """The result of an earlier run, if it converted the same source with the same settings; ConfigError otherwise."""
    metadata, lengths = read_metadata(final), shard_lengths(final)
    require(
        metadata.get(FINGERPRINT) == fingerprint and bool(lengths),
        f"{final} exists already and was made from another source, with other settings or by an earlier version; choose "
        "another --name or --out, or remove it",
    )
    if (final / JOURNAL).exists():  # that run was killed in its last moment
        (final / JOURNAL).unlink(missing_ok=True)
    return Conversion(final, suggest_spec(source, name), sum(lengths), len(lengths), metadata["left_out"])


# --- the directory of an unfinished conversion -------------------------------------------------


def _part(index: int) -> str:
    return f"part-{index:05d}"
