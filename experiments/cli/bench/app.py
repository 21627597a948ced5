"""`hma bench`: its commands by name."""

from __future__ import annotations

from experiments.cli.bench import models, others
from experiments.terminal.command_line import Commands

HELP = (
    "Measure speed on this machine. Most commands time the fast implementation and the naive one alternately in one "
    "process and print both. Results are written as JSON records with commit, hardware and versions."
)

bench_app = Commands()
bench_app.command(name="generate")(models.generate)
bench_app.command(name="rollout")(models.rollout)
bench_app.command(name="train")(models.train)
bench_app.command(name="products")(models.products)
bench_app.command(name="eval")(models.evaluate)
bench_app.command(name="quality")(others.quality)
bench_app.command(name="tokenize")(others.tokenize)
bench_app.command(name="simulate")(others.simulate)
bench_app.command(name="load")(others.load)
bench_app.command(name="release")(others.release)
bench_app.command(name="report")(others.report)
