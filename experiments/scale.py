"""What a person with data of their own should know before hours pass: how large a model is trained, and on how much of
the data."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.cost import count_parameters
from experiments.presets import ON_ACCELERATORS
from experiments.progress import say
from experiments.running.trial import Trial
from experiments.setting import Setting
from experiments.study import Study
from experiments.words import counted, few, in_thousands


def say_scale(setting: Setting, trials: Sequence[Trial]) -> None:
    """One line on the largest model of `trials`, and another preset where this one is made for a processor."""
    height, width = setting.study.tokenizer.image_shape
    widest = max(trials, key=lambda trial: (trial.model.width, trial.model.layers, len(trial.datasets)))
    caps = [trial.max_trajectories for trial in trials]
    some = any(trial.capped for trial in trials)  # a cap that holds for some datasets leaves the others whole
    most = "all" if None in caps or some else f"at most {max(caps):,}"
    steps = sorted({trial.train.steps for trial in trials})
    longest = f"{'up to ' * (len(steps) > 1)}{counted(steps[-1], 'step')}"
    models = "a model of" if len({trial.model for trial in trials}) == 1 else "models of up to"
    name = setting.arguments.preset
    instead = ON_ACCELERATORS.get(name)
    advice = f". It is made for a processor: on a GPU or TPU take --preset {instead}" if instead else ""
    say(
        f"note: preset {name} trains {models} {in_thousands(count_parameters(widest))} parameters on images of {height} x "
        f"{width} pixels, for {longest} of {counted(widest.train.batch, 'window')}, with {most} "
        f"trajectories of each dataset{advice}"
    )


def say_unused(study: Study) -> None:
    """A line on datasets that have more trajectories than a trial takes, as far as the registry says how many."""
    from data_pipelines.registry import get_spec

    counts = study.trajectory_counts
    larger = {n: have for n in study.dataset_names() if (have := get_spec(n).episodes) > counts[-1]}
    if larger:
        having = few([f"{name} has {have:,}" for name, have in larger.items()])
        every = ",".join(map(str, (*counts, max(larger.values()))))
        say(
            f"note: {having} trajectories, of which a trial takes {counts[-1]:,} at most; to use all, with one more point on "
            f"the axis trajectories: --set trajectory_counts={every}"
        )
