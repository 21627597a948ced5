"""What users should know before hours pass: how large a model is trained, on how much of their data, where its
tokenizer is trained, and which setting has no effect in this number of steps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from data_pipelines.registry import get_spec
from experiments.data_size import are_counted, size_of
from experiments.dry_run.cost import count_parameters
from experiments.presets import ON_ACCELERATORS
from experiments.running.launchers.registry import LauncherOptions
from experiments.running.slots import find_accelerators
from experiments.running.trial import Trial
from experiments.study import Study, most_trajectories
from experiments.study_setup import StudySetup
from experiments.sweeps.sweep import Sweep
from experiments.terminal.progress import say
from experiments.terminal.words import counted, few, in_thousands
from hma_jax.config import ConfigError, TokenizerConfig, TrainConfig


def say_notes(setup: StudySetup, sweeps: Sequence[Sweep], launcher_options: LauncherOptions) -> None:
    """Prints all notes, before a study runs and in its dry run."""
    trials = [point.trial for sweep in sweeps for point in sweep.points]
    if setup.data:
        say_scale(setup, trials)
        _say_unused(setup.study)
        say_points(setup, sweeps)
        _say_one_point(setup, sweeps)
    say_average(trial.train for trial in trials)
    _say_prepared_here(setup, launcher_options)


@contextmanager
def refusal_as_note() -> Iterator[None]:
    """In a dry run, prints as a note the error with which the command itself would end."""
    try:
        yield
    except ConfigError as error:
        say(f"note: without --dry-run this command would be refused: {error}")


def say_scale(setup: StudySetup, trials: Sequence[Trial]) -> None:
    """Prints a line on the largest model of `trials`, and names another preset if this one is made for CPUs."""
    height, width = setup.study.tokenizer.image_shape
    widest = max(trials, key=lambda trial: (trial.model.width, trial.model.layers, len(trial.datasets)))
    caps = [trial.max_trajectories for trial in trials]
    some = any(trial.capped for trial in trials)  # a cap on some datasets leaves the others whole
    most = None if None in caps or some else max(caps)
    tokenised = setup.study.store.max_train
    most = min((n for n in (most, tokenised) if n is not None), default=None)
    steps = sorted({trial.train.steps for trial in trials})
    longest = f"{'up to ' * (len(steps) > 1)}{counted(steps[-1], 'step')}"
    models = "a model of" if len({trial.model for trial in trials}) == 1 else "models of up to"
    name = setup.arguments.preset
    instead = ON_ACCELERATORS.get(name)
    advice = f". It is made for a processor: on a GPU or TPU take --preset {instead}" if instead else ""
    say(
        f"note: preset {name} trains {models} {in_thousands(count_parameters(widest))} parameters on images of {height} x "
        f"{width} pixels, for {longest} of {counted(widest.train.batch, 'window')}, with "
        f"{'all' if most is None else f'at most {most:,}'} "
        f"trajectories of each dataset{advice}"
    )


def say_average(configs: Iterable[TrainConfig]) -> None:
    """Prints a line if the decay of the moving average is larger than any that a run reaches, so that other values
    would have the same effect."""
    from hma_jax.training.average import warmup_decay

    last = {(config.ema_decay, config.steps): warmup_decay(config.steps - 1) for config in configs}
    short = [
        f"{decay:g} in {counted(steps, 'step')} ({last[decay, steps]:.6g} at the end)"
        for decay, steps in sorted(last)
        if last[decay, steps] < decay
    ]
    if short:
        say(
            "note: the decay of the moving average rises with the steps and does not come to train.ema_decay: "
            f"{few(short)}. Every larger value has the same effect"
        )


def _say_prepared_here(setup: StudySetup, launcher_options: LauncherOptions) -> None:
    """Prints a line if a study for accelerators trains its tokenizer on this machine, which has none, while its trials
    run on other machines."""
    elsewhere = launcher_options.name != "local" and setup.study.for_accelerators
    made = setup.tokenizer is not None or setup.workspace.tokenizer.exists()
    made = made or not isinstance(setup.study.tokenizer, TokenizerConfig)  # it cannot be trained
    if elsewhere and not made and find_accelerators() is None:
        say(
            "note: the tokenizer would be trained on this machine, where no accelerator is found, for much longer than a "
            f"dry run says. First run, on a machine that has one: {setup.command('tokenizer train')}"
        )


def say_points(setup: StudySetup, sweeps: Sequence[Sweep]) -> None:
    """Prints a line if the axis trajectories has fewer points on the user's datasets than were asked for."""
    caps, most = setup.study.trajectory_counts, most_trajectories(setup.study)
    dropped = [cap for cap in setup.asked_counts if cap not in caps]
    if "trajectories" in {sweep.name for sweep in sweeps} and dropped and most:
        by = "" if are_counted(setup.study.dataset_names()) else "by the registry "
        others = f"; for other points: --set trajectory_counts={_parts(most)}" if most > 1 else ""
        say(
            f"note: {by}no dataset has more than {most:,} trajectories to train on, so the axis trajectories has "
            f"{_listed(caps)}, without {_listed(dropped)}, which would train on the same{others}"
        )


def _say_one_point(setup: StudySetup, sweeps: Sequence[Sweep]) -> None:
    """Prints a line if the axis datasets has only one point although there are several datasets, and the user did not
    choose this."""
    names, alone = setup.study.dataset_names(), len(setup.study.dataset_counts) == 1
    chosen = "dataset_counts" in setup.arguments.chosen()
    if "datasets" in {sweep.name for sweep in sweeps} and not chosen and alone and len(names) > 1:
        points = _parts(len(names))
        fewest = counted(int(points.partition(",")[0]), "dataset")
        say(
            f"note: the axis datasets has one point, with all {len(names)} datasets; for more, all judged on {fewest}: "
            f"--set dataset_counts={points}"
        )


def _parts(whole: int) -> str:
    """A quarter, half and all of `whole`, as a list for --set."""
    return ",".join(map(str, sorted({max(round(part * whole), 1) for part in (0.25, 0.5, 1)})))


def _listed(numbers: Sequence[int]) -> str:
    *first, last = (f"{n:,}" for n in numbers)
    return f"{', '.join(first)} and {last}" if first else last


def _say_unused(study: Study) -> None:
    """Prints a line on datasets that have more trajectories to train on than a trial takes, as far as their number is
    known."""
    counts, names = study.trajectory_counts, study.dataset_names()
    sizes = {name: size_of(get_spec(name), study.store.held_out) for name in names}
    larger = {name: size.tokenised for name, size in sizes.items() if (size.trained or size.tokenised) > counts[-1]}
    if larger:
        having = few([f"{name} has {have:,}" for name, have in larger.items()])
        every = ",".join(map(str, (*counts, max(larger.values()))))
        say(
            f"note: {having} trajectories, of which a trial takes {counts[-1]:,} at most; to use all, with one more point on "
            f"the axis trajectories: --set trajectory_counts={every}"
        )
