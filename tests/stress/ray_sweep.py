"""A sweep on a real Ray cluster of a head and two nodes on this machine; a worker, then a whole node is killed.

    python -m tests.stress.ray_sweep

Starts and stops its own cluster; needs the extra `ray`. The command itself is stopped by SIGTERM and started again.
The last line says whether the CSV has the bytes of the same sweep on one machine; exits with 1 otherwise.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.stress.launched import Sweep, run_here, steps_within


@contextmanager
def cluster() -> Iterator[Any]:
    """A head that runs no trials, and two nodes of one processor each."""
    from ray.cluster_utils import Cluster

    made = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for _ in range(2):
            made.add_node(num_cpus=1)
        made.wait_for_nodes()
        yield made
    finally:
        made.shutdown()


def parents(process: int) -> Iterator[int]:
    """The process above a process, the one above that, and so on."""
    while process > 1:
        status = Path(f"/proc/{process}/status").read_text()
        process = next(int(line.split()[1]) for line in status.splitlines() if line.startswith("PPid:"))
        yield process


def raylet_above(made: Any, process: int) -> Any:
    """The node on which a trial's process runs."""
    above = set(parents(process))
    for node in made.worker_nodes:
        if any(info.process.pid in above for info in node.all_processes["raylet"]):
            return node
    raise SystemExit(f"process {process} belongs to no node")


def disturb(sweep: Sweep, made: Any) -> None:
    first = sweep.wait_for("a trial whose worker is killed", sweep.training)
    os.kill(next(parents(first["process"])), signal.SIGKILL)
    second = sweep.wait_for("a trial whose node is killed", lambda: sweep.training([first["trial"]]))
    made.remove_node(raylet_above(made, second["process"]), allow_graceful=False)
    sweep.wait_for_start("the one starts again", first["trial"], 1)
    sweep.wait_for_start("the other starts on the node that is left", second["trial"], 1)

    sweep.wait_for("a trial in the middle when the command is stopped", sweep.training)
    sweep.process.terminate()
    code = sweep.process.wait(120)
    if code != 143 or sweep.records()[-1]["event"] != "preempted":
        sweep.fail(f"on SIGTERM it ended with {code} and the record {sweep.records()[-1]}")
    made.add_node(num_cpus=1)
    sweep.start()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="that a trial trains on this machine")
    seconds = parser.parse_args().seconds
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        steps = steps_within(seconds, root)
        csv = run_here(root, steps)
        with cluster() as made:
            more = ("--launcher", "ray", "--launcher-set", f"address={made.address}")
            with Sweep(root, steps, more, {}) as sweep:
                print("the same on a Ray cluster ...", flush=True)
                disturb(sweep, made)
                return 0 if sweep.finish(csv) else 1


if __name__ == "__main__":
    sys.exit(main())
