"""A dataset of the token store, made part by part by one process or many, and published at once.

Owns the work directory, who makes which part, what is kept after a crash, and publishing. What
goes into a part is the caller's: episodes of RLDS (`tokenize_job`) or of any other source.

Parts gather in `<store>/.<name>.<hash of the plan>`, where no reader looks and no job with
another plan. When the last is there, the manifest is added and the directory renamed to
`<store>/<name>`. Every step is repeatable and writes the same bytes, so that it does not
matter how often a process is killed, or whether two make the same part or publish at once.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from data_pipelines.errors import DataError
from data_pipelines.tokens.manifest import FILE, SPLITS, Loss, Manifest, SplitFacts, load_manifest
from data_pipelines.tokens.moments import merge_all
from data_pipelines.tokens.part import FACTS, Made, Part, PartFacts, read_part, sync, write_part
from data_pipelines.tokens.row_sample import merge_samples
from data_pipelines.tokens.scratch import scratch
from data_pipelines.tokens.share import Share
from hma_jax.config import ConfigError, require
from hma_jax.config.json import diff, stable_hash

PART_SIZE = 256 * 2**20
"""Bytes of records in one part: what a killed process has to do again, at most."""

MOST_PARTS = 1024
"""Parts of a dataset: of one larger than this many times PART_SIZE the parts are larger."""

Progress = Callable[[int, int], None]
"""Called with the episodes done and all, of this process's share."""


def write_dataset(
    store_root: str | Path,
    plan: Manifest,
    parts: Sequence[Part],
    make: Callable[[Part], Iterable[Made]],
    *,
    share: Share = Share(),
    lost: Sequence[Loss] = (),
    max_lost: int = 0,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Manifest | None:
    """Makes this process's missing parts of `<store_root>/<plan.spec.name>`; publishes what is complete.

    `plan`: the manifest without statistics and splits. `parts` cover the source in order, as
    `cut_parts` cuts them. `make(part)` gives a part's episodes in order of their index, or a Loss
    for one that cannot be used; equal parts must give equal items. `lost` are episodes that are
    in no part. A dataset that is there, made from the same source in the same way, is kept; one
    made otherwise is refused or, with `overwrite`, removed.

    Returns the manifest, or None while parts of other processes are missing. Raises ConfigError
    for another dataset in its place and a directory that cannot be written, DataError for more
    than `max_lost` lost episodes or no training episode at all, and what `make` raises.
    """
    root, name = Path(store_root), plan.spec.name
    final = root / name
    try:
        if overwrite:
            _remove_others(root, plan, parts)
        work = _work_directory(root, plan, parts)
        manifest = _published(final, plan)
        if manifest is not None:
            _remove_work(work)  # of a process that was killed after it had published
            return manifest
        (work / FACTS).mkdir(parents=True, exist_ok=True)
        try:
            _make_parts(work, final, plan, share.of(parts, name), make, max_lost, progress)
            manifest = _publish(work, final, plan, parts, lost, max_lost)
        except FileNotFoundError:
            manifest = _published(final, plan)  # published meanwhile by a process that did the same
            if manifest is None:
                raise
        if manifest is not None:
            _remove_work(work)
        return manifest
    except OSError as error:
        raise ConfigError(
            f"{final}: the token store cannot be written there ({error.strerror or error}). "
            "Choose a directory on a disk with space where you may write."
        ) from error


def differences(store_root: str | Path, plan: Manifest) -> list[str]:
    """How the dataset of this name that is in the store was made otherwise than planned, one line per field.

    Empty if it is as planned, or not there. Raises DataError if it cannot be read, as one of an older format.
    """
    final = Path(store_root) / plan.spec.name
    return _changes(load_manifest(final / FILE), plan) if final.exists() else []


def missing_parts(store_root: str | Path, plan: Manifest, parts: Sequence[Part]) -> int:
    """How many parts of a dataset that is not published are still to be made."""
    work = _work_directory(Path(store_root), plan, parts)
    return sum(read_part(work, part) is None for part in parts)


def cut_parts(sizes: Sequence[int], part_size: int, most: int) -> list[Part]:
    """Ranges of consecutive items of about `part_size` together; larger if it were more than `most`."""
    target = max(part_size, -(-int(sum(sizes)) // most))
    ends, held = [], 0
    for i, size in enumerate(sizes):
        held += int(size)
        if held >= target:
            ends.append(i + 1)
            held = 0
    if not ends or ends[-1] < len(sizes):
        ends.append(len(sizes))
    firsts = [0, *ends[:-1]]
    return [Part(k, len(ends), a, b) for k, (a, b) in enumerate(zip(firsts, ends, strict=True))]


# --- Steps -----------------------------------------------------------------------------------


def _work_directory(root: Path, plan: Manifest, parts: Sequence[Part]) -> Path:
    return root / f".{plan.spec.name}.{stable_hash([plan, list(parts)])[:12]}"


def _aside(work: Path) -> Path:
    return work.with_name(f"{work.name}.aside")


def _make_parts(
    work: Path,
    final: Path,
    plan: Manifest,
    parts: Sequence[Part],
    make: Callable[[Part], Iterable[Made]],
    max_lost: int,
    progress: Progress | None,
) -> None:
    # A part with losses was made when they were allowed. Made again, it says what is wrong.
    kept = {p for p in parts if (f := read_part(work, p)) and (max_lost or not f.lost)}
    total, done = sum(len(p.episodes) for p in parts), sum(len(p.episodes) for p in kept)
    keep = {"none": set(), "val": {"val"}, "all": set(SPLITS)}[plan.settings.keep_frames]

    def report(more: int = 0) -> None:
        if progress is not None:
            progress(done + more, total)

    report()
    with scratch(_aside(work)) as aside:
        for part in parts:
            if part in kept:
                continue
            if final.exists():
                return
            counted = _counted(make(part), report)
            write_part(work, part, counted, aside, plan.spec.action_dim, keep)
            done += len(part.episodes)


def _counted(made: Iterable[Made], report: Callable[[int], None]) -> Iterable[Made]:
    for n, item in enumerate(made, start=1):
        yield item
        report(n)


def _publish(
    work: Path,
    final: Path,
    plan: Manifest,
    parts: Sequence[Part],
    lost: Sequence[Loss],
    max_lost: int,
) -> Manifest | None:
    facts = []
    for part in parts:
        known = read_part(work, part)
        if known is None:
            return _published(final, plan)  # None, unless another process was faster
        facts.append(known)
    manifest = _merge(plan, facts, lost)
    if manifest.lost > max_lost:
        raise DataError(
            f"{plan.spec.name}: {manifest.lost} episodes are unusable, more than max_skipped={max_lost}. "
            f"The last: {manifest.skipped[-1].reason} Raise max_skipped if the rest is worth it."
        )
    if not manifest.train.episodes:
        raise DataError(f"{plan.spec.name}: no usable episode is left to train on.")
    with scratch(_aside(work)) as aside:
        text = aside / FILE
        text.write_text(manifest.to_text())
        sync(text)
        os.replace(text, work / FILE)
    sync(work)
    try:
        os.rename(work, final)
    except OSError:
        if not final.exists():  # otherwise another process published the same
            raise
    sync(final.parent)
    return _published(final, plan)


def _merge(plan: Manifest, facts: Sequence[PartFacts], lost: Sequence[Loss]) -> Manifest:
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
        skipped=(*lost, *(loss for f in facts for loss in f.lost)),
        **splits,
    )


def _published(final: Path, plan: Manifest) -> Manifest | None:
    """The manifest that is there, if it was made as planned; ConfigError naming what differs."""
    if not final.exists():
        return None
    there = load_manifest(final / FILE)
    changes = _changes(there, plan)
    require(
        not changes,
        f"{final}: already tokenised in another way ({'; '.join(changes)}). "
        "Choose another store directory, or remove this dataset from the store.",
    )
    return there


def _changes(there: Manifest, plan: Manifest) -> list[str]:
    inputs = ("spec", "tokenizer", "settings", "source")
    return [line for name in inputs for line in diff(getattr(there, name), getattr(plan, name), name)]


def _remove_others(root: Path, plan: Manifest, parts: Sequence[Part]) -> None:
    """A dataset of this name that was made otherwise, and what unfinished jobs left of it."""
    name = plan.spec.name
    final, work = root / name, _work_directory(root, plan, parts)
    if final.exists():
        try:
            outdated = bool(_changes(load_manifest(final / FILE), plan))
        except DataError:  # damaged, or of an older format
            outdated = True
        if outdated:
            gone = root / f".{name}.removed"
            shutil.rmtree(gone, ignore_errors=True)
            os.rename(final, gone)  # out of sight first
    unfinished = re.compile(rf"\.{re.escape(name)}\.([0-9a-f]{{12}}|removed)")
    for other in root.glob(f".{name}.*"):
        if unfinished.fullmatch(other.name) and other != work:
            _remove_work(other)


def _remove_work(work: Path) -> None:
    for directory in (_aside(work), work):
        shutil.rmtree(directory, ignore_errors=True)
