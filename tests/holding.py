"""A lock that another process holds. That process imports this file and the lock alone, not JAX with the tests."""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from multiprocessing.context import SpawnProcess
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

Lock = Callable[..., AbstractContextManager]


def hold(lock: Lock, place: Path, how: dict[str, Any], held: Event) -> None:
    with lock(place, **how) as it:
        getattr(it, "scratch", None)  # that of an output is made when it is first asked for
        held.set()
        time.sleep(60)


def start_holder(lock: Lock, place: Path, **how: Any) -> SpawnProcess:
    """A process that holds `lock(place, **how)` by now, and for a minute or until it is killed."""
    context = multiprocessing.get_context("spawn")
    held = context.Event()
    process = context.Process(target=hold, args=(lock, place, how, held))
    process.start()
    assert held.wait(60)
    return process
