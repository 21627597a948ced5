"""A shared disk that does not answer for a while, for instance while its server restarts."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from hma_jax.runtime.files import IO_ERRNOS

WAITS = (1.0, 2.0, 4.0, 8.0, 15.0)
"""Seconds before each further try."""

T = TypeVar("T")

log = logging.getLogger(__name__)


def retry_io(act: Callable[..., T], *arguments: object) -> T:
    """What `act` returns; it may be called more than once. Raises OSError; the errors of a failing disk, such as
    ESTALE, only after the last try."""
    for wait in WAITS:
        try:
            return act(*arguments)
        except OSError as error:
            if error.errno not in IO_ERRNOS:
                raise
            log.warning("%s; trying again in %.0f s", error, wait)
        time.sleep(wait)
    return act(*arguments)
