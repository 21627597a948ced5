"""`hma train` and `hma adapt`: single models of a study's data."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from experiments.cli.arguments import OneModel, Remake
from experiments.cli.evaluate import check_tokenizer
from experiments.cli.hosts import Hosts
from experiments.preparing.made_from import Step
from experiments.progress import console, step
from experiments.running.run_options import RunOptions
from experiments.setting import UNSET, Setting, StudyArguments, make_setting, short
from experiments.sweeps.sweep import reference_trial
from experiments.wrote import wrote
from hma_jax.config import require

if TYPE_CHECKING:
    from experiments.running.trial import Materials, Trial


def train(
    asked: OmitArgPrefixes[StudyArguments],
    one: OmitArgPrefixes[OneModel],
    options: OmitArgPrefixes[RunOptions],
    remake: OmitArgPrefixes[Remake],
    hosts: OmitArgPrefixes[Hosts],
    begin: Annotated[Path | None, arg(name="from", metavar="RUN"), UNSET] = None,
) -> None:
    """Train one model: the study's reference trial, on all trajectories unless told otherwise.

    Change it with --set. Says what it trains on, and resumes a run that was interrupted.

    Args:
        asked: Study, data, output directory and settings.
        one: How this model is trained; no sweep reads it.
        options: How the run is saved and watched; each start may say it anew.
        remake: What was made with other settings or data is never replaced without being asked for.
        hosts: Several processes that train together, on one host or on many.
        begin: A trained model of the same robots and architecture. The new run begins with its weights, or with their
            average where it keeps one.
    """
    hosts.join()
    setting = make_setting(asked)
    train_model(setting, one.directory(), options, trajectories=one.trajectories, replace=remake.replace, begin=begin)


def adapt(
    source: Annotated[Positional[Path], arg(metavar="RUN")],
    asked: OmitArgPrefixes[StudyArguments],
    one: OmitArgPrefixes[OneModel],
    options: OmitArgPrefixes[RunOptions],
    remake: OmitArgPrefixes[Remake],
    hosts: OmitArgPrefixes[Hosts],
    everything: Annotated[FlagCreatePairsOff[bool], UNSET] = False,
) -> None:
    """Add new robots to a trained model and train them on the study's datasets.

    The model gets a stem, conditioning and head for every dataset it does not know. What it says of
    the robots it knows stays the same, bit for bit, unless everything is trained.

    Args:
        source: Directory of the training run that knows the other robots.
        asked: The study with the new datasets. Give --tokenizer: the one of the trained model.
        one: How the new robots are trained.
        options: How the run is saved and watched; each start may say it anew.
        remake: What was made with other settings or data is never replaced without being asked for.
        hosts: Several processes that train together, on one host or on many.
        everything: Train the whole model, not the new robots' own parameters alone.
    """
    hosts.join()
    adapt_model(
        make_setting(asked),
        source,
        one.directory(),
        options,
        everything=everything,
        trajectories=one.trajectories,
        replace=remake.replace,
    )


def train_model(
    setting: Setting,
    run: Path | None,
    options: RunOptions,
    *,
    trajectories: int | None = None,
    replace: Step | None = None,
    begin: Path | None = None,
) -> None:
    """Trains the study's reference trial by itself, on all `trajectories` or so many of each robot, from the weights of
    the run `begin` on where one is given. Raises ConfigError if that is of another model."""
    _check(trajectories, options)
    _prepare(setting, replace)
    trial = _single_trial(setting, trajectories)
    start = {} if begin is None else _begin_with(begin, setting, trial)
    _train(setting, trial, run or setting.workspace.root / "model", options, **start)


def _begin_with(source: Path, setting: Setting, trial: Trial) -> dict[str, Any]:
    """What `train_trial` takes for a run that begins with the weights of `source`."""
    from experiments.running.trial import open_materials
    from hma_jax.training.runs import load_run

    trained = load_run(source, "auto")
    check_tokenizer(trained, open_materials(setting.workspace), f"; add --tokenizer with that of {short(source)}")
    require(
        (trained.model, trained.table.names) == (trial.model, trial.datasets),
        f"--from {short(source)} is another model or has other robots; give the settings it was trained with",
    )
    origin = {"step": trained.step, "provenance": trained.provenance}
    return {"table": trained.table, "initial": trained.params, "origin": origin}


def adapt_model(
    setting: Setting,
    source: Path,
    run: Path | None,
    options: RunOptions,
    *,
    everything: bool = False,
    trajectories: int | None = None,
    replace: Step | None = None,
) -> None:
    """Trains a model further that has first been given slices for the study's new datasets."""
    from experiments.running.newcomers import add_robots
    from experiments.running.trial import open_materials
    from hma_jax.training.runs import load_run

    _check(trajectories, options)
    _prepare(setting, replace)
    study, materials = setting.study, open_materials(setting.workspace)
    trained = load_run(source)
    check_tokenizer(trained, materials, f"; add --tokenizer with the one that {short(source)} was trained with")
    seed = study.seeds[0]
    new = [name for name in study.dataset_names() if name not in trained.table.names]
    require(bool(new), f"{source} already knows {', '.join(study.dataset_names())}: there is nothing to add")
    only = () if everything else tuple(new)
    trial = dataclasses.replace(
        _single_trial(setting, trajectories),
        model=trained.model,
        train=dataclasses.replace(study.train, seed=seed, only=only),
    )
    beginning = add_robots(trained, trial, materials)
    console.print(f"new: {', '.join(new)}; training {'everything' if everything else 'these alone'}")
    del trained  # its arrays are not needed while the new model trains
    where = run or setting.workspace.root / "model"
    _train(setting, trial, where, options, **beginning)


def _check(trajectories: int | None, options: RunOptions) -> None:
    options.check()
    require(trajectories is None or trajectories >= 1, f"--trajectories must be at least 1, got {trajectories}")


def _prepare(setting: Setting, replace: Step | None) -> None:
    from experiments.preparing.pipeline import prepare
    from hma_jax.runtime.processes import is_writer, writer_first

    with writer_first("data"):
        if is_writer():
            with setting.workspace.locked():
                prepare(setting.study, setting.workspace, setting.data, setting.tokenizer, replace=replace)


def _single_trial(setting: Setting, trajectories: int | None) -> Trial:
    """The reference trial, but that the largest number of trajectories in a sweep does not bound it."""
    study = setting.study
    return dataclasses.replace(reference_trial(study, study.seeds[0]), max_trajectories=trajectories)


def _train(setting: Setting, trial: Trial, run: Path, options: RunOptions, **start: Any) -> None:
    from experiments.running.trial import open_materials, train_trial
    from hma_jax.runtime.processes import is_writer

    materials, steps = open_materials(setting.workspace), trial.train.steps
    say_data(trial, materials)
    with step(f"train width {trial.model.width} for {steps:,} steps of {trial.train.batch} windows") as update:
        result = train_trial(
            trial,
            materials,
            run,
            execution=setting.study.execution,
            options=options,
            progress=lambda phase, done, total: update(done, total, phase),
            **start,
        )
    if not is_writer():
        return
    console.print(f"loss {result.losses[-1]:.4f} after {len(result.losses):,} steps")
    wrote(run, then=setting.command("evaluate", run.absolute()))


def say_data(trial: Trial, materials: Materials) -> None:
    """What a model is trained on. Raises DataError if it is nothing."""
    from data_pipelines.loading.selection import select_windows
    from experiments.running.trial import loader_of

    chosen = select_windows(materials.store, loader_of(trial))
    used = [chosen.sets[name] for name in chosen.mixture.names]
    there = sum(len(materials.store.manifest(name).train.episodes) for name in trial.datasets)
    limit = "" if trial.max_trajectories is None else f" (at most {trial.max_trajectories:,} of each robot)"
    console.print(
        f"training on {len(used)} of {len(trial.datasets)} robots: {sum(len(s.episodes) for s in used):,} of {there:,} "
        f"trajectories{limit}, {sum(map(len, used)):,} windows of {trial.model.frames} frames",
        soft_wrap=True,
    )
    for name, reason in chosen.mixture.dropped.items():
        console.print(f"note: not trained on {name}: {reason}", markup=False, soft_wrap=True)
