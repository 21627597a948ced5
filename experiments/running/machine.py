"""Where a result was made: commit, versions, CPU, devices. For records, never for ids."""

from __future__ import annotations

import importlib.metadata
import platform
import subprocess
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from hma_jax.runtime.cores import usable_cores

PACKAGES = ("jax", "jaxlib", "flax", "optax", "orbax-checkpoint", "grain", "numpy")


def describe_machine(devices: Sequence[Any] = ()) -> dict[str, Any]:
    """Hardware and versions; `devices` are JAX devices, listed by kind."""
    kinds = sorted({d.device_kind for d in devices})
    return {
        "processor": _processor(),
        "cores": usable_cores(),
        "devices": [f"{sum(d.device_kind == k for d in devices)} x {k}" for k in kinds],
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in PACKAGES},
        "commit": git_commit(),
    }


@cache
def git_commit() -> str:
    """The commit of the sources, marked if the work tree differs from it; '' outside git. The value is from the
    process's first call, since its code was loaded then."""
    return commit_of(Path(__file__).resolve())


def commit_of(file: Path) -> str:
    """The commit of the repository that `file` is part of, marked if its work tree differs; '' if it is part of
    none."""

    def git(*arguments: str) -> str:
        done = subprocess.run(
            ["git", "-C", str(file.parent), *arguments], capture_output=True, text=True, timeout=30, check=True
        )
        return done.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", file.name)  # an installed file may lie inside some other repository
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "--short=12", "HEAD") + (" + uncommitted changes" if changed else "")
    except (OSError, subprocess.SubprocessError):
        return ""


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or "unknown"
