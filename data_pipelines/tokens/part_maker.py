"""The parts of a dataset that is being made: which are finished, which are free, and who makes them.

Owns the locks of parts and the count of skipped episodes over all processes. Each process takes the next
part that is neither finished nor locked; the part of a dead process is free again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from data_pipelines.errors import too_many_skipped
from data_pipelines.publishing.output_lock import OutputLock, lock_output
from data_pipelines.tokens.manifest import SPLITS, Manifest, SkippedEpisodes
from data_pipelines.tokens.part_files import FACTS, Part, PartItem, read_part, write_part
from hma_jax.runtime.locks import Held

Progress = Callable[[int, int], None]
"""Called with the number of episodes done, by any process, and the number of all."""

Make = Callable[[Part], Iterable[PartItem]]
"""Yields what a part is made of, in order; equal parts yield equal items."""


def locks_of(work: Path) -> Path:
    """The directory of the lock files of parts and of publishing, and of their scratch directories."""
    return work.with_name(f"{work.name}.claims")


@dataclass
class PartMaker:
    """What this process knows about the parts in the directory `work`."""

    work: Path
    final: Path  # the dataset's final directory
    plan: Manifest
    parts: Sequence[Part]
    skipped: tuple[SkippedEpisodes, ...]  # episodes in no part
    max_skipped: int
    _done: dict[int, tuple[SkippedEpisodes, ...]] = field(default_factory=dict)  # per finished part: what was skipped

    def complete(self) -> bool:
        """Whether every part is there."""
        return all(self._is_finished(part) for part in self.parts)

    def forget(self, part: Part) -> None:
        """For a part that turned out damaged: the next check finds it missing."""
        self._done.pop(part.number, None)

    def make_free_parts(self, make: Make, progress: Progress | None) -> None:
        """Makes every part that is missing and that no other process makes.

        Raises DataError for too many skipped episodes, OSError, and what `make` raises.
        """
        (self.work / FACTS).mkdir(parents=True, exist_ok=True)
        missing = [part for part in self.parts if not self._is_finished(part)]
        self.check_skipped()
        total = sum(len(part.episodes) for part in self.parts)
        report = (lambda done: progress(done, total)) if progress else (lambda done: None)
        report(self._finished_episodes())
        others: list[Part] = []  # of other processes
        for part in missing:
            if self.final.exists():
                return
            try:
                with lock_output(locks_of(self.work) / f"{part.number:05d}") as lock:
                    if not self._is_finished(part):  # another process may have finished it before the lock was taken
                        self._make(part, make, lock, report)
            except Held:
                others.append(part)
            others = [part for part in others if not self._is_finished(part)]
            self.check_skipped()

    def _make(self, part: Part, make: Make, lock: OutputLock, report: Callable[[int], None]) -> None:
        before = self._finished_episodes()

        def counted() -> Iterator[PartItem]:
            skipped: list[SkippedEpisodes] = []
            for n, item in enumerate(make(part), start=1):
                if isinstance(item, SkippedEpisodes):
                    skipped.append(item)
                    self.check_skipped(skipped)
                yield item
                report(before + n)

        keep = {"none": set(), "val": {"val"}, "all": set(SPLITS)}[self.plan.settings.keep_frames]
        try:
            facts = write_part(self.work, part, counted(), lock.scratch, self.plan.spec.action_dim, keep)
        except FileNotFoundError:
            if not lock.lost():
                raise
            return  # this process was stopped for so long that another host took the part over
        self._done[part.number] = facts.lost

    def _is_finished(self, part: Part) -> bool:
        """Whether a part is finished, by any process. A part with skipped episodes does not count if none may be
        skipped: when it is made again, it raises the error."""
        if part.number not in self._done:
            facts = read_part(self.work, part)
            if facts is None or (facts.lost and not self.max_skipped):
                return False
            self._done[part.number] = facts.lost
        return True

    def _finished_episodes(self) -> int:
        return sum(len(part.episodes) for part in self.parts if part.number in self._done)

    def check_skipped(self, more: Sequence[SkippedEpisodes] = ()) -> None:
        """Raises DataError if all processes together, with `more` in the part at hand, skipped too many episodes."""
        skipped = [*self.skipped, *chain.from_iterable(self._done.values()), *more]
        total = sum(entry.episodes for entry in skipped)
        if total > self.max_skipped:
            raise too_many_skipped(self.plan.spec.name, total, self.max_skipped, skipped[-1].reason)
