"""The settings file of each name in a directory of films and hidden objects: one model and one detector."""

from __future__ import annotations

from pathlib import Path

from experiments.applications.settings_file import pin_settings, short_hash
from hma_jax.simulator.simulator import Simulator

BEHAVIOUR = "drawn for each robot"
"""How the scripted policies' random numbers are: films that were begun otherwise are not gone on with."""


def pin_name(out: Path, name: str, run: Path, simulator: Simulator, detector: Path) -> None:
    """Pins `name` in the directory `out` to the `simulator` of `run` and to the weights at `detector` (`pin_settings`).
    Raises ConfigError where it is pinned to others."""
    pin_settings(
        out,
        run,
        simulator,
        {"detector": short_hash(detector.read_bytes()), "behaviour": BEHAVIOUR},
        file=f"{name}.json",
    )
