"""Our stages beside the official release's: processes that take turns, so that a slow spell hits all."""

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
from hma_jax.runtime.host_memory import HUGE_PAGES

RELEASED = {
    "forward": "forward",
    "fill": "frame",
    "slide": "frame",
    "step": "step",
    "continuous fill": "continuous frame",
    "continuous slide": "continuous frame",
    "continuous few": "continuous frame",
}
"""Our stage -> the release's that gives the same."""

OURS, THEIRS, TUNED = "ours: ", "release: ", "release with huge pages: "
"""The release as its users start it, and with the environment in which this program starts itself."""


class Worker:
    """A process that runs stages when asked."""

    def __init__(self, command: Sequence[str], **environment: str):
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=os.environ | environment
        )

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(BrokenPipeError):  # it ended by itself
            self.process.stdin.close()
        self.process.wait()

    def run(self, stage: str) -> float:
        """Seconds. Raises ConfigError if the process ended instead of answering."""
        with suppress(BrokenPipeError):
            print(stage, file=self.process.stdin, flush=True)
        answer = self.process.stdout.readline()
        if not answer:
            code = self.process.wait()
            raise ConfigError(f"the process that times {stage!r} ended with code {code}; what it printed is above")
        return float(answer)


def time_beside(
    release: Path, python: Path, names: Sequence[str], turns: int, progress: Callable[[str, int], None]
) -> tuple[list[Stage], dict[str, float]]:
    """(stages of both, how many times faster ours are). `release` is a checkout, `python` an interpreter that
    has what it imports. Raises ConfigError."""
    unknown = sorted(set(names) - set(RELEASED))
    require(not unknown, f"no stage {', '.join(unknown)}; known: {', '.join(RELEASED)}")
    require((release / "hma" / "model").is_dir(), f"{release} is no checkout of the official release (liruiw/HMA)")
    # As text: started from its file, it would find our modules beside it before those of the standard library.
    script = Path(__file__).with_name("released.py").read_text()
    turns_of = (((THEIRS, RELEASED[name]), (TUNED, RELEASED[name]), (OURS, name)) for name in names)
    order = list(dict.fromkeys(turn for of_one in turns_of for turn in of_one))
    checkout = {"PYTHONPATH": str(release.absolute())}
    seconds: dict[tuple[str, str], list[float]] = {turn: [] for turn in order}
    with ExitStack() as stack:
        workers = {
            whose: stack.enter_context(Worker(command, **environment))
            for whose, command, environment in (
                (THEIRS, [str(python), "-c", script], checkout | dict.fromkeys(HUGE_PAGES, "")),
                (TUNED, [str(python), "-c", script], checkout | HUGE_PAGES),
                (OURS, [sys.executable, "-m", "experiments.bench.stages"], HUGE_PAGES),
            )
        }
        for turn in range(-1, turns):  # the first one compiles and warms up
            for whose, stage in order:
                progress(f"{whose}{stage}", max(turn, 0))
                took = workers[whose].run(stage)
                if turn >= 0:
                    seconds[whose, stage].append(took)
    stages = [Stage(f"{whose}{stage}", 1, summarise(taken)) for (whose, stage), taken in seconds.items()]
    median = {stage.name: stage.timing.median for stage in stages}
    ratios = {}
    for name in names:
        for whose, words in ((THEIRS, "times faster"), (TUNED, "times faster than with huge pages")):
            ratios[f"{name}, {words}"] = median[whose + RELEASED[name]] / median[OURS + name]
    return stages, ratios
