"""Do other robots' data help, if the judged robots keep all of theirs?

Question: perplexity and delta PSNR on five robots, drawn anew for every seed, as others join the mixture, at a fixed
    number of windows on the judged robots: compute grows with the robots.
Paper figure: 6, left, under the design that measures transfer.
Command: python -m experiments.sweeps.transfer --preset cpu-full
Cost: branches of the runs of `dilution`; `--dry-run` prints it.
Expected outcome: flat without transfer, falling perplexity with it. More steps also mean a trunk that is trained for
    longer: the same robots alone, for as many steps, are a point of `dilution`.
"""

from __future__ import annotations

from experiments.study import Study
from experiments.sweeps.robots import plan_robots, require_uniform
from experiments.sweeps.sweep import Sweep
from experiments.terminal.program import run_sweep


def plan(study: Study) -> Sweep:
    """Steps grow in proportion to the robots, up to the study's number at the last point. With a uniform mixture, each
    robot then sees the same number of windows at every point. Raises ConfigError if the mixture is not uniform."""
    require_uniform(study, "transfer")
    counts = study.designs.counts
    return plan_robots(
        study,
        name="transfer",
        axis="robots in the mixture, windows of the judged fixed",
        steps={count: study.train.steps * count // counts[-1] for count in counts},
        question="Do other robots' data help when the judged robots keep all of theirs? "
        f"{study.designs.judged} robots are judged, drawn anew for every seed. They see the same number of windows at every "
        "point, and compute grows.",
        gain="more robots",
    )


if __name__ == "__main__":
    run_sweep("transfer")
