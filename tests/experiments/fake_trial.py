"""A trial that counts instead of training: what the runner's tests start as a process.

Used as `fake_trial.py DIRECTORY` (one trial) or `fake_trial.py --sweep ROOT` (the runner with
three trials). Behaviour comes from job.json: 'steps', 'seconds' per step, 'end'.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path

from experiments.running.children import settle
from experiments.running.ledger import Ledger
from experiments.running.runner import Job, run_missing

THREE = [Job(f"t{i}", f"trial {i}", {"steps": 8, "seconds": 0.05, "end": "result"}) for i in range(3)]


def command(directory: Path) -> list[str]:
    return [sys.executable, __file__, str(directory)]


def run_one(directory: Path) -> int:
    """Counts to 'steps', saving the count as it goes, and ends as told."""
    job = json.loads((directory / "job.json").read_text())
    saved = directory / "count.txt"
    start = int(saved.read_text() or 0) if saved.exists() else 0
    with open(directory / "starts.txt", "a") as file:
        file.write(f"{start}\n")
    for count in range(start + 1, job["steps"] + 1):
        time.sleep(job["seconds"])
        aside = saved.with_suffix(".tmp")
        aside.write_text(str(count))
        aside.replace(saved)
    match job["end"]:
        case "result":
            (directory / "result.json").write_text(json.dumps({"count": job["steps"]}))
        case "diverge":
            (directory / "failure.json").write_text(json.dumps({"state": "diverged", "message": "loss is nan"}))
            return 1
        case "crash":
            raise SystemExit("no such luck")
        case "killed":
            os.kill(os.getpid(), signal.SIGKILL)
    return 0


if __name__ == "__main__":
    settle()
    if sys.argv[1] == "--sweep":
        root = Path(sys.argv[2])
        run_missing(THREE, root / "trials", Ledger(root / "ledger.jsonl"), command=command, poll_seconds=0.02)
    else:
        sys.exit(run_one(Path(sys.argv[1])))
