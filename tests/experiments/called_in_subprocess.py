"""What tests call in processes of their own; it is imported there, so it imports little."""

import os
import time
from pathlib import Path

from hma_jax.runtime.exits import exit_of_interrupt


class Unsendable(Exception):
    def __init__(self, number: int, word: str):
        super().__init__(f"{word} {number}")


def fail() -> None:
    raise Unsendable(3, "three")


def end_by(number: int) -> None:
    os.kill(os.getpid(), number)
    time.sleep(60)


def work_until_asked(started: Path, saves: bool) -> None:
    try:
        started.write_text(str(os.getpid()))
        time.sleep(60)
    except KeyboardInterrupt as request:
        if saves:
            from hma_jax.training.loop import Interrupted

            raise Interrupted("stopped at step 3", exit_of_interrupt(request)) from None
        raise
