"""Starts a test program as several processes of one, as `hma train --coordinator ...` is started on several hosts."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]


@dataclass
class Started:
    """One process; its output goes to a file, so that none waits for a reader."""

    process: subprocess.Popen
    output: Path

    def wait(self, timeout: float = 600) -> tuple[int, str]:
        """(exit code, everything it said)."""
        try:
            code = self.process.wait(timeout)
        finally:
            if self.process.poll() is None:
                self.process.kill()
        return code, self.output.read_text()


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def by_address(processes: int) -> list[dict[str, str]]:
    """The environment of each."""
    port = free_port()
    where = {"HMA_COORDINATOR": f"127.0.0.1:{port}", "HMA_PROCESSES": str(processes)}
    return [where | {"HMA_PROCESS": str(p)} for p in range(processes)]


def by_slurm(processes: int) -> list[dict[str, str]]:
    """What srun says to each of its tasks on one node, with a GPU for each."""
    step = {
        "SLURM_JOB_ID": "7", "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": str(processes),
        "SLURM_STEP_NUM_NODES": "1", "SLURM_STEP_TASKS_PER_NODE": str(processes), "SLURM_NODEID": "0",
        "CUDA_VISIBLE_DEVICES": "0", "JAX_COORDINATOR_PORT": str(free_port()),
    }  # fmt: skip
    return [step | {"SLURM_PROCID": str(p), "SLURM_LOCALID": str(p)} for p in range(processes)]


def launch(
    module: str,
    arguments: Sequence[str],
    *,
    processes: int,
    devices: int = 1,
    flags: str | None = None,
    said: Callable[[int], list[dict[str, str]]] = by_address,
) -> list[Started]:
    """`python -m module ARGUMENTS` as so many processes with so many CPU devices each; more of XLA_FLAGS in `flags`."""
    given = os.environ.get("XLA_FLAGS", "") if flags is None else flags
    environment = os.environ | {"XLA_FLAGS": f"{given} --xla_force_host_platform_device_count={devices}"}
    outputs = Path(tempfile.mkdtemp(prefix="hma-processes-"))
    started = []
    for p, own in enumerate(said(processes) if processes > 1 else [{}]):
        output = outputs / f"{p}.txt"
        with open(output, "w") as file:
            process = subprocess.Popen(
                [sys.executable, "-u", "-m", module, *arguments],
                env=environment | own,
                cwd=ROOT,
                stdout=file,
                stderr=subprocess.STDOUT,
            )
        started.append(Started(process, output))
    return started


def run(module: str, arguments: Sequence[str], **how: Any) -> list[str]:
    """What each of the processes said; all must end well."""
    ended = [one.wait() for one in launch(module, arguments, **how)]
    for p, (code, said) in enumerate(ended):
        assert code == 0, f"process {p} ended with {code}: {said[-3000:]}"
    return [said for _, said in ended]
