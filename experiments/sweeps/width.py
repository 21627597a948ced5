"""What does a wider model buy, with hyper-parameters carried over by muP?

Question: perplexity and delta PSNR as the trunk's width grows, everything else fixed; the
    learning rate is set once, at the muP base width.
Paper figure: 6, right.
Command: python -m experiments.sweeps.width --preset cpu
Cost: one training run per point and seed, growing with the square of the width; `--dry-run`
    prints it.
Expected outcome: perplexity falls with width, delta PSNR rises.
"""

from __future__ import annotations

from dataclasses import replace

from experiments.study import Study
from experiments.sweeps.sweep import Sweep, make_sweep
from experiments.terminal.program import run_sweep


def plan(study: Study) -> Sweep:
    """All datasets and trajectories at every point, judged on all datasets.

    The reference trial's own width is a point, whether or not `widths` names it: other axes run it anyway.
    """
    return make_sweep(
        study,
        name="width",
        axis="model width",
        scope=study.dataset_names(),
        values=sorted({*study.widths, study.model.width}),
        change=lambda trial, x: replace(trial, model=replace(trial.model, width=x)),
        reference_x=study.model.width,
        question="What does a wider model buy? The learning rate is set once, at the base width, and "
        "carried over by muP.",
        gain="more width",
    )


if __name__ == "__main__":
    run_sweep("width")
