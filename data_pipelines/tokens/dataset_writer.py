"""A dataset of the token store, made part by part by any number of processes, and published at once.

Owns the work directory, who makes which part, what is kept after a crash, and publishing. What
goes into a part is the caller's: episodes of RLDS (`tokenize_job`) or of any other source.

Parts gather in `<store>/.<name>.<hash of the plan>`, where no reader looks and no job with
another plan. Every process takes the next part that is neither there nor claimed by another one
(`<work directory>.claims`, see `publishing`), so that processes may come, go and be killed at any
time: the part of a dead one is free again. When the last is there, whoever claims the publishing
adds the manifest and renames the directory to `<store>/<name>`.
"""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path

from data_pipelines.errors import DataError
from data_pipelines.publishing.claims import Claim, claim, living_claim, pauses_between_looks
from data_pipelines.publishing.files import remove, sync
from data_pipelines.tokens.manifest import FILE, SPLITS, Loss, Manifest, SplitFacts, load_manifest
from data_pipelines.tokens.moments import merge_all
from data_pipelines.tokens.part import FACTS, Made, Part, PartFacts, read_part, write_part
from hma_jax.config import ConfigError, require
from hma_jax.config.json import diff, stable_hash
from hma_jax.runtime.locks import Held

PART_SIZE = 256 * 2**20
"""Bytes of records in one part: what a killed process has to do again, at most."""

Progress = Callable[[int, int], None]
"""Called with the episodes done, by whichever process, and all of them."""


def write_dataset(
    store_root: str | Path,
    plan: Manifest,
    parts: Sequence[Part],
    make: Callable[[Part], Iterable[Made]],
    *,
    lost: Sequence[Loss] = (),
    max_lost: int = 0,
    overwrite: bool = False,
    wait: bool = True,
    progress: Progress | None = None,
) -> Manifest | None:
    """Makes the missing parts of `<store_root>/<plan.spec.name>` that no other process makes, and publishes it.

    `plan`: the manifest without statistics and splits. `parts` cover the source in order, as
    `cut_parts` cuts them. `make(part)` gives a part's episodes in order of their index, or a Loss
    for one that cannot be used; equal parts must give equal items. `lost` are episodes that are
    in no part. A dataset that is there, made from the same source in the same way, is kept; one
    made otherwise is refused or, with `overwrite`, removed.

    Parts that other processes are making are waited for, and made here if those die; without
    `wait` None is returned instead of the manifest. Raises ConfigError for another dataset in its
    place, or one that other processes are making there, and a directory that cannot be written;
    DataError for more than `max_lost` lost episodes, those that other processes lost included, or no
    training episode at all; and what `make` raises.
    """
    root = Path(store_root)
    final = root / plan.spec.name
    try:
        if overwrite:
            _remove_others(root, plan, parts)
        job = _Job(_work_directory(root, plan, parts), final, plan, parts, tuple(lost), max_lost)
        pauses = pauses_between_looks()
        while True:
            try:
                manifest = job.attempt(make, progress)
            except FileNotFoundError:  # all of it is removed by the process that publishes it
                manifest = _published(final, plan)
                if manifest is None:
                    raise
            if manifest is not None:
                _remove_work(job.work)
                return manifest
            if not wait:
                return None
            time.sleep(next(pauses))
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


def cut_parts(sizes: Sequence[int], part_size: int) -> list[Part]:
    """Ranges of consecutive items of about `part_size` together."""
    ends, held = [], 0
    for i, size in enumerate(sizes):
        held += int(size)
        if held >= part_size:
            ends.append(i + 1)
            held = 0
    if not ends or ends[-1] < len(sizes):
        ends.append(len(sizes))
    firsts = [0, *ends[:-1]]
    return [Part(k, len(ends), a, b) for k, (a, b) in enumerate(zip(firsts, ends, strict=True))]


# --- Steps -----------------------------------------------------------------------------------


def _work_directory(root: Path, plan: Manifest, parts: Sequence[Part]) -> Path:
    return root / f".{plan.spec.name}.{stable_hash([plan, list(parts)])[:12]}"


def _claims(work: Path) -> Path:
    """Where parts, and the publishing, are claimed, and written before they get to their place."""
    return work.with_name(f"{work.name}.claims")


@dataclass
class _Job:
    """What this process knows of a dataset that is being made."""

    work: Path
    final: Path
    plan: Manifest
    parts: Sequence[Part]
    lost: tuple[Loss, ...]  # episodes in no part
    max_lost: int
    done: dict[int, tuple[Loss, ...]] = field(default_factory=dict)  # what each part that is there lost

    def attempt(self, make: Callable[[Part], Iterable[Made]], progress: Progress | None) -> Manifest | None:
        """Makes every part that is free and publishes the dataset if it is complete; None if it is not."""
        manifest = _published(self.final, self.plan)
        if manifest is not None:
            return manifest
        (self.work / FACTS).mkdir(parents=True, exist_ok=True)
        self._make_free_parts(make, progress)
        if all(self._there(part) for part in self.parts):
            self._publish()
        return _published(self.final, self.plan)

    def _make_free_parts(self, make: Callable[[Part], Iterable[Made]], progress: Progress | None) -> None:
        missing = [part for part in self.parts if not self._there(part)]
        self._check_losses()
        total = sum(len(part.episodes) for part in self.parts)
        report = (lambda done: progress(done, total)) if progress else (lambda done: None)
        report(self._episodes_there())
        others: list[Part] = []  # of other processes
        for part in missing:
            if self.final.exists():
                return
            try:
                with claim(_claims(self.work) / f"{part.number:05d}") as held:
                    if not self._there(part):  # made between the look and the claim
                        self._make(part, make, held, report)
            except Held:
                others.append(part)
            others = [part for part in others if not self._there(part)]
            self._check_losses()

    def _make(
        self, part: Part, make: Callable[[Part], Iterable[Made]], held: Claim, report: Callable[[int], None]
    ) -> None:
        before = self._episodes_there()

        def counted() -> Iterator[Made]:
            lost: list[Loss] = []
            for n, item in enumerate(make(part), start=1):
                if isinstance(item, Loss):
                    lost.append(item)
                    self._check_losses(lost)
                yield item
                report(before + n)

        keep = {"none": set(), "val": {"val"}, "all": set(SPLITS)}[self.plan.settings.keep_frames]
        try:
            facts = write_part(self.work, part, counted(), held.scratch, self.plan.spec.action_dim, keep)
        except FileNotFoundError:
            if not held.lost():
                raise
            return  # this process had been stopped for so long that another host took the part over
        self.done[part.number] = facts.lost

    def _there(self, part: Part) -> bool:
        """Whether a part is finished, by whichever process.

        One with losses was made when they were allowed. Made again, it says what is wrong.
        """
        if part.number not in self.done:
            facts = read_part(self.work, part)
            if facts is None or (facts.lost and not self.max_lost):
                return False
            self.done[part.number] = facts.lost
        return True

    def _episodes_there(self) -> int:
        return sum(len(part.episodes) for part in self.parts if part.number in self.done)

    def _check_losses(self, more: Sequence[Loss] = ()) -> None:
        """DataError if too many episodes are lost by all processes together, and `more` in the part at hand."""
        losses = [*self.lost, *chain.from_iterable(self.done.values()), *more]
        lost = sum(loss.episodes for loss in losses)
        if lost > self.max_lost:
            raise DataError(
                f"{self.plan.spec.name}: {lost} episodes are unusable, more than max_skipped={self.max_lost}. "
                f"The last: {losses[-1].reason} Raise max_skipped if the rest is worth it."
            )

    def _publish(self) -> None:
        """Unless another process is doing it, or a part is damaged, which the next attempt makes again."""
        self._check_losses()
        try:
            with claim(_claims(self.work) / "publish") as held:
                facts = [read_part(self.work, part) for part in self.parts]
                damaged = [part.number for part, known in zip(self.parts, facts, strict=True) if known is None]
                for number in damaged:
                    del self.done[number]
                if damaged:
                    return
                manifest = _merge(self.plan, facts, self.lost)
                if not manifest.train.episodes:
                    raise DataError(f"{self.plan.spec.name}: no usable episode is left to train on.")
                text = held.scratch / FILE
                text.write_text(manifest.to_text())
                sync(text)
                os.replace(text, self.work / FILE)
                sync(self.work)
                try:
                    os.rename(self.work, self.final)
                except OSError:
                    if not self.final.exists():  # otherwise another process published the same
                        raise
                sync(self.final.parent)
        except Held:
            pass


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
    """A dataset of this name that was made otherwise, and what unfinished jobs left of it.

    Raises Held if a living process is making one.
    """
    name = plan.spec.name
    final, work = root / name, _work_directory(root, plan, parts)
    unfinished = re.compile(rf"\.{re.escape(name)}\.[0-9a-f]{{12}}")
    others = [p for p in sorted(root.glob(f".{name}.*")) if unfinished.fullmatch(p.name) and p != work]
    for other in others:
        if held := living_claim(_claims(other)):
            raise Held(
                f"{final}: {held.who} is making this dataset in another way; wait for it or stop it", held.holder
            )
    if final.exists():
        try:
            outdated = bool(_changes(load_manifest(final / FILE), plan))
        except DataError:  # damaged, or of an older format
            outdated = True
        if outdated:
            remove(final)
    for other in others:
        _remove_work(other)


def _remove_work(work: Path) -> None:
    for directory in (_claims(work), work):
        shutil.rmtree(directory, ignore_errors=True)
