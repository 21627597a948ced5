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

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.draws import draw_judged, draw_mixture
from experiments.sweeps.sweep import Sweep, make_sweep
from experiments.terminal.program import run_sweep
from hma_jax.config import require


def plan(study: Study) -> Sweep:
    """Points are nested: each takes the first x datasets, or adds random ones. All are judged on the smallest set."""
    names = study.dataset_names()
    require(
        study.dataset_counts[-1] == len(names),
        f"the last of dataset_counts {study.dataset_counts} must be the number of datasets, {len(names)}; add --set "
        f"dataset_counts=...,{len(names)}",
    )
    fewest = study.dataset_counts[0]
    first = names[:fewest]

    def change(trial: Trial, x: int) -> Trial:
        if study.judged == "first":
            return replace(trial, datasets=names[:x], evaluated=first)
        seed = trial.train.seed
        return replace(trial, datasets=draw_mixture(study, seed, x, judged=fewest), evaluated=judged(seed))

    def judged(seed: int) -> tuple[str, ...]:
        return first if study.judged == "first" else draw_judged(study, seed, fewest)

    drawn = f"{fewest} datasets that are drawn for each seed,"
    on = "the smallest set of datasets" if study.judged == "first" else drawn
    sweep = make_sweep(
        study,
        name="datasets",
        axis="datasets in the mixture",
        scope=judged(study.seeds[0]),
        values=study.dataset_counts,
        change=change,
        reference_x=len(names),
        question=f"Does training on more robots help or hurt those already there? All points are judged on {on} "
        "and see the same number of windows in training.",
        gain="more robots",
    )
    if study.judged == "first":
        return sweep
    points = tuple(replace(point, scope=judged(point.trial.train.seed)) for point in sweep.points)
    return replace(sweep, points=points)


if __name__ == "__main__":
    run_sweep("datasets")
