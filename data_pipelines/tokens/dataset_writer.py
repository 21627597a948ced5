"""Writes a dataset of the token store part by part, by any number of processes, and publishes it atomically.

Owns the work directory, what survives a crash, and publishing. `part_maker` decides who makes which part; the caller
gives its contents: episodes of any source (`tokenize_job`) or folders of the release (`import_tokens`).

Parts are collected in the work directory `<store>/.<name>.<hash of the plan>`, which neither readers nor jobs with
another plan use. Every process takes the next part that is neither finished nor locked by another process (lock files
are in `<work directory>.claims`, see `publishing`), so that processes may start, end and be killed at any time: a dead
process holds no lock. When the last part is finished, the process that gets the lock for publishing adds the manifest
and renames the directory to `<store>/<name>`.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from data_pipelines.errors import DataError, UnreachableError, without_advice
from data_pipelines.publishing.files import remove, sync
from data_pipelines.publishing.output_lock import backoff, find_held_lock, lock_output
from data_pipelines.tokens.manifest import FILE, SPLITS, Manifest, SkippedEpisodes, SplitFacts
from data_pipelines.tokens.manifest_file import load_manifest
from data_pipelines.tokens.moments import merge_all
from data_pipelines.tokens.part_files import Part, PartFacts, read_part
from data_pipelines.tokens.part_maker import Make, PartMaker, Progress, locks_of
from data_pipelines.tokens.row_sample import merge_samples
from hma_jax.config import ConfigError, require
from hma_jax.config.json import diff, stable_hash
from hma_jax.runtime.files import IO_ERRNOS
from hma_jax.runtime.locks import Held

PART_SIZE = 256 * 2**20
"""Bytes of records in one part: the most work that a killed process loses."""


def write_dataset(
    store_root: str | Path,
    plan: Manifest,
    parts: Sequence[Part],
    make: Make,
    *,
    skipped: Sequence[SkippedEpisodes] = (),
    max_skipped: int = 0,
    overwrite: bool = False,
    wait: bool = True,
    progress: Progress | None = None,
) -> Manifest | None:
    """Makes the missing parts of `<store_root>/<plan.spec.name>` that no other process makes, and publishes it.

    `plan`: the manifest without statistics and splits. `parts` cover the source in order, as
    `cut_parts` cuts them. `make(part)` yields a part's episodes in order of their index, or SkippedEpisodes for one
    that cannot be used; equal parts must yield equal items. `skipped` are episodes that are in no part. An existing
    dataset that was made from the same source in the same way is kept; one that was made differently is refused or,
    with `overwrite`, removed.

    Waits for parts that other processes are making, and makes them here if those processes die; without `wait`, returns
    None instead of the manifest. Raises ConfigError for another dataset in its place, for one that other processes are
    making there, and for a directory that cannot be written; DataError for more than `max_skipped` skipped episodes
    (including those that other processes skipped) or no training episode at all; and what `make` raises.
    """
    root = Path(store_root)
    final = root / plan.spec.name
    try:
        if overwrite or _published(final, plan) is None:  # a finished one blocks nobody
            others = _find_others(root, plan, parts)
            if overwrite:
                _remove_others(final, plan, others)
        maker = PartMaker(_work_directory(root, plan, parts), final, plan, parts, tuple(skipped), max_skipped)
        pauses = backoff()
        while True:
            try:
                manifest = _attempt(maker, make, progress)
            except FileNotFoundError:  # all of it is removed by the process that publishes it
                manifest = _published(final, plan)
                if manifest is None:
                    raise
            if manifest is not None:
                _remove_work(maker.work)
                return manifest
            if not wait:
                return None
            time.sleep(next(pauses))
    except OSError as error:
        if error.errno in IO_ERRNOS:
            raise
        raise ConfigError(
            f"{final}: the token store cannot be written there ({error.strerror or error}). "
            "Choose a directory on a disk with space where you may write."
        ) from error


def differences(store_root: str | Path, plan: Manifest) -> list[str]:
    """The differences between the existing dataset of this name and the plan, one line per field.

    Empty if there are none, or no such dataset. Raises DataError if it cannot be read, such as one of another
    format.
    """
    final = Path(store_root) / plan.spec.name
    return _changes(load_manifest(final / FILE), plan) if final.exists() else []


def cut_parts(sizes: Sequence[int], part_size: int) -> list[Part]:
    """Ranges of consecutive items of about `part_size` together."""
    ends, filled = [], 0
    for i, size in enumerate(sizes):
        filled += int(size)
        if filled >= part_size:
            ends.append(i + 1)
            filled = 0
    if not ends or ends[-1] < len(sizes):
        ends.append(len(sizes))
    firsts = [0, *ends[:-1]]
    return [Part(k, len(ends), a, b) for k, (a, b) in enumerate(zip(firsts, ends, strict=True))]


# --- Steps -----------------------------------------------------------------------------------


def _work_directory(root: Path, plan: Manifest, parts: Sequence[Part]) -> Path:
    """The directory in which the parts of a plan are made."""
    return root / f".{plan.spec.name}.{stable_hash([plan, list(parts)])[:12]}"


def _attempt(maker: PartMaker, make: Make, progress: Progress | None) -> Manifest | None:
    """Makes every free part and publishes the dataset if it is complete; None if it is not."""
    manifest = _published(maker.final, maker.plan)
    if manifest is not None:
        return manifest
    maker.make_free_parts(make, progress)
    if maker.complete():
        _publish(maker)
    return _published(maker.final, maker.plan)


def _publish(maker: PartMaker) -> None:
    """Publishes the dataset, unless another process is doing so. A damaged part is made again by the next attempt."""
    work, final, plan = maker.work, maker.final, maker.plan
    maker.check_skipped()
    try:
        with lock_output(locks_of(work) / "publish") as lock:
            facts = []
            for part in maker.parts:
                known = read_part(work, part)
                if known is None:
                    maker.forget(part)
                    return
                facts.append(known)
            manifest = _merge(plan, facts, maker.skipped)
            if not manifest.train.episodes:
                last = (
                    f" The last one skipped: {without_advice(manifest.skipped[-1].reason)}" if manifest.skipped else ""
                )
                raise DataError(f"{plan.spec.name}: no episode can be used for training.{last}")
            manifest.save(work, lock.scratch)
            sync(work)
            try:
                os.rename(work, final)
            except OSError:
                if not final.exists():  # otherwise another process published the same
                    raise
            sync(final.parent)
    except Held:
        pass


def _merge(plan: Manifest, facts: Sequence[PartFacts], skipped: Sequence[SkippedEpisodes]) -> Manifest:
    moments = merge_all((f.moments for f in facts), plan.spec.action_dim)
    splits = {}
    for split in SPLITS:
        pieces = [getattr(f, split) for f in facts]
        content = hashlib.sha256("".join(p.content for p in pieces).encode()).hexdigest()[:32]
        splits[split] = SplitFacts(
            tuple(e for p in pieces for e in p.episodes),
            tuple(n for p in pieces for n in p.steps),
            content,
            tuple(len(p.episodes) for p in pieces),
        )
    return replace(
        plan,
        action_mean=moments.mean,
        action_std=moments.std,
        action_min=moments.low,
        action_max=moments.high,
        action_quantiles=merge_samples(f.sample for f in facts).quantiles(),
        skipped=(*skipped, *(more for f in facts for more in f.lost)),
        **splits,
    )


def _published(final: Path, plan: Manifest) -> Manifest | None:
    """The manifest of the existing dataset, None without one. Raises ConfigError, naming what differs from the plan."""
    if not final.exists():
        return None
    existing = load_manifest(final / FILE)
    changes = _changes(existing, plan)
    require(
        not changes,
        f"{final}: already tokenised with other settings ({'; '.join(changes)}). Choose another store directory, or "
        "remove this dataset from the store.",
    )
    return existing


def _changes(existing: Manifest, plan: Manifest) -> list[str]:
    inputs = ("spec", "tokenizer", "settings", "source", "recipe")
    counts, asked = existing.episodes_of_parts, plan.settings
    own = replace(asked, max_val_fraction=existing.settings.max_val_fraction)
    if all(own.held_out.count(n) == asked.held_out.count(n) for n in counts):  # a different limit changes nothing here
        plan = replace(plan, settings=own)
    return [line for name in inputs for line in diff(getattr(existing, name), getattr(plan, name), name)]


def _find_others(root: Path, plan: Manifest, parts: Sequence[Part]) -> list[Path]:
    """Work directories that jobs with other plans left for a dataset of this name.

    Raises Held if a living process is making one.
    """
    name = plan.spec.name
    final, work = root / name, _work_directory(root, plan, parts)
    unfinished = re.compile(rf"\.{re.escape(name)}\.[0-9a-f]{{12}}")
    others = [p for p in sorted(root.glob(f".{name}.*")) if unfinished.fullmatch(p.name) and p != work]
    for other in others:
        try:
            held = find_held_lock(locks_of(other))
        except PermissionError:  # another user's, whose work cannot be read
            continue
        if held:
            raise Held(
                f"{final}: {held.who} is making this dataset with other settings; wait until it has finished, or stop "
                "it",
                held.holder,
            )
    return others


def _remove_others(final: Path, plan: Manifest, others: Sequence[Path]) -> None:
    """Removes a dataset of this name that was made differently, and what unfinished jobs left of it."""
    if final.exists():
        try:
            outdated = bool(_changes(load_manifest(final / FILE), plan))
        except UnreachableError:  # it may be intact
            raise
        except DataError:  # damaged, or of another format
            outdated = True
        if outdated:
            remove(final)
    for other in others:
        _remove_work(other)


def _remove_work(work: Path) -> None:
    for directory in (locks_of(work), work):
        shutil.rmtree(directory, ignore_errors=True)
