"""The settings file of each name in a directory of films and hidden objects: one model and one detector."""

from __future__ import annotations

from pathlib import Path

from experiments.applications.settings_file import pin_settings, short_hash
from hma_jax.simulator.simulator import Simulator

BEHAVIOUR = "drawn for each robot"
"""How random numbers of the scripted policies are drawn: films that were begun in another way are not continued."""


def pin_name(out: Path, name: str, run: Path, simulator: Simulator, detector: Path) -> None:
    """Pins `name` in the directory `out` to the `simulator` of `run` and to the weights at `detector` (`pin_settings`).
    Raises ConfigError if it is pinned to others."""
    pin_settings(
        out,
        run,
        simulator,
        {"detector": short_hash(detector.read_bytes()), "behaviour": BEHAVIOUR},
        file=f"{name}.json",
    )
