"""Which part of a job is this process's: given, or told by what started the process.

Owns that rule. The processes of a job need not run at the same time, nor know of each other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from data_pipelines.sampling.order import stream_seed
from hma_jax.config import ConfigError, require

if TYPE_CHECKING:
    from data_pipelines.tokens.part import Part

ADVICE = "Say it yourself: --process I --processes N; --processes 1 for all of it."


@dataclass(frozen=True)
class Share:
    """Process `process` of `processes` that work on the same store."""

    process: int = 0
    processes: int = 1
    told_by: str = ""  # environment variables, if it was not given

    def __post_init__(self):
        require(self.processes >= 1, f"processes must be at least 1, got {self.processes}")
        require(
            0 <= self.process < self.processes,
            f"process must lie in [0, {self.processes}), got {self.process}",
        )

    def of(self, parts: Sequence[Part], name: str) -> list[Part]:
        """The parts of dataset `name` that are this process's.

        Datasets start at different processes: many of one part each are spread too.
        """
        first = stream_seed("share", name)
        return [part for part in parts if (first + part.number) % self.processes == self.process]


def find_share(process: int | None, processes: int | None, environ: Mapping[str, str]) -> Share:
    """As given, otherwise from SLURM (array jobs, tasks of srun, or both) or Open MPI.

    These are the variables that jax.distributed reads; the processes of this job need not be
    connected, so it is not asked itself.

    Raises ConfigError for half an answer, and for an array that is not all of 0, 1, ... N: tasks
    3 and 5 started again do not tell how many there were.
    """
    if processes == 1 and process is None:
        return Share()
    if process is not None or processes is not None:
        require(
            process is not None and processes is not None,
            "--process and --processes are given together: --process 0 --processes 4 is the first of four",
        )
        return Share(process, processes)
    array, told_by = _array(environ), []
    tasks = _pair(environ, "SLURM_PROCID", "SLURM_STEP_NUM_TASKS")
    tasks = tasks or _pair(environ, "OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE")
    process, processes = 0, 1
    for name, pair in (("SLURM_ARRAY_TASK_ID", array), (tasks[2] if tasks else "", tasks)):
        if pair and pair[1] > 1:
            process, processes = process * pair[1] + pair[0], processes * pair[1]
            told_by.append(name)
    return Share(process, processes, " and ".join(told_by))


def _pair(environ: Mapping[str, str], index: str, count: str) -> tuple[int, int, str] | None:
    """(index, count, name of the first): SLURM_STEP_NUM_TASKS is set inside srun alone, where
    SLURM_NTASKS is set in a batch script too, which runs once."""
    if index not in environ or count not in environ:
        return None
    return _number(environ, index), _number(environ, count), index


def _array(environ: Mapping[str, str]) -> tuple[int, int, str] | None:
    name = "SLURM_ARRAY_TASK_ID"
    pair = _pair(environ, name, "SLURM_ARRAY_TASK_COUNT")
    if pair is None:
        return None
    values = {k: _number(environ, f"SLURM_ARRAY_TASK_{k}") for k in ("ID", "COUNT", "MIN", "MAX")}
    first, last, count = values["MIN"], values["MAX"], values["COUNT"]
    require(
        first == 0 and last == count - 1,
        f"a SLURM array of {count} tasks from {first} to {last} does not tell which share of the work "
        f"task {values['ID']} has: only --array=0-N does. {ADVICE}",
    )
    return values["ID"], count, name


def _number(environ: Mapping[str, str], name: str) -> int:
    try:
        return int(environ[name])
    except (KeyError, ValueError):
        raise ConfigError(f"{name} is {environ.get(name)!r}, not a number. {ADVICE}") from None
