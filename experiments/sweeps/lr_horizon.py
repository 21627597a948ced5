"""Does the best learning rate stay where it is as training gets longer?

Question: held-out loss over learning rates at the fewest of `designs.budgets` and at the study's own steps. muP
    carries a rate over width; nothing carries it over the horizon.
Paper figure: none.
Command: python -m experiments.sweeps.lr_horizon --preset cpu-full
Cost: one run per further rate and seed, with a branch at the fewest steps; `--dry-run` prints it.
Expected outcome: the best rate falls as training gets longer, by less than the grid's step; if by more, the page says
    so.
"""

from __future__ import annotations

from dataclasses import replace

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.sweep import Point, Sweep, reference_trial
from experiments.terminal.program import run_sweep
from experiments.terminal.words import counted
from hma_jax.config import require


def plan(study: Study) -> Sweep:
    """The reference trial at several rates, among them the study's own. Raises ConfigError without rates or budgets."""
    rate, longest = study.train.optimizer.learning_rate, study.train.steps
    for name in ("budgets", "rate_factors"):
        require(
            bool(getattr(study.designs, name)),
            f"designs.{name} is empty; the axis lr_horizon tries designs.rate_factors at the first of designs.budgets: "
            f"--set designs.{name}=...",
        )
    horizons = dict.fromkeys((study.designs.budgets[0], longest))  # one, where they are the same

    def trial(factor: float, steps: int, seed: int) -> Trial:
        whole = reference_trial(study, seed, steps)
        optimizer = replace(whole.train.optimizer, learning_rate=rate * factor)
        untrained = whole.measure_untrained and factor == 1
        return replace(whole, train=replace(whole.train, optimizer=optimizer), measure_untrained=untrained)

    return Sweep(
        "lr_horizon",
        "learning rate",
        study.dataset_names(),
        tuple(
            Point(rate * factor, trial(factor, steps, seed), series=counted(steps, "step"))
            for steps in horizons
            for factor in study.designs.rate_factors
            for seed in study.seeds
        ),
        question="Does the best learning rate stay where it is as training gets longer? muP transfers a rate over widths, "
        "not over horizons.",
        gain="its learning rate",
        title="Learning rate and horizon",
        base=counted(longest, "step"),
    )


if __name__ == "__main__":
    run_sweep("lr_horizon")
