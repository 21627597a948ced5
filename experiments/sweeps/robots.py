"""What the designs over robots share: judged robots that are drawn for every seed, and newcomers around them."""

from __future__ import annotations

from dataclasses import replace

from experiments.running.trial import Trial
from experiments.study import Study
from experiments.sweeps.draws import Kinship, draw_judged, draw_mixture
from experiments.sweeps.sweep import CONTROL, Point, Sweep, control_of, reference_trial
from hma_jax.config import require

UNIFORM = 100.0
"""Mixture temperature from which all robots are taken to have equal weight: at this value, weights for 480 and for 8
episodes differ by 4 %."""


def require_uniform(study: Study, axis: str) -> None:
    """Raises ConfigError unless every robot has the same share of the windows, whichever others there are."""
    require(
        study.tau >= UNIFORM,
        f"the axis {axis} keeps the number of windows per robot fixed, which needs a uniform mixture, but tau is "
        f"{study.tau:g}; add --set tau=1000",
    )


def robots_trial(study: Study, seed: int, count: int, steps: int, kinship: Kinship = "any") -> Trial:
    """A trial on `count` robots that evaluates only the seed's judged robots, which are among them. With all robots of
    the study, for its own number of steps, it is the reference trial."""
    names = study.dataset_names()
    require(
        steps >= 1,
        f"{count} of {len(names)} robots are to be trained for their share of train.steps {study.train.steps}, which is "
        f"none; set it to at least {-(-len(names) // count)}",
    )
    if count == len(names):
        return reference_trial(study, seed, steps)
    reference = replace(reference_trial(study, seed, steps), measure_untrained=False)
    mixture = draw_mixture(study, seed, count, kinship)
    return replace(reference, datasets=mixture, evaluated=draw_judged(study, seed))


def plan_robots(study: Study, name: str, axis: str, steps: dict[int, int], *, question: str, gain: str) -> Sweep:
    """The sweep over numbers of robots, each trained for its `steps`, with controls at both ends."""
    counts = tuple(steps)
    require(
        counts[:1] == (study.designs.judged,) and counts[-1:] == (len(study.dataset_names()),),
        f"designs.counts {counts} must begin with designs.judged, {study.designs.judged}, and end with all "
        f"{len(study.dataset_names())} robots",
    )

    def point(seed: int, count: int) -> Point:
        return Point(count, robots_trial(study, seed, count, steps[count]), scope=draw_judged(study, seed))

    points = [point(seed, count) for count in counts for seed in study.seeds]
    for count in sorted({counts[0], counts[-1]}):
        end = point(study.seeds[0], count)
        points.append(replace(end, trial=control_of(end.trial), role=CONTROL))
    scope = draw_judged(study, study.seeds[0])
    return Sweep(name, axis, scope, tuple(points), question=question, gain=gain, reference_x=counts[-1])
