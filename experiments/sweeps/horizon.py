"""What does training for longer buy?

Question: perplexity and delta PSNR of the reference model after more and more steps: decay branches of one run per
    seed, and far longer runs for the first seed only.
Paper figure: none.
Command: python -m experiments.sweeps.horizon --preset cpu-full
Cost: one run per seed, and its decay branches; `--dry-run` prints it.
Expected outcome: perplexity falls, and rises again on robots with few trajectories; delta PSNR rises.
"""

from __future__ import annotations

from experiments.study import Study
from experiments.sweeps.sweep import CONTROL, Point, Sweep, control_of, reference_trial
from experiments.terminal.program import run_sweep


def plan(study: Study) -> Sweep:
    """The study's number of steps is the reference; larger numbers are run with one seed, which the question states."""
    first, steps = study.seeds[0], study.train.steps
    budgets = sorted({*study.designs.budgets, steps})

    def point(n: int, seed: int) -> Point:
        return Point(n, reference_trial(study, seed, n))

    points = [point(n, seed) for n in budgets for seed in study.seeds]
    points += [point(n, first) for n in study.designs.long if n not in budgets]
    points.append(Point(steps, control_of(reference_trial(study, first)), CONTROL))
    beyond = [f"{n:,}" for n in study.designs.long if n not in budgets]
    alone = f" Points of {', '.join(beyond)} steps have one seed." if beyond else ""
    one_run = " The points of a seed are one run, whose rate decays at each."
    shared = one_run if study.train.optimizer.schedule == "wsd" else ""
    return Sweep(
        "horizon",
        "training steps",
        study.dataset_names(),
        tuple(points),
        question=f"What does training for longer buy?{shared}{alone}",
        gain="more steps",
        reference_x=steps,
    )


if __name__ == "__main__":
    run_sweep("horizon")
