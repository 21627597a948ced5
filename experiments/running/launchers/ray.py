"""A Ray cluster: one task for each trial, on whichever machine has the cores and accelerators that it asks for.

Machines may differ and may come and go. Ray tells each task which accelerators are its own. Ray does not retry a task
whose worker or machine dies: the runner does that, within its limit.
"""

from __future__ import annotations

import math
import os
import re
import signal
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.running.attempts import AttemptEnd, is_alive
from experiments.running.launchers.base import Command, Launcher, trial_command
from experiments.running.launchers.remote import Attempt, unwant
from hma_jax.config import ConfigError, require


@dataclass(frozen=True)
class RaySettings:
    """The cluster, and what each trial takes from it."""

    address: str = "auto"  # of the head, "host:6379" or "ray://host:10001"; auto: the one this machine is part of
    cpus: float = 1
    gpus: float = 0
    tpus: int = 0  # chips
    memory_gb: float | None = None
    resources: tuple[str, ...] = ()  # further resources that the cluster names, such as "big_memory=1"

    def __post_init__(self):
        for name in ("cpus", "gpus", "tpus"):
            value = getattr(self, name)
            whole = value <= 1 or float(value).is_integer()  # as Ray asks for it
            require(
                value >= 0 and whole, f"--launcher-set {name}={value:g}: it must be 0 or more, above 1 a whole number"
            )
        memory = 1.0 if self.memory_gb is None else self.memory_gb
        require(0 < memory < math.inf, f"--launcher-set memory_gb={memory:g}: it must be positive")
        for resource in self.resources:
            amount = re.fullmatch(r"[^=]+=(\d+(?:\.\d+)?)", resource)
            require(
                amount is not None and float(amount[1]) > 0,
                f"--launcher-set resources={resource}: write it as resources=NAME=AMOUNT, such as resources=fast_disk=1",
            )


@dataclass(frozen=True)
class Task:
    directory: Path
    reference: Any  # Ray's, to what the task returns


class RayLauncher(Launcher):
    """`workers`: how many trials run at a time; None: as many as the cluster holds. Raises ConfigError without it."""

    Settings = RaySettings
    needs = "ray"
    pause = 0.5

    def __init__(
        self,
        root: Path,
        workers: int | None,
        settings: RaySettings = RaySettings(),
        command: Command = trial_command,
        engine: Any = None,
    ):
        self.at_once = self.limit(workers, settings) or Launcher.at_once
        self._root, self._command = root, command
        self._accelerator = "tpu" if settings.tpus else "gpu" if settings.gpus else ""
        self._ray = engine or _join(settings.address)
        self._run = self._ray.remote(**_options(settings))(run)

    @classmethod
    def share(cls, workers: int | None, settings: RaySettings) -> float | None:
        return settings.gpus or settings.tpus or None

    def launch(self, directories: Sequence[Path]) -> list[Task]:
        # Made before any is asked for: making one may raise.
        attempts = [Attempt(d, self._root / "compiled", self._command, self._accelerator) for d in directories]
        return [Task(attempt.directory, self._run.remote(attempt)) for attempt in attempts]

    def ended(self, handle: Task) -> AttemptEnd | None:
        done, _ = self._ray.wait([handle.reference], timeout=0)
        if not done:
            return None
        try:
            return AttemptEnd(self._ray.get(handle.reference))
        except self._ray.exceptions.TaskCancelledError:
            return None if _may_be_alive(handle.directory) else AttemptEnd(-signal.SIGTERM)
        except self._ray.exceptions.RayError as error:
            return AttemptEnd(None, f"Ray says: {str(error).strip().splitlines()[0]}")

    def ask_to_stop(self, handles: Sequence[Task]) -> None:
        for handle in handles:
            unwant(handle.directory)  # Ray's own request has no effect on a task that has just begun
            self._ray.cancel(handle.reference, force=False)  # raises KeyboardInterrupt in it, which also asks

    def kill(self, handles: Sequence[Task]) -> None:
        for handle in handles:
            self._ray.cancel(handle.reference, force=True)
        time.sleep(self.pause)

    def __exit__(self, *exc: object) -> None:
        self._ray.shutdown()


def _may_be_alive(directory: Path) -> bool:
    """Also true while the shared disk does not answer: the question is asked again soon."""
    try:
        return is_alive(directory)
    except OSError:
        return True


def run(attempt: Attempt) -> int:
    """The task."""
    return attempt.run()


def _options(settings: RaySettings) -> dict[str, Any]:
    named = {name: float(amount) for name, _, amount in (r.partition("=") for r in settings.resources)}
    if settings.tpus:
        named["TPU"] = settings.tpus
    memory = {} if settings.memory_gb is None else {"memory": int(settings.memory_gb * 2**30)}
    return {"num_cpus": settings.cpus, "num_gpus": settings.gpus, "resources": named, "max_retries": 0, **memory}


def _join(address: str) -> Any:
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    import ray

    before = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(address=address, log_to_driver=False, logging_level="warning")
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)  # Ray's would abort this process before trials are asked to save
    except (ConnectionError, TimeoutError, RuntimeError) as error:
        raise ConfigError(
            f"no Ray cluster at {address} ({error}); start one with `ray start --head`, or name its head with "
            "--launcher-set address=HOST:6379"
        ) from error
    return ray
