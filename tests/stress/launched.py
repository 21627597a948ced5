"""A small sweep on this machine, and the same one through an engine whose jobs, nodes and runner are disturbed."""

from __future__ import annotations

import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from experiments.running.attempts import OUTPUT, PROGRESS, read_progress
from experiments.running.workspace import Workspace

SWEEP = ("sweep", "trajectories", "--preset", "smoke", "--set", "trajectory_counts=2,4")
PROBE = 300
"""Steps from which the speed of training is known."""

PATIENCE = 900.0
"""Seconds for anything to happen, on a machine that is busy with something else."""


def command(out: Path, steps: int, *more: str) -> list[str]:
    return [sys.executable, "-m", "experiments.cli", *SWEEP, "--set", f"train.steps={steps}", "--out", str(out), *more]


def steps_within(seconds: float, root: Path) -> int:
    """How many steps a trial of the sweep makes in `seconds` of training here, found by a short one: enough for
    it to be disturbed in its middle on a machine of any speed."""
    print("how fast a trial is ...", flush=True)
    trial = (sys.executable, "-m", "experiments.cli", "train", "--preset", "smoke", "--set", f"train.steps={PROBE}")
    subprocess.run([*trial, "--out", str(root / "probe")], check=True, stdout=subprocess.DEVNULL)
    lines = (root / "probe" / "model" / "timing.jsonl").read_text().splitlines()
    each = min(json.loads(line)["seconds_per_step"] for line in lines)
    return math.ceil(seconds / each)


def run_here(root: Path, steps: int) -> bytes:
    """The sweep on this machine, undisturbed; returns its CSV."""
    out = Workspace(root / "here")
    print(f"the sweep on this machine, trials of {steps} steps ...", flush=True)
    subprocess.run(command(out.root, steps), check=True, stdout=subprocess.DEVNULL)
    return out.results.read_bytes()


class Sweep:
    """The sweep through a launcher, on the data of the one that was run here."""

    def __init__(self, root: Path, steps: int, more: Sequence[str], environment: dict[str, str]):
        here, self.out = Workspace(root / "here"), Workspace(root / "there")
        made = (here.trials, here.ledger, here.results, here.figures, here.report)
        shutil.copytree(here.root, self.out.root, ignore=lambda _, names: {p.name for p in made} & set(names))
        self.command = command(self.out.root, steps, *more)
        self.environment = os.environ | environment
        self.log = root / "there.txt"
        self.start()

    def start(self) -> None:
        with open(self.log, "a") as log:
            self.process = subprocess.Popen(self.command, env=self.environment, stdout=log, stderr=log)

    def records(self) -> list[dict[str, Any]]:
        try:
            lines = self.out.ledger.read_text().splitlines()
        except FileNotFoundError:
            return []
        return [json.loads(line) for line in lines]

    def training(self, but: Sequence[str] = ()) -> dict[str, Any] | None:
        """The last start of a trial, none of `but`, that is in the middle of its training."""
        last = {record["trial"]: record for record in self.records()}
        for id, record in last.items():
            if not self._has_shown(self.out.trials / id / PROGRESS, record["time"]):
                continue
            progress = read_progress(self.out.trials / id) or {}
            share = progress.get("done", 0) / max(progress.get("total", 1), 1)
            if id not in but and record["event"] == "running" and progress.get("phase", "").startswith("training"):
                if 0.1 < share < 0.7:
                    return record
        return None

    @staticmethod
    def _has_shown(progress: Path, since: float) -> bool:
        """Whether an attempt that began `since` then has written its progress; an earlier one's lies there too."""
        return progress.exists() and progress.stat().st_mtime > since

    def wait_for(self, what: str, condition: Callable[[], Any]) -> Any:
        """What `condition` returns once it is true. Ends the program, with the logs, if that takes too long."""
        deadline = time.monotonic() + PATIENCE
        while not (found := condition()):
            if time.monotonic() > deadline or self.process.poll() is not None and what != "the end":
                self.fail(f"waited in vain for {what}")
            time.sleep(0.2)
        print(f"  {what}: {found if isinstance(found, dict) else 'yes'}", flush=True)
        return found

    def wait_for_start(self, what: str, trial: str, after: int) -> None:
        """Until a trial has started more than `after` times."""
        self.wait_for(what, lambda: self.starts()[trial] > after)

    def starts(self) -> Counter[str]:
        return Counter(r["trial"] for r in self.records() if r["event"] == "running")

    def finish(self, csv: bytes) -> bool:
        """Waits for the end, prints what happened, and says whether the CSV has these bytes."""
        self.wait_for("the end", lambda: self.process.poll() is not None)
        if self.process.returncode != 0:
            self.fail(f"the sweep ended with exit code {self.process.returncode}")
        print(f"  events: {dict(Counter(r['event'] for r in self.records()))}")
        print(f"  starts of each trial: {sorted(self.starts().values(), reverse=True)}")
        equal = self.out.results.read_bytes() == csv
        print(f"the CSV of {len(csv):,} bytes is {'the same' if equal else 'ANOTHER ONE'}")
        return equal

    def fail(self, why: str) -> None:
        for log in (self.log, self.out.ledger, *self.out.trials.glob(f"*/{OUTPUT}")):
            if log.exists():
                print(f"--- {log}", *log.read_text().splitlines()[-20:], sep="\n")
        raise SystemExit(why)

    def __enter__(self) -> Sweep:
        return self

    def __exit__(self, *exc: object) -> None:
        if self.process.poll() is None:
            self.process.terminate()
            self.process.wait(120)
