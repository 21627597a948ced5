"""This machine cut into slots, one for each trial that runs at a time: its cores and its accelerators.

Accelerators are found without JAX, which would reserve them for the calling process. A slot owns its accelerators; if
there are more slots than GPUs, several share one, each with its part of the memory. TPU chips belong to one process
each.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path
from typing import Literal

from hma_jax.config import require

MEMORY = 0.9
"""Share of a GPU's memory for all trials on it; the rest is for the driver and libraries."""

CHIP_BOUNDS = {1: "1,1,1", 2: "1,2,1", 4: "2,2,1", 8: "2,4,1"}
"""Layout of this many TPU chips on one host, in libtpu's notation."""


GOOGLE, TPU_DEVICES = "0x1ae0", ("0x0027", "0x0056", "0x005e", "0x0062", "0x0063", "0x006f", "0x0076")
"""PCI ids of TPU chips, v2 to 7x, as JAX knows them."""


@dataclass(frozen=True)
class Accelerators:
    """The accelerators that this process may use, by their names in environment variables."""

    kind: Literal["gpu", "tpu"]
    names: tuple[str, ...]


@dataclass(frozen=True)
class Slot:
    """A share of the machine. No accelerators: JAX takes those it finds."""

    cores: tuple[int, ...] = ()  # (): all
    accelerators: Accelerators | None = None
    sharers: int = 1  # number of slots on the same accelerators, including this one

    def environment(self) -> dict[str, str]:
        """Environment variables that limit a child to its accelerators."""
        variables: dict[str, str] = {}
        if self.sharers > 1:
            variables["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{MEMORY / self.sharers:.3f}"
        if self.accelerators is None:
            return variables
        names = ",".join(self.accelerators.names)
        if self.accelerators.kind == "gpu":
            return variables | {"CUDA_VISIBLE_DEVICES": names}
        return variables | {
            "TPU_VISIBLE_CHIPS": names,
            "TPU_CHIPS_PER_PROCESS_BOUNDS": CHIP_BOUNDS[len(self.accelerators.names)],
            "TPU_PROCESS_BOUNDS": "1,1,1",
        }


def find_accelerators(environment: Mapping[str, str] = os.environ) -> Accelerators | None:
    """GPUs or TPU chips that `environment` lets this process use: those that it names, or else all that exist here and
    that JAX is installed for. None if there are none, or if JAX_PLATFORMS excludes them."""
    platforms = environment.get("JAX_PLATFORMS", "")
    if platforms and not set(platforms.split(",")) & {"cuda", "gpu", "tpu"}:
        return None
    for kind, variable, find in (("gpu", "CUDA_VISIBLE_DEVICES", _gpus), ("tpu", "TPU_VISIBLE_CHIPS", _tpu_chips)):
        visible = environment.get(variable)
        names = find() if visible is None else _named(visible)
        if names and (visible is not None or _jax_uses(kind)):
            return Accelerators(kind, names)
    return None


def _jax_uses(kind: str) -> bool:
    """Whether the plugin that JAX needs for them is installed: without it, JAX computes on the CPU, whatever hardware
    is here."""
    if kind == "tpu":
        return find_spec("libtpu") is not None or "TPU_LIBRARY_PATH" in os.environ
    return any("cuda" in plugin.value for plugin in entry_points(group="jax_plugins"))


def _named(visible: str) -> tuple[str, ...]:
    """The names in a list as CUDA reads it: the first one that is not a device ends the list, such as -1, or
    NoDevFiles, which Slurm sets for a job without devices."""
    names = (name.strip() for name in visible.split(",") if name.strip())
    return tuple(takewhile(lambda name: name != "NoDevFiles" and not name.startswith("-"), names))


@cache
def _gpus(devices: Path = Path("/dev")) -> tuple[str, ...]:
    command = ["nvidia-smi", "--query-gpu=index", "--format=csv,noheader"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
        return tuple(done.stdout.split())
    except (OSError, subprocess.SubprocessError):
        # A container may have only the devices, numbered anew. Or the driver does not work, for instance after an
        # update without a reboot: then trials should report that JAX does not find the devices.
        found = [device for device in devices.glob("nvidia*") if device.name.removeprefix("nvidia").isdigit()]
        return tuple(map(str, range(len(found))))


@cache
def _tpu_chips(pci: Path = Path("/sys/bus/pci/devices")) -> tuple[str, ...]:
    chips = [d for d in pci.glob("*") if _id(d / "vendor") == GOOGLE and _id(d / "device") in TPU_DEVICES]
    return tuple(map(str, range(len(chips))))


def _id(file: Path) -> str:
    try:
        return file.read_text().strip()
    except OSError:
        return ""


def core_place(core: int, cores: Path = Path("/sys/devices/system/cpu")) -> tuple[int, int, int]:
    """Socket, core and number: sorted by it, neighbours share caches and memory."""
    topology = cores / f"cpu{core}" / "topology"
    return int(_id(topology / "physical_package_id") or 0), int(_id(topology / "core_id") or 0), core


def cut(slots: int, accelerators: Accelerators | None, cores: Sequence[int]) -> list[Slot]:
    """The machine cut into `slots`. Raises ConfigError if it cannot be cut that way.

    Neighbouring accelerators, and neighbouring `cores`, stay together, since they are best connected; accelerators that
    do not divide evenly stay idle.
    """
    ends = [i * len(cores) // slots for i in range(slots + 1)]
    shares = [
        tuple(cores[ends[i] : ends[i + 1]]) or (cores[i % len(cores)],) if cores and slots > 1 else ()
        for i in range(slots)
    ]
    if accelerators is None or slots == 1:
        return [Slot(share, None, slots if accelerators is None else 1) for share in shares]
    names, kind = accelerators.names, accelerators.kind
    if slots > len(names):
        require(
            kind == "gpu",
            f"--workers {slots}: a TPU chip belongs to one process, and there are {len(names)}; at most --workers "
            f"{len(names)}",
        )
        sharers = [sum(j % len(names) == i for j in range(slots)) for i in range(len(names))]
        return [
            Slot(share, Accelerators(kind, (names[i % len(names)],)), sharers[i % len(names)])
            for i, share in enumerate(shares)
        ]
    each = len(names) // slots
    if kind == "tpu":
        each = max(n for n in CHIP_BOUNDS if n <= each)
    return [Slot(share, Accelerators(kind, names[i * each : (i + 1) * each])) for i, share in enumerate(shares)]
