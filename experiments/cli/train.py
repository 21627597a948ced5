"""`hma train` and `hma adapt`: single models, trained on a study's data."""

from __future__ import annotations

import dataclasses
import json
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from experiments.cli.arguments import ModelOptions, ReplaceOptions, SavingOptions, StudyOptions
from experiments.cli.hosts import Hosts
from experiments.cli.initial_model import (
    known_datasets,
    load_initial,
    new_datasets,
    newest_description,
    origin_of,
    require_known,
    require_other_directory,
    setup_of,
)
from experiments.preparing.made_from import Step, may_replace
from experiments.running.attempts import JOB, RUN, newest_step
from experiments.running.launchers.registry import LauncherOptions
from experiments.running.run_options import RunOptions
from experiments.running.trial import Trial, loader_of, trial_id
from experiments.running.workspace import Workspace
from experiments.study_setup import UNSET, StudySetup, make_setup
from experiments.sweeps.sweep import Point, Sweep, reference_trial
from experiments.terminal.progress import console, say, short, step, wrote
from experiments.terminal.words import counted, few, times
from hma_jax.config import require
from hma_jax.training.run_lock import require_plain

if TYPE_CHECKING:
    from experiments.running.run_trial import PreparedData
    from hma_jax.training.runs import Run


SWEPT = ("seeds", "ablation_seeds", "axes", "widths", "trajectory_counts", "transfer", "designs", "judged")
"""Settings of a study that a single model does not use; of `seeds` it uses the first."""


def train(
    arguments: StudyOptions,
    model: ModelOptions,
    options: SavingOptions,
    replacement: ReplaceOptions,
    hosts: OmitArgPrefixes[Hosts],
    initial: Annotated[Path | None, arg(name="from", metavar="RUN"), UNSET] = None,
    dry_run: Annotated[FlagCreatePairsOff[bool], arg(name="dry-run"), UNSET] = False,
) -> None:
    """Train one model: the study's reference trial, on all trajectories unless --trajectories is given.

    Change its settings with --set. Prints what it trains on. Run the same command again after an interruption: it
    continues from the last checkpoint.

    Args:
        arguments: Study, data, output directory and settings.
        model: How this model is trained; sweeps do not use this.
        options: How the run is saved and validated; may differ each time the run is continued.
        replacement: Results made with other settings or data are replaced only on request.
        hosts: Several processes that train together, on one host or on many.
        initial: Fine-tune this run: a trained or converted model that knows the study's robots. The new run takes its
            architecture, tokenizer and weights (the averaged weights, if it keeps an average). Robots that the study
            does not have stay unchanged.
        dry_run: Print parameters, FLOPs and expected time on the devices that it would use, and stop.
    """
    if not dry_run:
        hosts.join()
    run = model.directory(arguments)
    trained = None if initial is None else load_initial(initial, run)
    setup = make_setup(arguments) if trained is None else setup_of(initial, trained, arguments)
    _say_swept(setup)
    _say_average(setup)
    if trained is not None:
        require_known(initial, trained, setup)
        require_other_directory(initial, run)
    if dry_run:
        from experiments.dry_run.notes import refusal_as_note
        from experiments.preparing.changes import require_preparable
        from experiments.preparing.sources import check_entries

        _check(setup, run, model.trajectories, options, trained)
        if setup.data:
            check_entries(setup.study, setup.data)
        _print_cost(setup, _single_trial(setup, model.trajectories), run, hosts.count())
        if trained is None:
            _say_scale(setup, model.trajectories)
        with refusal_as_note():
            require_preparable(setup.study, setup.workspace, setup.data, setup.tokenizer, replacement.replace)
        return
    train_model(setup, run, options, trajectories=model.trajectories, replace=replacement.replace, initial=trained)


def adapt(
    source: Annotated[Positional[Path], arg(metavar="RUN")],
    arguments: StudyOptions,
    model: ModelOptions,
    options: SavingOptions,
    replacement: ReplaceOptions,
    hosts: OmitArgPrefixes[Hosts],
    everything: Annotated[FlagCreatePairsOff[bool], UNSET] = False,
) -> None:
    """Add new robots to a trained model and train them on the study's datasets.

    The model gets a stem, conditioning and head for every dataset that it does not know. Its predictions for the robots
    that it knows stay the same, bit for bit, unless --everything is given. If the run keeps an average of its weights,
    that average is taken, as in evaluation.

    Args:
        source: Directory of the training run that knows the other robots.
        arguments: The study with the new datasets. It uses the tokenizer of the trained model: give it with --tokenizer
            if it is not beside RUN.
        model: How the new robots are trained.
        options: How the run is saved and validated; may differ each time the run is continued.
        replacement: Results made with other settings or data are replaced only on request.
        hosts: Several processes that train together, on one host or on many.
        everything: Train the whole model, not only the new robots' own parameters.
    """
    from experiments.dry_run.trainable import require_only
    from experiments.running.initial_model import add_robots
    from experiments.running.run_trial import open_prepared_data

    hosts.join()
    run = model.directory(arguments)
    trained, gone = load_initial(source, run), not source.exists()
    setup = setup_of(source, trained, arguments)
    study = setup.study
    # If the source is gone, `run` itself is read, which already has the new robots.
    new = list(trained.train.only) or study.dataset_names() if gone else new_datasets(trained, setup)
    require(
        bool(new),
        f"{short(source)} already knows {few(study.dataset_names())}: there is nothing to add. To train it on: "
        f"{setup.command('train', '--from', source)} --run NEW",
    )
    require(
        not study.train.only,
        "leave out train.only: `hma adapt` trains only the new robots' parameters, or all with --everything",
    )
    _say_average(setup)
    require_other_directory(source, run)
    origin = _check(setup, run, model.trajectories, options, trained)
    train = dataclasses.replace(study.train, seed=study.seeds[0], only=() if everything else tuple(new))
    require_only(train, new, study.rate)
    _require_devices(setup)
    _prepare(setup, replacement.replace)
    trial = dataclasses.replace(_single_trial(setup, model.trajectories), train=train)
    if gone:
        beginning = {"table": trained.table, "initial": trained.params, "origin": origin}
    else:
        beginning = add_robots(trained, trial, open_prepared_data(setup.workspace)) | {"origin": origin}
    console.print(f"new: {', '.join(new)}; training {'everything' if everything else 'these alone'}")
    del trained  # its arrays are not needed while the new model trains
    _train(setup, trial, run, options, **beginning)


def train_model(
    setup: StudySetup,
    run: Path,
    options: RunOptions,
    *,
    trajectories: int | None,
    replace: Step | None,
    initial: Run | None,
) -> None:
    """Trains the study's reference trial on its own, on `trajectories` of each robot (None: all). If the run `initial`
    is given, training starts from its weights; it must know the robots."""
    origin = _check(setup, run, trajectories, options, initial)
    _require_devices(setup)
    if initial is None:
        _say_scale(setup, trajectories)
    _prepare(setup, replace)
    start = {}
    if initial is not None:
        kept = [name for name in initial.table.names if name not in known_datasets(initial, setup)]
        if kept:
            say(f"note: unchanged, because the study has no data of them: {', '.join(kept)}")
        start = {"table": initial.table, "initial": initial.params, "origin": origin}
    _train(setup, _single_trial(setup, trajectories), run, options, **start)


def _check(
    setup: StudySetup, run: Path, trajectories: int | None, options: RunOptions, initial: Run | None
) -> dict[str, Any] | None:
    """The origin of the run (`origin_of`). Raises ConfigError, before any work, for invalid options and for a run that
    was not trained here or began with another model."""
    from experiments.dry_run.trainable import require_only
    from hma_jax.training.optimizer import check_schedule

    options.check()
    require_plain(run)
    _require_free(setup, run)
    _require_no_trial(setup, run)
    check_schedule(setup.study.train.optimizer, setup.study.train.steps)
    require_only(setup.study.train, setup.study.dataset_names(), setup.study.rate)
    require(trajectories is None or trajectories >= 1, f"--trajectories must be at least 1, got {trajectories}")
    _require_trained_here(setup, run)
    return origin_of(run, initial)


def _require_free(setup: StudySetup, run: Path) -> None:
    """Raises ConfigError if `run` is the directory of a study or of one of its parts. In a study's own directory, no
    application would find tokenizer and tokens beside the run."""
    study = setup.workspace
    parts = (study.suite, study.tokenizer, study.store, study.trials, study.predictions, study.figures)
    there = run.resolve()
    whole = there == study.root.resolve() or Workspace(run).manifest.exists() or Workspace(run).record.exists()
    require(
        not whole and there not in [part.resolve() for part in parts],
        f"--run {short(run)} is {'the directory of a study' if whole else 'a directory that the study keeps for itself'}; give "
        f"the run a directory of its own, such as {short((run if whole else study.root) / 'model')}",
    )


def _require_no_trial(setup: StudySetup, run: Path) -> None:
    """Raises ConfigError for the run of a trial: the trial's result seals its log, and its study fixes the
    number of steps."""
    require(
        run.name != RUN or not (run.absolute().parent / JOB).is_file(),
        f"{short(run)} is the run of a trial, and its study would refuse what was trained on; to train its model further: "
        f"{setup.command('train', '--from', run)} --run NEW",
    )


def _require_trained_here(setup: StudySetup, run: Path) -> None:
    """Raises ConfigError for a converted run: it has no data here with which training could continue."""
    step, described = newest_description(run)
    # Without a table it is no model, which restoring reports. Training saves nothing before its first step, so
    # weights of step 0 come from another run, perhaps with that run's description (`hma convert from-safetensors`).
    require(
        "table" not in described or (step > 0 and "loader" in described["provenance"]),
        f"{short(run)} was converted, not trained here, so it cannot be resumed; fine-tune it with: "
        f"{setup.command('train', '--from', run)} --run NEW",
    )


def _require_devices(setup: StudySetup) -> None:
    """Raises ConfigError, before any work, if the mesh does not fit the devices here, the batch or the model."""
    from hma_jax.runtime.mesh import check_mesh, make_mesh

    study, execution = setup.study, setup.study.execution
    check_mesh(make_mesh(execution.mesh), study.model, study.train.batch, execution.accumulate)


def _prepare(setup: StudySetup, replace: Step | None) -> None:
    from experiments.preparing.pipeline import prepare
    from hma_jax.runtime.processes import is_writer, writer_first

    _require_no_tokenizer_training(setup, replace)
    with writer_first("data"):
        if is_writer():
            with setup.workspace.locked():
                prepare(setup.study, setup.workspace, setup.data, setup.tokenizer, replace=replace)


def _require_no_tokenizer_training(setup: StudySetup, replace: Step | None) -> None:
    """With several processes, raises ConfigError in all of them if process 0 would train a tokenizer while it prepares
    alone: training waits for all processes."""
    import jax

    again = may_replace("tokenizer", replace)
    there = setup.workspace.tokenizer.exists() and not again
    first = setup.command("tokenizer train", *(["--replace", replace] if again and replace else []))
    require(
        jax.process_count() == 1 or setup.tokenizer is not None or there,
        f"several processes do not train a tokenizer: first run `{first}` in one process, then this command"
        f"{' with --replace tokens' if again else ''}; or give a tokenizer with --tokenizer",
    )


def _say_swept(setup: StudySetup) -> None:
    """Names the settings that were given although only sweeps use them."""
    first, *more = setup.study.seeds
    names = {path: "seeds beyond the first" if path == "seeds" and more else path for path in setup.arguments.chosen()}
    without = [name for path, name in names.items() if name != "seeds" and path.split(".")[0] in SWEPT]
    if without:
        say(f"note: one model is trained, of seed {first}; without effect: {', '.join(without)}")


def _say_scale(setup: StudySetup, trajectories: int | None) -> None:
    from experiments.dry_run.notes import say_scale

    if setup.data:
        say_scale(setup, [_single_trial(setup, trajectories)])


def _say_average(setup: StudySetup) -> None:
    from experiments.dry_run.notes import say_average

    say_average([setup.study.train])


def _single_trial(setup: StudySetup, trajectories: int | None) -> Trial:
    """The reference trial, but with `trajectories` of each robot (None: all) in place of a sweep's largest number."""
    study = setup.study
    return dataclasses.replace(reference_trial(study, study.seeds[0]), max_trajectories=trajectories)


def _print_cost(setup: StudySetup, trial: Trial, run: Path, processes: int) -> None:
    """Prints the dry run of a study with this trial only, for the steps that `run` does not have yet, on the devices of
    `processes` processes like this one."""
    from experiments.dry_run.done import UNKNOWN, find_prepared
    from experiments.dry_run.plan_table import Devices, plan_table
    from experiments.dry_run.trainable import check_trials

    mesh, own = setup.study.execution.mesh, LauncherOptions().share()
    share = own * processes if own else float(max(processes, mesh.min_devices))
    model = Sweep("model", axis="", scope=trial.evaluated, points=(Point(0, trial),))
    devices = Devices(check_trials(setup.study, [model], share))
    given, trained = bool(setup.data), setup.tokenizer is None
    id, made = trial_id(trial, UNKNOWN), newest_step(run)
    done = dataclasses.replace(find_prepared(setup), steps={id: made} if made else {})
    table = plan_table(setup.study, [model], devices, given=given, trained=trained, evaluated=False, done=done)
    console.print(table)


def _train(setup: StudySetup, trial: Trial, run: Path, options: RunOptions, **start: Any) -> None:
    from experiments.running.run_trial import open_prepared_data, train_trial
    from experiments.running.shared_runs import common_steps
    from hma_jax.runtime.processes import is_writer

    prepared, optimizer = open_prepared_data(setup.workspace), trial.train.optimizer
    say_data(trial, prepared)
    say(f"logs: {short(run)} (tensorboard --logdir {shlex.quote(short(run))})")
    steps, made = trial.train.steps, newest_step(run)
    there = f", of which it has {made:,}" if made else ""
    each = counted(trial.train.batch, "window")
    with step(f"train width {trial.model.width} for {counted(steps, 'step')} of {each}{there}") as update:
        result = train_trial(
            trial,
            prepared,
            run,
            execution=setup.study.execution,
            options=options,
            # A run can be extended from before its decay.
            keep=(common_steps(optimizer, steps, 2 * steps),) if optimizer.schedule == "wsd" else (),
            progress=lambda phase, done, total: update(done, total, phase),
            **start,
        )
    if not is_writer():
        return
    loss = f"{result.losses[-1]:.4f}" if result.losses else "unknown (the log is lost)"
    console.print(f"loss {loss} after {counted(steps, 'step')}{_held_out(run)}")
    profiles = _say_profiled(run, options.trace or 0, result.resumed_from, steps)
    wrote(run, *profiles, then=setup.command("evaluate", run.absolute()))


def _held_out(run: Path) -> str:
    """The latest held-out loss of a run, in words, and its lowest, after which it may have overfitted; '' without
    any."""
    file = run / "validation.jsonl"
    seen = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    if not seen:
        return ""
    best = min(seen, key=lambda line: line["loss"])
    lowest = f", lowest {best['loss']:.4f} at step {best['step']:,}" if best["step"] != seen[-1]["step"] else ""
    return f"; held-out loss {seen[-1]['loss']:.4f}{lowest}"


def _say_profiled(run: Path, asked: int, start: int, steps: int) -> list[Path]:
    """The directory of the profile that a run from step `start` to `steps` recorded, if it did. Prints which steps it
    covers and how to view it."""
    from hma_jax.training.step_trace import PROFILE, traced_steps

    first, last = traced_steps(asked, start, steps)
    if not first:
        if asked:
            say("note: no step was profiled: the run had all of its steps")
        return []
    profile, fewer = run / PROFILE, f" ({asked:,} were asked for)" if last - first + 1 < asked else ""
    which = f"step {first:,} was" if first == last else f"steps {first:,} to {last:,} were"
    say(
        f"note: {which} profiled{fewer}. To see that: pip install xprof, then xprof --logdir {short(profile)}; or open "
        f"{short(profile)}/plugins/profile/*/perfetto_trace.json.gz at https://ui.perfetto.dev"
    )
    return [profile]


def say_data(trial: Trial, prepared: PreparedData) -> None:
    """Prints what a model is trained on. Raises DataError if it is nothing."""
    from data_pipelines.loading.selection import select_windows
    from experiments.cli.mixture import show_drawn

    chosen = select_windows(prepared.store, loader_of(trial))
    used = [chosen.sets[name] for name in chosen.mixture.names]
    episodes = sum(len(prepared.store.manifest(name).train.episodes) for name in trial.datasets)
    windows = sum(map(len, used))
    passes = trial.train.steps * trial.train.batch / max(windows, 1)
    limit = "" if trial.max_trajectories is None else f" (at most {trial.max_trajectories:,} of each robot)"
    say(
        f"training on {len(used)} of {counted(len(trial.datasets), 'robot')}: {sum(len(s.episodes) for s in used):,} of "
        f"{episodes:,} trajectories{limit}, {windows:,} windows of {trial.model.frames} frames, each "
        f"seen {times(passes)} times on average"
    )
    show_drawn(chosen.drawn(), trial)
    for name, reason in chosen.mixture.dropped.items():
        say(f"note: not trained on {name}: {reason}")
