"""What a process prints besides its results: log messages as plain lines, and nothing from background threads."""

from __future__ import annotations

import logging
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

LOGGERS = ("hma_jax", "data_pipelines", "experiments")
"""Parents of all loggers of this project."""


def silence_background() -> None:
    """Silences background reports for the rest of this process: if a checkpoint turns out damaged, its reader tasks
    report it at length, from threads and destructors where nothing can catch it, until the very end. The error message
    says it once.
    """
    sys.unraisablehook = _say_nothing
    warnings.filterwarnings("ignore", "coroutine .* was never awaited", RuntimeWarning)
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)


@contextmanager
def plain_messages() -> Iterator[None]:
    """While the block runs, each log message of this project is a plain line on standard error, even after a library
    has called `logging.basicConfig`, which would prefix it with a level and a module. The stream is looked up at each
    message: a progress bar replaces standard error to show lines above itself."""
    handler, loggers = logging.lastResort, [logging.getLogger(name) for name in LOGGERS]
    for logger in loggers:
        logger.addHandler(handler)
        logger.propagate = False
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
            logger.propagate = True


def background_is_silent() -> bool:
    return sys.unraisablehook is _say_nothing


def _say_nothing(_: object) -> None: ...
