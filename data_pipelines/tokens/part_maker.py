"""The parts of a dataset that is being made: which are finished, which are free, and who makes them.

Owns the locks of parts and the count of lost episodes over all processes. Each process takes the next
part that is neither finished nor locked; the part of a dead process is free again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

from data_pipelines.errors import DataError, without_advice
from data_pipelines.publishing.output_lock import OutputLock, lock_output
from data_pipelines.tokens.manifest import SPLITS, LostEpisodes, Manifest
from data_pipelines.tokens.part_files import FACTS, Part, PartItem, read_part, write_part
from hma_jax.runtime.locks import Held

Progress = Callable[[int, int], None]
"""Called with the episodes done, by whichever process, and all of them."""

Make = Callable[[Part], Iterable[PartItem]]
"""Gives what a part is made of, in order; equal parts give equal items."""


def locks_of(work: Path) -> Path:
    """The directory of the lock files of parts and of publishing, and of their scratch directories."""
    return work.with_name(f"{work.name}.claims")


@dataclass
class PartMaker:
    """What this process knows of the parts in the directory `work`."""

    work: Path
    final: Path  # where the dataset will be
    plan: Manifest
    parts: Sequence[Part]
    lost: tuple[LostEpisodes, ...]  # episodes in no part
    max_lost: int
    _done: dict[int, tuple[LostEpisodes, ...]] = field(default_factory=dict)  # what each part that is there lost

    def complete(self) -> bool:
        """Whether every part is there."""
        return all(self._there(part) for part in self.parts)

    def forget(self, part: Part) -> None:
        """For a part that turned out damaged: the next look finds it missing."""
        self._done.pop(part.number, None)

    def make_free_parts(self, make: Make, progress: Progress | None) -> None:
        """Makes every part that is missing and that no other process makes.

        Raises DataError for too many lost episodes, OSError, and what `make` raises.
        """
        (self.work / FACTS).mkdir(parents=True, exist_ok=True)
        missing = [part for part in self.parts if not self._there(part)]
        self.check_losses()
        total = sum(len(part.episodes) for part in self.parts)
        report = (lambda done: progress(done, total)) if progress else (lambda done: None)
        report(self._episodes_there())
        others: list[Part] = []  # of other processes
        for part in missing:
            if self.final.exists():
                return
            try:
                with lock_output(locks_of(self.work) / f"{part.number:05d}") as lock:
                    if not self._there(part):  # another process may have finished it before the lock was taken
                        self._make(part, make, lock, report)
            except Held:
                others.append(part)
            others = [part for part in others if not self._there(part)]
            self.check_losses()

    def _make(self, part: Part, make: Make, lock: OutputLock, report: Callable[[int], None]) -> None:
        before = self._episodes_there()

        def counted() -> Iterator[PartItem]:
            lost: list[LostEpisodes] = []
            for n, item in enumerate(make(part), start=1):
                if isinstance(item, LostEpisodes):
                    lost.append(item)
                    self.check_losses(lost)
                yield item
                report(before + n)

        keep = {"none": set(), "val": {"val"}, "all": set(SPLITS)}[self.plan.settings.keep_frames]
        try:
            facts = write_part(self.work, part, counted(), lock.scratch, self.plan.spec.action_dim, keep)
        except FileNotFoundError:
            if not lock.lost():
                raise
            return  # this process had been stopped for so long that another host took the part over
        self._done[part.number] = facts.lost

    def _there(self, part: Part) -> bool:
        """Whether a part is finished, by whichever process.

        One with losses was made when they were allowed. Made again, it says what is wrong.
        """
        if part.number not in self._done:
            facts = read_part(self.work, part)
            if facts is None or (facts.lost and not self.max_lost):
                return False
            self._done[part.number] = facts.lost
        return True

    def _episodes_there(self) -> int:
        return sum(len(part.episodes) for part in self.parts if part.number in self._done)

    def check_losses(self, more: Sequence[LostEpisodes] = ()) -> None:
        """DataError if too many episodes are lost by all processes together, and `more` in the part at hand."""
        losses = [*self.lost, *chain.from_iterable(self._done.values()), *more]
        lost = sum(loss.episodes for loss in losses)
        if lost > self.max_lost:
            raise DataError(
                f"{self.plan.spec.name}: {lost} episodes are unusable, more than max_skipped={self.max_lost}. "
                f"The last: {without_advice(losses[-1].reason)} If the rest is worth it, raise the limit: "
                "--set store.max_skipped=N."
            )
