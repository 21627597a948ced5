"""What trained models are used for."""

from pathlib import Path

FIRST = Path("experiments/results/simulator")
"""The first model of this repository, used where no other run is named (docs/simulator.md)."""

DRIVEN = Path("experiments/results/simulator_grown")
"""The one that `hma play` serves, in which bodies and objects hold longest (docs/endurance.md)."""
