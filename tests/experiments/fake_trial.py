"""A trial that counts instead of training: what the runner's tests start as a process.

Used as `fake_trial.py DIRECTORY` (one trial) or `fake_trial.py --sweep ROOT` (the runner with
three trials). Behaviour comes from job.json: 'steps', 'seconds' per step, 'end', 'times' that it is killed, and whether
every start leaves one of 'checkpoints'.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from experiments.running.attempts import RUN, attempt
from experiments.running.children import enter_child
from experiments.running.launchers.local import LocalLauncher
from experiments.running.ledger import Ledger
from experiments.running.runner import Job, run_missing
from hma_jax.runtime.exits import Exit, exit_of_interrupt, sigterm_as_interrupt
from hma_jax.training.run_lock import CHECKPOINTS

THREE = [Job(f"t{i}", f"trial {i}", {"steps": 8, "seconds": 0.05, "end": "result"}) for i in range(3)]


def command(directory: Path) -> list[str]:
    return [sys.executable, __file__, str(directory)]


def launcher(root: Path, workers: int = 1) -> LocalLauncher:
    place = LocalLauncher(root, workers, command=command)
    place.pause = 0.01
    return place


def count_to_the_end(directory: Path) -> int:
    """Counts to 'steps', saving the count as it goes, and ends as told."""
    job = json.loads((directory / "job.json").read_text())
    saved = directory / RUN / "count.txt"
    saved.parent.mkdir(exist_ok=True)
    start = int(saved.read_text() or 0) if saved.exists() else 0
    with open(directory / "starts.txt", "a") as file:
        file.write(f"{start}\n")
    for count in range(start + 1, job["steps"] + 1):
        time.sleep(job["seconds"])
        aside = saved.with_suffix(".tmp")
        aside.write_text(str(count))
        aside.replace(saved)
    starts = len((directory / "starts.txt").read_text().split())
    if job.get("checkpoints"):
        (saved.parent / CHECKPOINTS / str(starts)).mkdir(parents=True)
    killed = starts <= job.get("times", 1)
    match job["end"]:
        case "diverge":
            (directory / "failure.json").write_text(json.dumps({"state": "diverged", "message": "loss is nan"}))
            return 1
        case "crash":
            raise SystemExit("no such luck")
        case "none":
            return 0
        case "full disk" if killed:
            return Exit.LOST
        case end if end.startswith("SIG") and killed:
            os.kill(os.getpid(), signal.Signals[end])
    (directory / "result.json").write_text(json.dumps({"count": job["steps"]}))
    return 0


if __name__ == "__main__":
    if sys.argv[1] == "--sweep":
        root = Path(sys.argv[2])
        run_missing(THREE, root / "trials", Ledger(root / "ledger.jsonl"), launcher(root))
    else:
        enter_child()
        try:
            with sigterm_as_interrupt(), attempt(Path(sys.argv[1])):
                sys.exit(count_to_the_end(Path(sys.argv[1])))
        except KeyboardInterrupt as request:
            sys.exit(exit_of_interrupt(request))
