"""How wide should a model be for a given amount of compute?

Question: loss at equal training FLOPs for several budgets: wide models see fewer windows, narrow ones more. The
    widths are those of the width axis, and every budget is a decay branch of the same run.
Paper figure: none; the paper fixes the steps.
Command: python -m experiments.sweeps.compute --preset cpu-full
Cost: per width and seed one run of the largest budget and a branch for each smaller one; `--dry-run` prints it.
Expected outcome: at each budget one width is best, and at a larger budget a wider one. A best width at the end of the
    range tried is marked: the true best may lie beyond.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.sweep import Point, Sweep, reference_trial
from experiments.terminal.program import run_sweep
from hma_jax.config import require


def plan(study: Study) -> Sweep:
    """Every width trains for as many steps as spend the FLOPs of the reference, for each number of steps in
    `designs.compute`. Raises ConfigError if none of these is enough."""
    from hma_jax.training.optimizer import decay_fits

    widths = sorted({*study.widths, study.model.width})
    flops = {width: flops_per_step(of_width(reference_trial(study, study.seeds[0]), width)) for width in widths}
    budgets = {steps: steps * flops[study.model.width] for steps in study.designs.compute}
    largest = max(flops.values())

    def compares(fewest: int) -> bool:
        """A run that only warms up, or whose learning rate does not decay, is of no use for a comparison."""
        return fewest > study.train.optimizer.warmup_steps and decay_fits(study.train.optimizer, fewest)

    names = name_budgets([b for b in budgets.values() if compares(round(b / largest))])

    def point(width: int, budget: float, seed: int) -> Point:
        steps = max(round(budget / flops[width]), 1)
        trial = reference_trial(study, seed, steps)
        if width != study.model.width:
            trial = replace(of_width(trial, width), measure_untrained=False)
        return Point(width, trial, series=names[budget])

    points = [point(width, budget, seed) for budget in names for width in widths for seed in study.seeds]
    require(
        bool(points),
        f"designs.compute {study.designs.compute}: at none of these steps' FLOPs the widest model, of {widths[-1]}, trains "
        f"beyond train.optimizer.warmup_steps, {study.train.optimizer.warmup_steps}, and a decay of wsd; "
        "--set designs.compute=...",
    )
    return Sweep(
        "compute",
        "width of the trunk",
        study.dataset_names(),
        tuple(points),
        question="How wide should a model be for a given amount of compute? Along a curve every model spends the same "
        "training FLOPs: wide ones see fewer windows. All have one learning rate, however few their steps: where another "
        "rate is better for so few, the loss is an upper bound.",
        gain="compute",
        title="Equal compute",
        interior_minimum=True,
    )


def name_budgets(budgets: Sequence[float]) -> dict[float, str]:
    """The names of distinct budgets in FLOPs, with two digits or as many as tell them apart."""
    named = ({budget: f"{budget:.{digits}g} FLOP" for budget in budgets} for digits in count(2))
    return next(names for names in named if len({*names.values()}) == len(names))


def of_width(trial: Trial, width: int) -> Trial:
    return replace(trial, model=replace(trial.model, width=width))


def flops_per_step(trial: Trial) -> float:
    """Training FLOPs of one step, by formula, with action sizes from the registry."""
    from experiments.declared_table import declared_table
    from hma_jax.model.flops import train_flops_per_step

    return train_flops_per_step(trial.model, declared_table(trial.datasets, trial.rate), trial.train)


if __name__ == "__main__":
    run_sweep("compute")
