"""Starts a test program as several processes of one, as `hma train --coordinator ...` is started on several hosts."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]


@dataclass
class Started:
    """One process; its output goes to a file, so that none waits for a reader."""

    process: subprocess.Popen
    output: Path

    def wait(self, timeout: float = 240) -> tuple[int, str]:
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


def launch(
    module: str, arguments: Sequence[str], *, processes: int, devices: int = 1, flags: str | None = None
) -> list[Started]:
    """`python -m module ARGUMENTS` as so many processes with so many CPU devices each; more of XLA_FLAGS in `flags`."""
    given = os.environ.get("XLA_FLAGS", "") if flags is None else flags
    environment = os.environ | {"XLA_FLAGS": f"{given} --xla_force_host_platform_device_count={devices}"}
    if processes > 1:
        environment |= {"HMA_COORDINATOR": f"127.0.0.1:{free_port()}", "HMA_PROCESSES": str(processes)}
    outputs = Path(tempfile.mkdtemp(prefix="hma-processes-"))
    started = []
    for p in range(processes):
        output = outputs / f"{p}.txt"
        with open(output, "w") as file:
            process = subprocess.Popen(
                [sys.executable, "-u", "-m", module, *arguments],
                env=environment | ({"HMA_PROCESS": str(p)} if processes > 1 else {}),
                cwd=ROOT,
                stdout=file,
                stderr=subprocess.STDOUT,
            )
        started.append(Started(process, output))
    return started


def run(module: str, arguments: Sequence[str], **how: int | str) -> list[str]:
    """What each of the processes said; all must end well."""
    ended = [one.wait() for one in launch(module, arguments, **how)]
    for p, (code, said) in enumerate(ended):
        assert code == 0, f"process {p} ended with {code}: {said[-3000:]}"
    return [said for _, said in ended]
