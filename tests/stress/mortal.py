"""A process that runs one command of `hma` and may end itself within a save.

Started by `kill_resume`, from a server that has the imports, so that starting one takes no time.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from pathlib import Path

import tensorflow_datasets  # noqa: F401  once, in the server that processes are forked from

import data_pipelines.loading.frames  # noqa: F401
import data_pipelines.loading.loader  # noqa: F401
import experiments.preparing.pipeline
import experiments.preparing.suite
import experiments.preparing.tokenizer
import experiments.running.run_trial  # noqa: F401
import hma_jax.evaluation.evaluate
import hma_jax.tokenizers.train
import hma_jax.training.train  # noqa: F401
from experiments.cli.main import main
from experiments.running import children
from hma_jax.runtime.exits import exit_of_interrupt, sigterm_as_interrupt
from tests.stress.tokenize_process import end_in_save, write


def run(
    arguments: list[str], output: Path, log: Path, ends_in: int, how: signal.Signals, begun: multiprocessing.Event
) -> None:
    """`hma ARGUMENTS`, which writes what it says to `output`, once `begun` is set. `ends_in`: sends itself the signal
    `how` before this step of its saves, from 1 on; 0: before none. `log` says how many there were."""
    os.environ[children._PARENT] = str(os.getppid())
    children.enter_child()  # it ends with the server, and that with the program that kills
    said = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(said, 1)
    os.dup2(said, 2)
    steps = end_in_save(log, ends_in, how)
    try:
        with sigterm_as_interrupt():
            begun.set()
            code = main(arguments)
    except KeyboardInterrupt as request:  # a moment before `main` was ready for it
        code = exit_of_interrupt(request)
    write(log, "counts", str(steps()))
    sys.exit(int(code))
