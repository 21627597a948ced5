"""python -m tests.stress.hosts [--cut 30] [--lost-after 90]: two "hosts" and a line between them that is cut.

Each host is a network namespace with an address and a name of its own, a veth pair is the line. One process on
each trains a tiny model together. The line is cut for --cut seconds, which the job must survive; then for good,
after which both must end with code 75 within two minutes, each naming the other's host. The job that is started
again goes on from the last checkpoint, and ends with the log of one that nothing happened to. Prints what it does,
and one line of figures as JSON last; ends with 1 if anything is not so. Needs root, and iproute2 and util-linux.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from hma_jax.runtime.exits import Exit
from hma_jax.training.reading import list_steps
from tests.conftest import FAST_COMPILATION
from tests.multihost.processes import ROOT, Started, run

MODULE = "tests.multihost.train_together"
HOSTS = {"hosta": "10.93.77.1", "hostb": "10.93.77.2"}
FOREVER, EVERY = 1_000_000, 5  # steps
DIES_WITH_PARENT = ("setpriv", "--pdeathsig", "KILL")


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True)


class Line:
    """The line between the two hosts."""

    def __init__(self, tag: str):
        self.names = {host: f"hma{tag}{host}" for host in HOSTS}
        self.ends = {host: f"h{tag}{host[-1]}" for host in HOSTS}

    def cut(self) -> None:
        ip("-n", self.names["hosta"], "link", "set", self.ends["hosta"], "down")

    def mend(self) -> None:
        ip("-n", self.names["hosta"], "link", "set", self.ends["hosta"], "up")


@contextmanager
def two_hosts() -> Iterator[Line]:
    line = Line(str(os.getpid()))
    try:
        for host, name in line.names.items():
            ip("netns", "add", name)
            own = Path("/etc/netns") / name  # `ip netns exec` shows its files as those of /etc
            own.mkdir(parents=True)
            table = [f"{address} {other}" for other, address in HOSTS.items()]
            (own / "hosts").write_text("\n".join(["127.0.0.1 localhost", *table]) + "\n")
        a, b = line.names.values()
        one, other = line.ends.values()
        ip("link", "add", one, "netns", a, "type", "veth", "peer", "name", other, "netns", b)
        for host, name in line.names.items():
            ip("-n", name, "addr", "add", f"{HOSTS[host]}/24", "dev", line.ends[host])
            ip("-n", name, "link", "set", "lo", "up")
            ip("-n", name, "link", "set", line.ends[host], "up")
        yield line
    finally:
        for name in line.names.values():
            subprocess.run(["ip", "netns", "del", name], check=False)
            shutil.rmtree(Path("/etc/netns") / name, ignore_errors=True)


def begin(line: Line, directory: Path, turn: str, **asked) -> list[Started]:
    started = []
    for p, (host, name) in enumerate(line.names.items()):
        output = directory / f"{turn}-{host}.txt"
        environment = os.environ | {
            "HMA_COORDINATOR": f"{HOSTS['hosta']}:{29400 + len(turn)}", "HMA_PROCESSES": "2", "HMA_PROCESS": str(p),
            "XLA_FLAGS": " ".join(FAST_COMPILATION), "JAX_PLATFORMS": "cpu",
        }  # fmt: skip
        on_host = ["ip", "netns", "exec", name, "unshare", "--uts", "sh", "-c", 'hostname "$0" && exec "$@"', host]
        train = [sys.executable, "-u", "-m", MODULE, str(directory / "run"), json.dumps(asked)]
        with open(output, "w") as file:
            process = subprocess.Popen(
                [*on_host, *DIES_WITH_PARENT, *train], env=environment, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT
            )
        started.append(Started(process, output))
    return started


def last_step(started: Started) -> int:
    lines = [line for line in started.output.read_text().splitlines() if line.startswith("step ")]
    return int(lines[-1].split()[1]) if lines else 0


def wait_for_step(started: list[Started], step: int, seconds: float) -> float:
    """How long it took. Raises AssertionError if a process ends, or the time does."""
    began = time.monotonic()
    while min(map(last_step, started)) < step:
        for one in started:
            assert one.process.poll() is None, f"ended with {one.process.poll()}: {one.output.read_text()[-2000:]}"
        assert time.monotonic() - began < seconds, f"step {step} was not reached in {seconds} s"
        time.sleep(0.1)
    return time.monotonic() - began


def losses(run_dir: Path) -> list[float]:
    return [json.loads(line)["loss"] for line in (run_dir / "metrics.jsonl").read_text().splitlines()]


def measure(directory: Path, cut: float, lost_after: float) -> dict[str, float]:
    figures: dict[str, float] = {"cut_seconds": cut, "lost_after": lost_after}
    run_dir, how = directory / "run", {"every": EVERY, "pause": 0.2, "lost_after": lost_after}
    with two_hosts() as line:
        first = begin(line, directory, "1", steps=FOREVER, **how)
        wait_for_step(first, 10, 600)
        print(f"cut for {cut:.0f} s", flush=True)
        line.cut()
        began = time.monotonic()
        time.sleep(cut)
        stood = max(map(last_step, first))
        line.mend()
        wait_for_step(first, stood + 10, 120)
        figures["steps_again_after_seconds"] = round(time.monotonic() - began - cut, 1)
        print(f"survived; steps went on {figures['steps_again_after_seconds']} s after the line was back", flush=True)

        line.cut()
        began = time.monotonic()
        print("cut for good", flush=True)
        for one, me, other in zip(first, HOSTS, reversed(HOSTS), strict=True):
            code, said = one.wait(timeout=180)
            figures[f"{me}_ended_after_seconds"] = round(time.monotonic() - began, 1)
            message = [text for text in said.splitlines() if text.startswith("error: lost process")]
            print(f"{me} ended with {code}: {message}", flush=True)
            assert code == Exit.LOST, f"{me} ended with {code}: {said[-2000:]}"
            assert message and f"on host {other}" in message[0], said[-2000:]
            assert time.monotonic() - began < 120, "it took more than two minutes"
        saved, logged = list_steps(run_dir / "checkpoints")[-1], len(losses(run_dir))

        line.mend()
        again = begin(line, directory, "again", steps=saved + 10, **how | {"pause": 0.0})
        for one in again:
            code, said = one.wait()
            assert code == 0, said[-2000:]
        report = json.loads(again[0].output.read_text().splitlines()[-1])
        assert report["resumed_from"] == saved, report["resumed_from"]
    figures |= {"steps_logged_before_the_end": logged, "resumed_from": saved}
    asked = json.dumps({"steps": saved + 10})
    run(MODULE, [str(directory / "alone"), asked], processes=1, devices=2, flags=" ".join(FAST_COMPILATION))
    one, two = losses(directory / "alone"), losses(run_dir)
    assert len(one) == len(two) == saved + 10, (len(one), len(two), saved)
    figures["largest_relative_difference_of_losses"] = float(np.max(np.abs(np.array(one) / np.array(two) - 1)))
    assert figures["largest_relative_difference_of_losses"] < 1e-5, figures
    return figures


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cut", type=float, default=30.0, help="seconds of the first cut")
    parser.add_argument("--lost-after", type=float, default=90.0, help="as of hma train")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="hma-hosts-") as directory:
        try:
            figures = measure(Path(directory), args.cut, args.lost_after)
        except AssertionError as error:
            print(f"failed: {error}")
            return 1
    print(json.dumps(figures))
    return 0


if __name__ == "__main__":
    sys.exit(main())
