"""What does more data per robot buy?

Question: perplexity and delta PSNR as each dataset is cut to its first x trajectories, with
    the same number of optimiser steps. Subsets are nested: 10 lie inside 100.
Paper figure: 6, middle.
Command: python -m experiments.sweeps.trajectories --preset cpu
Cost: one training run per point and seed; `--dry-run` prints it.
Expected outcome: perplexity falls with trajectories and flattens where only the largest
    datasets still have more to give.
"""

from __future__ import annotations

from dataclasses import replace

from experiments.study import Study
from experiments.sweeps.sweep import Sweep, make_sweep
from experiments.terminal.program import run_sweep


def plan(study: Study) -> Sweep:
    """All datasets at every point, judged on all of them."""
    return make_sweep(
        study,
        name="trajectories",
        axis="trajectories per dataset (at most)",
        scope=study.dataset_names(),
        values=study.trajectory_counts,
        change=lambda trial, x: replace(trial, max_trajectories=x),
        reference_x=study.trajectory_counts[-1],
        question="What does more data per robot buy? Subsets are nested; the number of optimiser "
        "steps is the same everywhere.",
        gain="more data",
    )


if __name__ == "__main__":
    run_sweep("trajectories")
