"""What trained models are used for."""

from pathlib import Path

SHIPPED = Path("experiments/results/simulator")
"""The model of this repository that was judged, planned in and generated from; used where no other run is named."""

DRIVEN = Path("experiments/results/simulator_weighed")
"""The one that `hma play` serves, in which bodies and objects hold longer (docs/endurance.md)."""
