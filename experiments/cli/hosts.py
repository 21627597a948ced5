"""Options of commands that several processes, on one host or on many, run together."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, arg

from experiments.study_setup import UNSET
from experiments.terminal.progress import console

if TYPE_CHECKING:
    from hma_jax.runtime.processes import Processes


@dataclass(frozen=True)
class Hosts:
    """Run several processes as one program (docs/hosts.md): start the same command once for each process."""

    coordinator: Annotated[str | None, arg(metavar="HOST:PORT"), UNSET] = None
    """Address at which the other processes reach process 0. Or set HMA_COORDINATOR."""
    processes: Annotated[int | None, arg(metavar="N"), UNSET] = None
    """Number of processes. Or set HMA_PROCESSES."""
    process: Annotated[int | None, arg(metavar="I"), UNSET] = None
    """Number of this process, from 0. Or set HMA_PROCESS."""
    distributed: Annotated[FlagCreatePairsOff[bool], UNSET] = False
    """Detect the values that are not given, from Slurm (srun), Kubernetes, a TPU pod or MPI."""
    start_timeout: Annotated[float, arg(name="start-timeout", metavar="SECONDS")] = 300.0
    """How long to wait until all processes have started."""
    lost_after: Annotated[float, arg(name="lost-after", metavar="SECONDS")] = 90.0
    """If a process gives no sign of life for this long, the others end with exit code 75."""

    def _settings(self, detect: bool) -> Processes:
        from hma_jax.runtime.processes import Processes

        return Processes(
            self.coordinator, self.processes, self.process, detect, self.start_timeout, self.lost_after
        ).or_from(os.environ)

    def count(self) -> int:
        """How many processes are asked for, whether or not the arguments say how they connect; 1 also if --distributed
        has still to detect it."""
        return self._settings(detect=True).processes or 1

    def join(self) -> None:
        """Connects to the other processes, if there are any; from then on only process 0 writes to the screen."""
        from hma_jax.runtime.processes import start

        settings = self._settings(self.distributed)
        if not settings.several:
            return
        start(settings)
        from hma_jax.runtime.processes import is_writer

        console.quiet = not is_writer()
