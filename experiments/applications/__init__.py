"""What trained models are used for."""

from pathlib import Path

SHIPPED = Path("experiments/results/simulator")
"""Where the trained model of this repository lies; used where no other run is named."""
