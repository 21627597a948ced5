"""Does the best learning rate stay where it is as the model widens?

Question: held-out loss over a grid of learning rates at several widths, with muP and without. How much is lost at each
    width by using the best rate of the base width?
Paper figure: none (paper section 3.5 uses muP; this tests it).
Command: python -m experiments.sweeps.lr --preset cpu
Cost: rates x widths x 2 training runs per seed, less those that both parametrisations share at the base width, each as
    small as the study's `transfer` says; `--dry-run` prints it.
Expected outcome: with muP the optima line up and the penalty stays within the grid's resolution;
    without it the optimum falls as width grows. An optimum that is at the grid's end, or cannot be distinguished from
    it, is marked "edge".
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.sweep import POINT, STANDARD, Point, Sweep, reference_trial
from experiments.terminal.program import run_sweep
from hma_jax.config import MupConfig, require


def parametrisations(study: Study) -> dict[str, MupConfig]:
    """muP and the standard parametrisation, made the same function at the base width.

    There all of muP's multipliers are 1 but attention's: attention_scale / I is the standard
    1 / sqrt(I) when attention_scale is sqrt(I). Away from it the standard one keeps learning rate,
    read-out and Xavier gain, and 1 / sqrt(I).
    """
    head_width = study.model.mup.base_width / study.model.heads
    mup = replace(study.model.mup, enabled=True, attention_scale=math.sqrt(head_width))
    return {POINT: mup, STANDARD: replace(mup, enabled=False)}


def plan(study: Study) -> Sweep:
    """Every rate at every width in both parametrisations; at the base width they share their trials."""
    grid, base, reference = study.transfer, study.model.mup.base_width, study.train.optimizer.learning_rate
    widths = grid.widths or study.widths
    require(
        len(widths) >= 3 and base in widths,
        f"transfer.widths: at least three, model.mup.base_width {base} among them, are needed; got {widths}",
    )
    names = study.dataset_names()[: grid.datasets]
    rates = [reference * grid.factor ** (grid.shift + k) for k in range(-(grid.rates // 2), grid.rates // 2 + 1)]
    mup = parametrisations(study)

    def trial(role: str, width: int, rate: float, seed: int) -> Trial:
        whole = reference_trial(study, seed)
        model = replace(whole.model, width=width, mup=mup[POINT if width == base else role])
        optimizer = replace(whole.train.optimizer, learning_rate=rate)
        train = replace(whole.train, steps=grid.steps or whole.train.steps, optimizer=optimizer)
        return replace(whole, datasets=names, evaluated=names, model=model, train=train, measure_untrained=False)

    points = tuple(
        Point(rate, trial(role, width, rate, seed), role, f"width {width}")
        for role, width, rate, seed in itertools.product(mup, widths, rates, study.seeds)
    )
    return Sweep(
        "lr",
        "learning rate",
        names,
        points,
        question="Does the best learning rate stay where it is as the model widens? Both parametrisations are "
        "the same function at the base width.",
        gain="muP",
        title="Transfer of the learning rate",
        base=f"width {base}",
    )


if __name__ == "__main__":
    run_sweep("lr")
