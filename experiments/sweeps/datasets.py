"""Does training on more robots help or hurt those already there?

Question: perplexity and delta PSNR on the first datasets as further ones join the mixture,
    the total number of training windows held fixed (so later points see less of each).
Paper figure: 6, left.
Command: python -m experiments.sweeps.datasets --preset cpu
Cost: one training run per point and seed; `--dry-run` prints it.
Expected outcome: no collapse. With a fixed budget the first datasets lose a little to
    dilution; the paper, which lets the data grow, sees a slight gain.
"""

from __future__ import annotations

from dataclasses import replace

from experiments.program import run_sweep
from experiments.study import Study
from experiments.sweeps.sweep import Sweep, make_sweep
from hma_jax.config import require


def plan(study: Study) -> Sweep:
    """Points are nested: each takes the first x datasets. All are judged on the smallest set."""
    names = study.dataset_names()
    require(
        study.dataset_counts[-1] == len(names),
        f"the last of dataset_counts {study.dataset_counts} must be the number of datasets, "
        f"{len(names)}; add --set dataset_counts=...,{len(names)}",
    )
    judged = names[: study.dataset_counts[0]]
    return make_sweep(
        study,
        name="datasets",
        axis="datasets in the mixture",
        scope=judged,
        values=study.dataset_counts,
        change=lambda trial, x: replace(trial, datasets=names[:x], evaluated=judged),
        reference_x=len(names),
        question="Does training on more robots help or hurt those already there? All points are judged "
        "on the smallest set of datasets and see the same number of windows in training.",
        gain="more robots",
    )


if __name__ == "__main__":
    run_sweep("datasets")
