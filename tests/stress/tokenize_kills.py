"""Processes that tokenise one store, and join, leave and are killed as chance has it, until it is complete.

    python -m tests.stress.tokenize_kills --kills 20 --processes 4

Some are killed at a random moment, some within a save: before a rename, an fsync, an unlink. The last
lines say whether the store has the bytes of one that was made undisturbed, and which parts were made twice: none
but those in flight when their process ended. Exits with 1 otherwise.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from data_pipelines.suite.embodiments import select
from data_pipelines.suite.generate import generate_suite
from tests.files import contents
from tests.stress.tokenize_process import Work, read, tokenize

DATASETS, EPISODES = 3, 40
LEAVES = 0.2
"""Of the endings, those by Ctrl-C, at most."""


@dataclass(frozen=True)
class Outcome:
    equal: bool  # to the undisturbed store, without leftovers
    parts: int
    begun: int
    again_in_flight: int  # begun again because the process that had begun it was killed or left
    twice: tuple[str, ...]  # begun again although finished, or being made by a living process
    kills: int
    in_saves: int
    left: int
    failed: int  # ended with an error
    started: int
    seconds: float

    @property
    def good(self) -> bool:
        return self.equal and not self.twice and not self.failed


def run(root: Path, kills: int, processes: int, seed: int = 0, datasets: int = DATASETS) -> Outcome:
    names = tuple(spec.name for spec in select(None)[:datasets])
    scale = EPISODES / max(spec.episodes for spec in select(names))
    generate_suite(root / "suite", names=names, scale=scale, seed=seed)
    work = Work(root / "suite", names, root / "undisturbed", root / "log", part_size=40_000, pause=0.0)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.stress.tokenize_process"])
    first = context.Process(target=tokenize, args=(work,))
    first.start()
    first.join()
    assert first.exitcode == 0
    expected = contents(work.store)
    parts = sum("parts/" in name for name in expected)
    (root / "log").unlink()

    began = time.monotonic()
    work = replace(work, store=root / "store", pause=0.03)
    crew = _Crew(context, work, processes, random.Random(seed), parts, kills)
    crew.work()
    last = context.Process(target=tokenize, args=(work,))  # finds it complete, and removes what the dead left
    last.start()
    last.join()
    seconds = time.monotonic() - began
    events = read(work.log)
    in_flight, twice = _repeats(events, crew.killed | crew.interrupted)
    found = Counter(event["what"] for event in events)
    return Outcome(
        contents(work.store) == expected, parts, found["begin"], in_flight, twice,
        len(crew.killed), found["dies"], len(crew.interrupted), crew.failed, crew.started, seconds,
    )  # fmt: skip


class _Crew:
    """Keeps about `processes` at work, and ends one whenever so many parts more are finished."""

    def __init__(self, context, work: Work, processes: int, draw: random.Random, parts: int, kills: int):
        self.context, self.work_of_all, self.processes, self.draw = context, work, processes, draw
        self.parts, self.kills = parts, kills
        self.alive: list[multiprocessing.Process] = []
        self.killed: set[int] = set()
        self.interrupted: set[int] = set()
        self.failed = 0
        self.started = 0

    def work(self) -> None:
        while True:
            self.collect()
            done = self.finished_parts()
            if len(self.killed) < self.kills and done < self.parts:
                while len(self.alive) < self.processes + self.draw.choice((-1, 0, 1)) or not self.alive:
                    self.start()
                if done >= 0.8 * self.parts * len(self.killed) / self.kills:
                    time.sleep(self.draw.uniform(0, 0.1))
                    self.end_one()
            elif not self.alive:
                return
            time.sleep(0.005)

    def start(self) -> None:
        in_save = self.draw.random() < 0.7 and len(self.killed) + len(self.alive) < self.kills
        dies_in = self.draw.randint(1, 25) if in_save else 0
        process = self.context.Process(target=tokenize, args=(self.work_of_all, dies_in))
        process.start()
        self.started += 1
        self.alive.append(process)

    def end_one(self) -> None:
        self.collect()
        if not self.alive:
            return
        process = self.draw.choice(self.alive)
        if self.draw.random() < LEAVES and len(self.interrupted) < LEAVES * self.kills:
            self.interrupted.add(process.pid)
            os.kill(process.pid, signal.SIGINT)
        else:
            process.kill()

    def collect(self) -> None:
        for process in [p for p in self.alive if not p.is_alive()]:
            process.join()
            self.alive.remove(process)
            if process.exitcode == -signal.SIGKILL:
                self.killed.add(process.pid)
            elif process.exitcode and process.pid not in self.interrupted:
                self.failed += 1

    def finished_parts(self) -> int:
        return len(list(self.work_of_all.store.glob("*/parts/*.json"))) if self.work_of_all.store.exists() else 0


def _repeats(events: Sequence[dict], gone: set[int]) -> tuple[int, tuple[str, ...]]:
    """How many parts were begun again as they may be, and those that were not."""
    last: dict[str, dict] = {}
    in_flight, twice = 0, []
    for event in events:
        if event["what"] not in ("begin", "end"):
            continue
        before = last.get(event["place"])
        if event["what"] == "begin" and before is not None:
            if before["what"] == "begin" and before["process"] in gone:
                in_flight += 1
            else:
                twice.append(event["place"])
        last[event["place"]] = event
    return in_flight, tuple(twice)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--processes", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="a directory that is kept; without it, a temporary one")
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        o = run(args.out or Path(temporary), args.kills, args.processes, args.seed)
    print(
        f"{o.kills} kills ({o.in_saves} within a save) and {o.left} leaves among {o.started} processes, "
        f"about {args.processes} at a time, {o.failed} errors, {o.seconds:.1f} s\n"
        f"{o.parts} parts, begun {o.begun} times; again because their process ended: {o.again_in_flight}; "
        f"made twice: {', '.join(o.twice) or 'none'}\n"
        f"byte-equal to the undisturbed store, nothing left over: {'yes' if o.equal else 'NO'}"
    )
    return 0 if o.good and o.kills >= args.kills else 1


if __name__ == "__main__":
    sys.exit(main())
