"""What do robots lose when others share their training, at a fixed amount of work?

Question: perplexity and delta PSNR on five robots, drawn anew for every seed, as others join the mixture, at a fixed
    total number of windows: later points see less of the judged robots.
Paper figure: 6, left, under the design that measures dilution.
Command: python -m experiments.sweeps.dilution --preset cpu-full
Cost: one training run per number of robots and seed, shared with `transfer`; `--dry-run` prints it.
Expected outcome: the judged robots lose by as much as their share of the windows shrinks, less what transfers.
"""

from __future__ import annotations

from experiments.study import Study
from experiments.sweeps.robots import plan_robots
from experiments.sweeps.sweep import Sweep
from experiments.terminal.program import run_sweep


def plan(study: Study) -> Sweep:
    """Every point trains for the study's steps; all robots are the reference trial."""
    steps = study.train.steps
    return plan_robots(
        study,
        name="dilution",
        axis="robots in the mixture, total windows fixed",
        steps=dict.fromkeys(study.designs.counts, steps),
        question="What do robots lose when others share their training? "
        f"{study.designs.judged} robots are judged, drawn anew for every seed. Every point sees the same number of windows "
        "in all, so the judged robots see fewer as others join.",
        gain="sharing a budget",
    )


if __name__ == "__main__":
    run_sweep("dilution")
