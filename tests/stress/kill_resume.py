"""Kills training, tokenising, tokenizer training and a sweep again and again, and compares what they end with.

    python -m tests.stress.kill_resume --kills 100 --state DIR

A command of `hma` is started, ended by SIGKILL or SIGTERM, at a random moment or at a random step of a save, and
started again; after a few kills it is left to its end, and what it leaves is compared, byte by byte, with what a
run left that nobody disturbed. That is a round. Tokenising is done by several processes at a time
(`tokenize_kills`). With --state, a directory, this program may be killed itself: the same command goes on after the
last whole round. The last line has the figures; the exit code is 0 if every round ended with equal bytes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

from data_pipelines.publishing.journal import Journal
from hma_jax.runtime.exits import Exit
from hma_jax.runtime.locks import exclusive
from tests.stress import mortal, tokenize_kills
from tests.stress.kill_subjects import Subject, prepare_command, prepared, subjects
from tests.stress.tokenize_process import read

TOKENISING, TOKENISING_AT_A_TIME, TOKENISING_PROCESSES = "tokenising", 6, 3
IN_SAVES = 0.5
"""Of the kills, those at a step of a save."""

TERM = 0.4
"""Of the kills, those by SIGTERM, which lets the command save."""

PATIENCE = 900.0
"""Seconds after which a process that should end, or be finished, is said to hang."""


@dataclass(frozen=True)
class Round:
    subject: str
    number: int
    kills: int
    terms: int  # of them, by SIGTERM or Ctrl-C
    in_saves: int
    equal: bool
    grace: float = 0.0  # longest, from SIGTERM to the end, seconds
    problem: str = ""


class Stress:
    def __init__(self, root: Path, kills: int, seed: int):
        self.root, self.kills, self.seed = root, kills, seed
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload(["tests.stress.mortal"])
        forkserver.ensure_running()  # before `tokenize_kills` asks for one with less
        self.journal = Journal(root / "journal.jsonl")
        self.rounds = [Round(**line) for line in self.journal.read()]
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(root / "compiled"))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

    def run(self) -> bool:
        """Whether everything that was killed ended as if it had not been."""
        if not prepared(self.root).exists():
            self._once(prepare_command(self.root), self.root / "preparing")
        todo = subjects(self.root)
        quotas = {s.name: round(s.share * self.kills) for s in todo}
        quotas[TOKENISING] = self.kills - sum(quotas.values())
        while left := quotas[TOKENISING] - self._done(TOKENISING):
            if not self._finish(self._tokenising(min(left, TOKENISING_AT_A_TIME))):
                return False
        for subject in todo:
            while left := quotas[subject.name] - self._done(subject.name):
                if not self._finish(self._round(subject, min(left, subject.at_a_time))):
                    return False
        return all(r.equal for r in self.rounds)

    def _done(self, subject: str) -> int:
        return sum(r.kills for r in self.rounds if r.subject == subject)

    def _place(self, subject: str) -> tuple[int, Path, random.Random]:
        """(number, empty directory, dice) of the next round."""
        number = sum(r.subject == subject for r in self.rounds)
        place = self.root / subject.replace(" ", "_") / str(number)
        while place.exists():  # of this program, killed in the midst of it, whose process may be ending just now
            shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
        return number, place, random.Random(f"{self.seed}/{subject}/{number}")

    def _finish(self, done: Round) -> bool:
        """Notes a round. Returns whether it ended well."""
        self.rounds.append(done)
        self.journal.append(asdict(done))
        fate = "equal" if done.equal else f"NOT EQUAL: {done.problem}"
        print(f"{done.subject} {done.number}: {done.kills} kills, {done.in_saves} within saves: {fate}", flush=True)
        return done.equal

    # --- Tokenising --------------------------------------------------------------------------

    def _tokenising(self, kills: int) -> Round:
        number, place, draw = self._place(TOKENISING)
        found = tokenize_kills.run(place, kills, TOKENISING_PROCESSES, draw.randrange(2**31))
        ended, terms = min(found.kills + found.left, kills), min(found.left, kills)
        if found.good:
            shutil.rmtree(place)
        return Round(
            TOKENISING, number, ended, terms, found.in_saves, found.good, problem="" if found.good else str(found)
        )

    # --- One command -------------------------------------------------------------------------

    def _round(self, subject: Subject, kills: int) -> Round:
        expected, seconds, steps = self._undisturbed(subject)
        number, place, draw = self._place(subject.name)
        ended, terms, in_saves, grace = 0, 0, 0, 0.0
        for _ in range(4 * kills):  # some end before their turn comes
            if ended == kills:
                break
            in_save, how = draw.random() < IN_SAVES, signal.SIGTERM if draw.random() < TERM else signal.SIGKILL
            process = self._start(subject.command(place), place, draw.randint(1, max(steps, 1)) if in_save else 0, how)
            if not in_save:
                process.join(draw.uniform(0, seconds))
                if process.is_alive():
                    os.kill(process.pid, how)
            began = time.monotonic()
            process.join(PATIENCE)
            code = process.exitcode
            if code is None:
                process.kill()
                return Round(subject.name, number, ended, terms, in_saves, False, grace, f"hangs, see {place}")
            if code == Exit.DONE:
                break  # it was finished before
            if code not in (-signal.SIGKILL, Exit.STOPPED):
                return Round(subject.name, number, ended, terms, in_saves, False, grace, f"exit {code}, see {place}")
            ended += 1
            terms += how == signal.SIGTERM
            in_saves += in_save
            if how == signal.SIGTERM and not in_save:
                grace = max(grace, time.monotonic() - began)
        self._once(subject.command(place), place)
        found = subject.contents(place)
        wrong = sorted(name for name in {**expected, **found} if expected.get(name) != found.get(name))
        if not wrong:
            shutil.rmtree(place)
        return Round(
            subject.name, number, ended, terms, in_saves, not wrong, grace,
            f"{len(wrong)} differ, {wrong[:3]}, see {place}" if wrong else "",
        )  # fmt: skip

    def _undisturbed(self, subject: Subject) -> tuple[dict[str, bytes], float, int]:
        """(what it leaves, seconds that it takes, steps of its saves), made if it is not there."""
        place = self.root / subject.name.replace(" ", "_") / "undisturbed"
        facts = Journal(place / "facts.jsonl")
        if not (lines := facts.read()):
            shutil.rmtree(place, ignore_errors=True)
            self._once(subject.command(place / "first"), place / "first")  # compiles
            began = time.monotonic()
            steps = self._once(subject.command(place / "second"), place / "second")
            facts.append({"seconds": time.monotonic() - began, "steps": steps})
            lines = facts.read()
        expected = subject.contents(place / "second")
        assert expected == subject.contents(place / "first"), f"two undisturbed runs differ, see {place}"
        return expected, lines[0]["seconds"], lines[0]["steps"]

    def _start(
        self, command: tuple[str, ...], place: Path, ends_in: int = 0, how: signal.Signals = signal.SIGKILL
    ) -> Any:
        place.mkdir(parents=True, exist_ok=True)
        begun = self.context.Event()
        process = self.context.Process(
            target=mortal.run, args=(list(command), place / "output.txt", place / "steps.jsonl", ends_in, how, begun)
        )
        process.start()
        begun.wait(PATIENCE)
        return process

    def _once(self, command: tuple[str, ...], place: Path) -> int:
        """Runs a command to its end. Returns how many steps its saves have."""
        process = self._start(command, place)
        process.join()
        if process.exitcode != Exit.DONE:
            raise SystemExit(
                f"`hma {' '.join(command)}` ended with exit code {process.exitcode}, see {place}/output.txt"
            )
        return sum(line["what"] == "counts" and int(line["place"]) for line in read(place / "steps.jsonl"))

    def figures(self) -> str:
        kills, rounds = Counter(), Counter()
        for r in self.rounds:
            kills[r.subject] += r.kills
            rounds[r.subject] += 1
        total, good = sum(kills.values()), sum(r.kills for r in self.rounds if r.equal)
        parts = ", ".join(f"{name} {kills[name]} in {rounds[name]} rounds" for name in kills)
        return (
            f"{good} of {total} kills left no trace ({parts}); {sum(r.terms for r in self.rounds)} by SIGTERM or "
            f"Ctrl-C, {sum(r.in_saves for r in self.rounds)} within a save; "
            f"{sum(r.equal for r in self.rounds)} of {len(self.rounds)} rounds byte-equal; "
            f"at most {max((r.grace for r in self.rounds), default=0):.1f} s from SIGTERM to the end"
        )


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--state", type=Path, help="a directory that is kept; without it, a temporary one")
    args = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as temporary:
        root = (args.state or Path(temporary)).absolute()
        root.mkdir(parents=True, exist_ok=True)
        with exclusive(root / ".lock"):
            stress = Stress(root, args.kills, args.seed)
            began = time.monotonic()
            good = stress.run()
            print(f"{stress.figures()}; seed {args.seed}, {time.monotonic() - began:.0f} s since this start")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
