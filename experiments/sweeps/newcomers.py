"""Do newcomers with much data help robots with little, and does it matter whether they are siblings?

Question: perplexity and delta PSNR on five robots with eight trajectories each, drawn anew for every seed: alone,
    alone for as long as with all others, among siblings, among strangers, and among all robots.
Paper figure: none.
Command: python -m experiments.sweeps.newcomers --preset cpu-full
Cost: five training runs per seed; `--dry-run` prints it.
Expected outcome: newcomers help where the robots with little data overfit alone; siblings, which share a body plan and
    controls, help more than strangers.
"""

from __future__ import annotations

from dataclasses import replace

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.draws import draw_judged
from experiments.sweeps.robots import require_uniform, robots_trial
from experiments.sweeps.sweep import CONTROL, Point, Sweep, control_of
from experiments.terminal.program import run_sweep
from hma_jax.config import require


def plan(study: Study) -> Sweep:
    """The judged robots see the same number of windows at every point, except where they are trained alone for as long
    as with all others.

    Newcomers have all their trajectories. Raises ConfigError if the mixture is not uniform, and if siblings and
    strangers would be the same robots."""
    require_uniform(study, "newcomers")
    designs, names, most = study.designs, study.dataset_names(), study.train.steps
    alone, some, everyone = designs.judged, designs.kinship, len(names)
    require(
        alone < some < everyone,
        f"designs.kinship {some} robots, siblings or strangers, must be more than the {alone} judged robots and fewer "
        f"than all {everyone}: --set designs.kinship=..., or leave the axis newcomers out",
    )
    labels = {
        "alone": (alone, "any", most * alone // everyone),
        "alone, as long as with all": (alone, "any", most),
        f"{some}, siblings": (some, "siblings", most * some // everyone),
        f"{some}, strangers": (some, "strangers", most * some // everyone),
        "all robots": (everyone, "any", most),
    }

    def trial(label: str, seed: int) -> Trial:
        count, kinship, steps = labels[label]
        judged = draw_judged(study, seed)
        whole = replace(robots_trial(study, seed, count, steps, kinship), measure_untrained=False)
        return replace(whole, max_trajectories=designs.poor, capped=judged, evaluated=judged)

    points = [
        Point(x, trial(label, seed), scope=draw_judged(study, seed))
        for x, label in enumerate(labels)
        for seed in study.seeds
    ]
    last = list(labels)[-1]
    points.append(Point(len(labels) - 1, control_of(trial(last, study.seeds[0])), CONTROL,
                        scope=draw_judged(study, study.seeds[0])))  # fmt: skip
    return Sweep(
        "newcomers",
        "the mixture",
        draw_judged(study, study.seeds[0]),
        tuple(points),
        question=f"Do newcomers with much data help robots with {designs.poor} trajectories each? {alone} robots "
        "are judged, drawn anew for every seed. They see as many windows at every point, except where they are trained "
        "alone for as long as with all others.",
        gain="newcomers",
        title="Poor robots and newcomers",
        labels=tuple(labels),
        reference_x=len(labels) - 1,
    )


if __name__ == "__main__":
    run_sweep("newcomers")
