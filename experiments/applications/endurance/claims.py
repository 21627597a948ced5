"""What films and events of hidden objects in one directory were watched with: one model and one detector for a name."""

from __future__ import annotations

from pathlib import Path

from experiments.applications.made_with import claim, short_hash
from hma_jax.simulator.simulator import Simulator


def claim_name(out: Path, name: str, run: Path, simulator: Simulator, detector: Path) -> None:
    """Makes `out` the directory of what the `simulator` of `run` shows under `name`, as the weights at `detector` see
    it. Raises ConfigError where the name is of something else."""
    claim(out, run, simulator, {"detector": short_hash(detector.read_bytes())}, file=f"{name}.json")
