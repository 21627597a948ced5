"""How much of a new robot must a trained model see, and how many robots must it know by then?

Question: perplexity and delta PSNR on robots that no model was trained on, after adapting (`hma adapt`: only the new
    robots' own parameters are trained) with few trajectories of each, for models that know more and more robots,
    compared with a new model trained on the same trajectories. The model that knows most robots is also adapted with
    everything trained (`hma adapt --everything`).
Paper figure: 7, in spirit.
Command: python -m experiments.sweeps.fewshot --preset cpu-full
Cost: one short training run per point, curve and seed, after those of `dilution`; `--dry-run` prints it.
Expected outcome: adapting is ahead of scratch with few trajectories, more so after more robots.
"""

from __future__ import annotations

from dataclasses import replace

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.robots import robots_trial
from experiments.sweeps.sweep import Point, Sweep, reference_trial
from experiments.terminal.program import run_sweep
from hma_jax.config import require


def plan(study: Study) -> Sweep:
    """Every model adapts to all unseen robots at once. Raises ConfigError for a study without unseen robots, or without
    numbers of trajectories or of known robots."""
    designs, unseen = study.designs, study.unseen
    require(bool(unseen), "the axis fewshot needs robots to adapt to; set them with --set unseen=...")
    for name in ("shots", "shots_after"):
        empty = not getattr(designs, name)
        require(not empty, f"designs.{name} is empty; the axis fewshot needs at least one: --set designs.{name}=...")

    def trial(seed: int, shots: int, source: Trial | None, whole: bool = False) -> Trial:
        fresh = reference_trial(study, seed, designs.shots_steps)
        train = replace(fresh.train, only=unseen if source and not whole else ())
        return replace(
            fresh, datasets=unseen, evaluated=unseen, max_trajectories=shots, train=train, source=source,
            measure_untrained=False,
        )  # fmt: skip

    def source(seed: int, known: int) -> Trial:
        return robots_trial(study, seed, known, study.train.steps)

    points = [Point(n, trial(s, n, None), series="from scratch") for n in designs.shots for s in study.seeds]
    points += [
        Point(n, trial(s, n, source(s, known)), series=f"after {known} robots")
        for known in designs.shots_after
        for n in designs.shots
        for s in study.seeds
    ]
    most = designs.shots_after[-1]
    points += [
        Point(n, trial(s, n, source(s, most), whole=True), series=f"after {most} robots, everything trained")
        for n in designs.shots
        for s in study.seeds
    ]
    return Sweep(
        "fewshot",
        "trajectories of each new robot",
        unseen,
        tuple(points),
        question=f"How much data of a new robot does a trained model need? {len(unseen)} robots are judged that no model was "
        f"trained on, after {designs.shots_steps:,} steps that train their own parameters alone; from scratch, and where "
        "the name says so, they train everything.",
        gain="knowing other robots",
        title="New robots from few trajectories",
    )


if __name__ == "__main__":
    run_sweep("fewshot")
