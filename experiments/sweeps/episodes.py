"""What does more data per robot buy, by the amount that really exists?

Question: perplexity and delta PSNR as every robot's trajectories are capped; x is the resulting total: the sum over
    robots of the smaller of the cap and the robot's own number. It is measured at a quarter, half and all of the steps:
    where data is scarce the best number of steps is smaller, and it should be chosen on episodes other than those
    judged.
Paper figure: 6, middle.
Command: python -m experiments.sweeps.episodes --preset cpu-full
Cost: one training run per cap and seed, with a branch for every number of steps; `--dry-run` prints it.
Expected outcome: perplexity falls and flattens where only the largest robots still have more to give.
"""

from __future__ import annotations

from dataclasses import replace

from data_pipelines.registry import get_spec
from experiments.data_size import size_of
from experiments.study import Study
from experiments.sweeps.sweep import CONTROL, Point, Sweep, control_of, reference_trial
from experiments.terminal.program import run_sweep
from experiments.terminal.words import counted, few
from hma_jax.config import require


def plan(study: Study) -> Sweep:
    """All robots at every point, judged on all; the last point has all trajectories. Raises ConfigError if no cap takes
    any trajectory away, and if it is not known how many there are."""
    # A cap that takes some away leaves more if it is raised by one.
    cutting = [cap for cap in study.designs.caps if count_episodes(study, cap) < count_episodes(study, cap + 1)]
    require(
        bool(cutting),
        "the axis episodes needs a cap below the number of trajectories of some robot, but none of designs.caps "
        f"{study.designs.caps} is: --set designs.caps=...",
    )
    caps = (*cutting, None)
    budgets = sorted({study.train.steps // 4, study.train.steps // 2, study.train.steps} - {0})

    def point(seed: int, cap: int | None, steps: int) -> Point:
        trial = reference_trial(study, seed, steps)
        if cap is not None:
            trial = replace(trial, max_trajectories=cap, measure_untrained=False)
        return Point(count_episodes(study, cap), trial, series=counted(steps, "step"))

    points = [point(seed, cap, steps) for steps in budgets for cap in caps for seed in study.seeds]
    for cap in (caps[0], None):
        end = point(study.seeds[0], cap, budgets[-1])
        points.append(replace(end, trial=control_of(end.trial), role=CONTROL, series=""))
    return Sweep(
        "episodes",
        "training trajectories of all robots together",
        study.dataset_names(),
        tuple(points),
        question="What does more data per robot buy? Every robot has at most "
        f"{', '.join(map(str, cutting))} or all of its trajectories, the same for all curves of a seed, "
        "each set inside the next; x is the total over robots. All robots are weighted equally everywhere.",
        gain="more data",
        title="Training trajectories",
    )


def count_episodes(study: Study, cap: int | None) -> int:
    """Training trajectories of all robots under a cap (None: that of the reference): exact for the suite, for others as
    `size_of` says. Raises ConfigError if the number is unknown."""
    from data_pipelines.suite.embodiments import EMBODIMENTS
    from data_pipelines.suite.generate import episode_count

    counts = {e.name: episode_count(e, study.suite.scale, study.suite.fewest) for e in EMBODIMENTS}
    episodes = {name: study.store.held_out.used(count, 0, True)[0] for name, count in counts.items()}
    given = [get_spec(name) for name in study.dataset_names() if name not in episodes]
    trained = {spec.name: size_of(spec, study.store.held_out).trained for spec in given}
    known = {name: count for name, count in trained.items() if count is not None}
    unknown = [spec for spec in given if spec.name not in known]
    split = [spec.name for spec in unknown if spec.val_split]
    require(
        not unknown,
        "the axis episodes needs the number of training trajectories, which is unknown for "
        f"{few([spec.name for spec in unknown])}: write `episodes` into the entries of your registry (`hma data inspect "
        "DIR --entry FILE` counts them), or leave the axis out"
        + (f"; how many of {few(split)} are in val_split, which is held out, no entry says" if split else ""),
    )
    episodes |= known
    most = study.trajectory_counts[-1]
    return sum(min(episodes[name], most, cap or most) for name in study.dataset_names())


if __name__ == "__main__":
    run_sweep("episodes")
