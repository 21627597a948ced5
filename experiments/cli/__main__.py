"""`python -m experiments.cli` is `hma`."""

from experiments.cli.start import start

start()
