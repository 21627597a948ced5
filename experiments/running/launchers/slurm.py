"""Slurm, through submitit: an array of jobs, one for each trial.

Submitit writes and submits the batch script, runs the pickled attempt in the job, and puts it back into the queue
when Slurm announces that it will be pre-empted or that its time is over (SIGUSR2, `grace` seconds before). A job
that is cancelled, or pre-empted with only a SIGTERM, has saved as well; the runner submits it again. The state of jobs
comes from squeue, which every cluster has, with or without accounting.
"""

from __future__ import annotations

import logging
import math
import os
import pickle
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.running.attempts import AttemptEnd
from experiments.running.launchers.base import Command, Launcher, trial_command
from experiments.running.launchers.remote import Attempt
from hma_jax.config import ConfigError, require

log = logging.getLogger(__name__)

LARGEST_ARRAY = 1000
"""Jobs in an array; Slurm's own default for MaxArraySize is 1001."""

TIMEOUTS = 1000
"""How often a trial may use up a job's time; it continues from its checkpoint in the next job."""

COMPLETED = "COMPLETED"
ASKED_TO_STOP = {"CANCELLED", "PREEMPTED", "TIMEOUT"}
OVER = ASKED_TO_STOP | {COMPLETED, "BOOT_FAIL", "DEADLINE", "FAILED", "NODE_FAIL", "OUT_OF_MEMORY", "REVOKED"}
"""States of a job that will not run again."""

REQUEUE = 10.0
"""Seconds of a job's `grace` that submitit gets to put it back into the queue; the trial has the others to save."""

LEAST_TO_SAVE = 20.0
"""Seconds that a trial gets to save, however short `grace` is: before a pre-emption, which SIGUSR2 announces too, the
time is the partition's. If the job ends earlier, the runner submits the trial again."""

LINGER = 30.0
"""Seconds for a job's last output to reach this machine through a shared disk."""


@dataclass(frozen=True)
class SlurmSettings:
    """Settings of the job of each trial."""

    partition: str | None = None
    account: str | None = None
    qos: str | None = None
    constraint: str | None = None
    gpus: int | None = None  # on its node; None: as the partition gives them
    cpus: int | None = None
    memory_gb: float | None = None
    minutes: int = 1440  # time limit of one job; a trial that needs more continues in the next
    grace: int = 120  # seconds to save before the end of a job's time
    sbatch: tuple[str, ...] = ()  # further options, such as "gres=gpu:h100:1"

    def __post_init__(self):
        for name, least in (("gpus", 0), ("cpus", 1), ("minutes", 1), ("grace", 0)):
            value = getattr(self, name)
            require(value is None or value >= least, f"--launcher-set {name}={value}: it must be at least {least}")
        memory = 1.0 if self.memory_gb is None else self.memory_gb
        require(0 < memory < math.inf, f"--launcher-set memory_gb={memory:g}: it must be positive")
        require(
            self.grace < 60 * self.minutes,
            f"--launcher-set grace={self.grace}: must be shorter than the job's {self.minutes} minutes",
        )


class SlurmAttempt(Attempt):
    """What submitit pickles, calls in the job, and asks what to do after an announced end."""

    def __call__(self) -> int:
        return self.run()

    def checkpoint(self) -> Any:
        from submitit.helpers import DelayedSubmission

        self.end()
        return DelayedSubmission(self)


class SlurmLauncher(Launcher):
    """`workers`: how many jobs are submitted at a time; None: all.

    Raises ConfigError if Slurm is missing.
    """

    Settings = SlurmSettings
    needs = "submitit"
    pause = 2.0

    def __init__(
        self,
        root: Path,
        workers: int | None,
        settings: SlurmSettings = SlurmSettings(),
        command: Command = trial_command,
        executor: Any = None,
    ):
        self.at_once = self.limit(workers, settings) or Launcher.at_once
        self._root, self._command = root, command
        by_option = any(option.startswith(("gres=gpu", "gpus")) for option in settings.sbatch)
        self._accelerator = "gpu" if settings.gpus or by_option else ""
        self._grace = max(settings.grace - REQUEUE, LEAST_TO_SAVE)
        self._executor = executor or _make_executor(root / "slurm", settings)
        self._left_out = [o.removeprefix("exclude=") for o in settings.sbatch if o.startswith("exclude=")]  # nodes
        self._polled = -math.inf
        self._states: dict[str, str] | None = None  # states of all jobs; None: not known since the last were submitted
        self._over: dict[str, float] = {}  # when a job was first seen to be over

    @classmethod
    def share(cls, workers: int | None, settings: SlurmSettings) -> float | None:
        return settings.gpus or None

    def launch(self, directories: Sequence[Path]) -> list[Any]:
        from submitit.core.utils import FailedJobError

        attempts = [
            SlurmAttempt(d, self._root / "compiled", self._command, self._accelerator, self._grace) for d in directories
        ]
        jobs: list[Any] = []
        try:
            for first in range(0, len(attempts), LARGEST_ARRAY):
                with _no_job():
                    jobs += self._executor.submit_array(attempts[first : first + LARGEST_ARRAY])
        except FailedJobError as error:
            raise ConfigError(
                f"Slurm does not take the jobs: {error}; change --launcher-set or, where it allows fewer jobs than these "
                f"{len(attempts)}, submit fewer at a time with --workers N"
            ) from error
        finally:
            if len(jobs) < len(attempts):  # the caller has no handles of the ones that Slurm took
                self.ask_to_stop(jobs)
        self._polled, self._states = -math.inf, None
        return jobs

    def ended(self, handle: Any) -> AttemptEnd | None:
        result = self._result(handle)
        if result is not None:
            if result.code != 0:  # Slurm might requeue it, beside the one that the runner submits
                self.ask_to_stop([handle])
            return result
        state = self._state(handle.job_id)
        if state not in OVER:
            return None
        why = f"Slurm says {state} of job {handle.job_id}"
        if state in ASKED_TO_STOP:
            return AttemptEnd(-signal.SIGTERM, why)
        seen = self._over.setdefault(handle.job_id, time.monotonic())
        if state == COMPLETED and time.monotonic() - seen < LINGER:
            return None
        return AttemptEnd(None, f"{why}; its log is {handle.paths.stdout}")

    def _result(self, job: Any) -> AttemptEnd | None:
        """What the job's process left when it ended by itself."""
        try:
            kind, value = pickle.loads(job.paths.result_pickle.read_bytes())
        except OSError:  # missing, or a shared disk that does not answer for a while
            return None
        if kind == "success":
            return AttemptEnd(value)
        return AttemptEnd(None, f"job {job.job_id} ended with {str(value).strip().splitlines()[-1]}")

    def _state(self, id: str) -> str:
        """The state of one job. All jobs are queried at once, and no more often than is good for the cluster."""
        if time.monotonic() - self._polled >= self.pause:
            self._polled = time.monotonic()
            answer = ask_states()
            self._states = self._states if answer is None else answer
        if self._states is None:
            return "UNKNOWN"
        return self._states.get(id, COMPLETED)  # squeue forgets jobs that ended a while ago

    def place(self, handle: Any, start: Mapping[str, Any] | None) -> str | None:
        return start and start.get("node")

    def leave_out(self, handle: Any, place: str) -> bool:
        """Jobs that are in the queue already may still get there."""
        if place in self._left_out:
            return False
        self._left_out.append(place)
        self._executor.update_parameters(exclude=",".join(self._left_out))
        return True

    def ask_to_stop(self, handles: Sequence[Any]) -> None:
        """Slurm sends SIGTERM, and SIGKILL after its KillWait; jobs in the queue leave it."""
        if handles:
            subprocess.run(["scancel", *(h.job_id for h in handles)], check=False)

    def kill(self, handles: Sequence[Any]) -> None:
        """Does nothing: Slurm has killed them by now."""


@contextmanager
def _no_job() -> Iterator[None]:
    """Hides the environment of the job that this process may be in, which the jobs it submits would take for their own.
    Variables by which Slurm is found, and the user's own options of sbatch, stay."""
    from submitit.helpers import clean_env

    kept = {key: value for key, value in os.environ.items() if key == "SLURM_CONF" or key.startswith("SBATCH_")}
    with clean_env():
        os.environ.update(kept)
        yield


def ask_states() -> dict[str, str] | None:
    """The state of each of this user's jobs, {id: state}; None if Slurm does not answer now."""
    command = ["squeue", "--me", "--array", "--noheader", "--states=all", "--format=%i %T"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    except (OSError, subprocess.SubprocessError) as error:
        log.warning("squeue does not answer (%s); asking again", error)
        return None
    return dict(line.split() for line in done.stdout.splitlines())


def _make_executor(folder: Path, settings: SlurmSettings) -> Any:
    from submitit import SlurmExecutor

    try:
        executor = SlurmExecutor(folder, max_num_timeout=TIMEOUTS)
    except RuntimeError:
        raise ConfigError(
            "Slurm is not available: srun is not on the PATH; run this command where jobs are submitted"
        ) from None
    options = {
        "partition": settings.partition,
        "account": settings.account,
        "qos": settings.qos,
        "constraint": settings.constraint,
        "gpus_per_node": settings.gpus,
        "cpus_per_task": settings.cpus,
        "mem": None if settings.memory_gb is None else f"{round(settings.memory_gb * 1024)}M",
    }
    further = {name: value if equals else True for name, equals, value in (o.partition("=") for o in settings.sbatch)}
    options["exclude"] = further.pop("exclude", None)  # further ones would hide what `leave_out` adds
    executor.update_parameters(
        job_name="hma",
        time=settings.minutes,
        signal_delay_s=settings.grace,
        array_parallelism=LARGEST_ARRAY,  # the runner submits no more than `at_once`
        stderr_to_stdout=True,
        additional_parameters={"requeue": True, **further},
        **{name: value for name, value in options.items() if value is not None},
    )
    return executor
