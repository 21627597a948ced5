"""Times our stages against the official release's: processes that take turns, so that a slow spell hits all."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from experiments.bench.record import Stage
from experiments.bench.timing import summarise
from hma_jax.config import ConfigError, require
from hma_jax.config.execution import Dtype
from hma_jax.runtime.host_memory import KEPT_PAGES

RELEASE_STAGES = {
    "forward": "forward",
    "fill": "frame",
    "slide": "frame",
    "step": "step",
    "continuous fill": "continuous frame",
    "continuous slide": "continuous frame",
    "continuous few": "continuous frame",
}
"""Our stage -> the release's that gives the same."""

OUR_PREFIX, RELEASE_PREFIX = "ours: ", "release: "

SHARED = {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
"""Environment of a process that leaves GPU memory for others."""


class Worker:
    """A process that runs stages when asked."""

    def __init__(self, command: Sequence[str], **environment: str):
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ | environment
        )

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(BrokenPipeError):  # it ended on its own
            self.process.stdin.close()
        self.process.wait()

    def run(self, stage: str) -> float:
        """Runs a stage and returns the seconds it took. Raises ConfigError if the process ended instead of
        answering."""
        with suppress(BrokenPipeError):
            print(stage, file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        if not answer:
            code = self.process.wait()
            raise ConfigError(f"the process that times {stage!r} ended with code {code}; what it printed is above")
        return float(answer)


def time_against_release(
    release: Path,
    python: Path,
    names: Sequence[str],
    turns: int,
    progress: Callable[[str, int], None],
    *,
    rows: int = 1,
    dtype: Dtype = "float32",
) -> tuple[list[Stage], dict[str, float]]:
    """(stages of both, how many times faster ours are), of `rows` examples at a time. `release` is a checkout, `python`
    an interpreter that has what it imports. Raises ConfigError."""
    unknown = sorted(set(names) - set(RELEASE_STAGES))
    require(not unknown, f"no stage {', '.join(unknown)}; known: {', '.join(RELEASE_STAGES)}")
    require((release / "hma" / "model").is_dir(), f"{release} is no checkout of the official release (liruiw/HMA)")
    seconds: dict[str, list[float]] = {}
    for release_stage in dict.fromkeys(RELEASE_STAGES[name] for name in names):
        our_stages = [name for name in names if RELEASE_STAGES[name] == release_stage]
        seconds |= _take_turns(release, python, release_stage, our_stages, turns, progress, (str(rows), dtype))
    stages = [Stage(stage, rows, summarise(taken)) for stage, taken in seconds.items()]
    median = {stage.name: stage.timing.median for stage in stages}
    ratios = {
        f"{name}, times faster": median[RELEASE_PREFIX + RELEASE_STAGES[name]] / median[OUR_PREFIX + name]
        for name in names
    }
    return stages, ratios


def _take_turns(
    release: Path,
    python: Path,
    release_stage: str,
    our_stages: Sequence[str],
    turns: int,
    progress: Callable[[str, int], None],
    arguments: Sequence[str],
) -> dict[str, list[float]]:
    """Seconds of every turn, for one stage of the release and our stages that compute the same.

    Every stage has its own process, as for its users, so that none finds memory that others have fragmented.
    """
    # Passed as text: started from its file, it would find our neighbouring modules before those of the standard
    # library.
    script = Path(__file__).with_name("released.py").read_text()
    as_its_users = {"PYTHONPATH": str(release.absolute())} | dict.fromkeys(KEPT_PAGES, "")
    with ExitStack() as stack:
        release_command = [str(python), "-c", script, *arguments]
        workers = {
            RELEASE_PREFIX + release_stage: (
                release_stage,
                stack.enter_context(Worker(release_command, **as_its_users)),
            )
        }
        for name in our_stages:
            command = [sys.executable, "-m", "experiments.bench.stages", *arguments]
            worker = stack.enter_context(Worker(command, **KEPT_PAGES, **SHARED))
            workers[OUR_PREFIX + name] = (name, worker)
        seconds: dict[str, list[float]] = {stage: [] for stage in workers}
        for turn in range(-1, turns):  # the first one compiles and warms up
            for label, (stage, worker) in workers.items():
                progress(label, max(turn, 0))
                took = worker.run(stage)
                if turn >= 0:
                    seconds[label].append(took)
    return seconds
