"""`hma study`, `hma sweep` and `hma report`: a whole study, one axis of it, or its page anew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg

from experiments.cli.arguments import ReplaceArguments, ReplaceOptions, RunningArguments, StudyOptions
from experiments.preparing.made_from import Step
from experiments.running.launchers.registry import LauncherOptions
from experiments.study_setup import StudyArguments, StudySetup, make_setup
from experiments.sweeps.registry import AXES, is_file, join_axes, plan_asked, plan_sweeps
from experiments.sweeps.sweep import unique_trials
from experiments.terminal.progress import console
from hma_jax.config import ConfigError, require


def study(
    arguments: StudyOptions,
    running: OmitArgPrefixes[RunningArguments],
    replacement: ReplaceOptions,
) -> None:
    """Run a whole scaling study: data, tokenizer, its sweeps, CSV, figures and a report page.

    The preset says which sweeps: datasets, trajectories and width; in cpu-full others too. Change them with --set
    axes=...

    Run the same command again after an interruption: only what is missing is done.
    """
    _run(("study",), arguments, running, replacement)


def sweep(
    axis: Annotated[Positional[str], arg(metavar="AXIS", help=f"What varies: {', '.join(AXES)} or FILE.py.")],
    arguments: StudyOptions,
    running: OmitArgPrefixes[RunningArguments],
    replacement: ReplaceOptions,
) -> None:
    """Run one sweep: train and evaluate models along one axis.

    datasets, trajectories and width are the sweeps of `hma study`; settings and conditioning are ablations; lr is the
    transfer of learning rates between widths. docs/sweeps.md and docs/designs.md describe the others. For an axis of
    your own give a Python file (docs/own_axis.md). Sweeps with the same --out share data and trials.

    Args:
        axis: What varies.
        arguments: Which study, on which data, in which directory, on which devices.
        running: How trials are run; none of it changes a result.
        replacement: Results made with other settings or data are replaced only on request.
    """
    _run(("sweep", Path(axis).absolute() if is_file(axis) else axis), arguments, running, replacement, (axis,))


def report(study: Annotated[Positional[Path], arg(metavar="STUDY")]) -> None:
    """Write the CSV files, figures and report page of a study again, from its finished trials.

    Args:
        study: Directory of a study that has run.
    """
    from experiments.report.draw import draw_again

    draw_again(study)


def _run(
    words: tuple[str | Path, ...],
    arguments: StudyArguments,
    running: RunningArguments,
    replacement: ReplaceArguments,
    axes: tuple[str, ...] = (),
) -> None:
    """`axes`: () for those of the study."""
    setup = make_setup(arguments)
    axes = axes or setup.study.axes
    require(bool(axes), "axes is empty: the study has no sweep to run; set some, such as --set axes=width,datasets")
    grid = [name for name in arguments.chosen() if name.startswith("transfer.")]
    require(
        not grid or any(axis == "lr" or axis.endswith(".py") for axis in axes),
        f"{', '.join(grid)} would have no effect: it sets the grid of the axis lr, which is not among {', '.join(axes)}",
    )
    if running.workers is not None and running.workers < 1:
        raise ConfigError(f"--workers must be at least 1, got {running.workers}")
    launcher_options = LauncherOptions(running.launcher, running.workers, running.launcher_set)
    if running.dry_run:
        _dry_run(setup, axes, running, launcher_options, replacement.replace)
        return
    from experiments.run_study import run_study

    run_study(
        setup,
        axes,
        again=setup.command(*words, *running.words(), "--retry-failed", *["--accept-code"] * running.accept_code),
        launcher_options=launcher_options,
        retry_failed=running.retry_failed,
        accept_code=running.accept_code,
        replace=replacement.replace,
    )


def _dry_run(
    setup: StudySetup,
    axes: Sequence[str],
    running: RunningArguments,
    launcher_options: LauncherOptions,
    replace: Step | None,
) -> None:
    """Prints the table of trials, notes on them, and why the command itself would be refused because of existing
    results."""
    from experiments.dry_run.done import find_done
    from experiments.dry_run.notes import refusal_as_note, say_notes
    from experiments.dry_run.plan_table import Devices, plan_table
    from experiments.dry_run.trainable import check_launched
    from experiments.preparing.sources import check_entries
    from experiments.run_study import find_earlier, require_agreement
    from experiments.running.provenance import trial_closure

    study, given = setup.study, bool(setup.data)
    sweeps = plan_asked(study, axes)
    if given:
        check_entries(study, setup.data)
    each = check_launched(study, sweeps, launcher_options)
    if not study.for_accelerators:
        each *= launcher_options.cores_each()
    devices = Devices(each, launcher_options.at_once)
    done = find_done(setup, sweeps, running.retry_failed, running.accept_code)
    console.print(plan_table(study, sweeps, devices, given=given, trained=setup.tokenizer is None, done=done))
    say_notes(setup, sweeps, launcher_options)
    with refusal_as_note():
        earlier = find_earlier(setup, sweeps, replace)
        every = join_axes(study, setup.workspace.root, earlier.axes if earlier else (), axes)
        planned = plan_sweeps(study, tuple(every.values()))
        shown, asked = (unique_trials(some, done.provenance) for some in (planned, sweeps))
        require_agreement(setup.workspace, shown, asked, trial_closure(), running.accept_code)
