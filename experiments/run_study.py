"""A study from its data to its page: what is missing is prepared and run, then everything is drawn."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from data_pipelines.registry import DatasetSpec, find_spec, register
from experiments.preparing.made_from import Change, Step
from experiments.presets import get_preset
from experiments.report.draw import draw
from experiments.running.attempts import RESULT, RUN, State, newest_step, read_states
from experiments.running.children import require_accelerator
from experiments.running.closure import Closure
from experiments.running.launchers.base import Launcher
from experiments.running.launchers.registry import LauncherOptions
from experiments.running.ledger import DIVERGED, FINISHED, MISSING, PREEMPTED, REFUSED, Ledger
from experiments.running.monitor import SweepMonitor
from experiments.running.provenance import Provenance, trial_closure
from experiments.running.runner import Job, run_missing
from experiments.running.shared_runs import latest_common, share_runs
from experiments.running.slots import find_accelerators
from experiments.running.subprocess_call import call_in_subprocess
from experiments.running.trained import find_trained
from experiments.running.trial import Trial, trial_id
from experiments.running.workspace import LOCK, Record, Workspace, find_record, save_record
from experiments.study import Study
from experiments.study_setup import StudySetup, count_again
from experiments.sweeps.registry import is_file, join_axes, keep_axes, plan_asked, plan_sweeps
from experiments.sweeps.sweep import Sweep, all_judged, titles, unique_trials
from experiments.terminal.exit_code import TrialsFailed
from experiments.terminal.program import PROGRAM
from experiments.terminal.progress import console, say, short
from experiments.terminal.words import few
from hma_jax.config import ConfigError
from hma_jax.config.json import diff, to_dict
from hma_jax.runtime.exits import Exit
from hma_jax.runtime.files import write_file
from hma_jax.runtime.locks import EXPIRES, Lock, find_held, machine

POLL_SECONDS = 1.0
"""Seconds between two checks of whether a lease is over."""


def run_study(
    setup: StudySetup,
    axes: Sequence[str],
    *,
    again: str,
    launcher_options: LauncherOptions,
    retry_failed: bool,
    accept_code: bool,
    replace: Step | None,
) -> None:
    """Prepares, runs what is missing, and draws the results. Raises TrialsFailed at the end.

    `again` is the command that tries failed trials once more. Raises ConfigError, before anything is done, if the
    directory holds another study (unless `replace` allows it) or expectations that cannot be read; and, before any
    trial runs, if a finished trial was changed, or if trials ran sources other than the present ones and `accept_code`
    is not given.
    """
    from experiments.dry_run.notes import say_notes
    from experiments.dry_run.trainable import require_trainable
    from experiments.preparing.suite import require_simulated
    from experiments.preparing.windows import require_judged

    study, workspace = setup.study, setup.workspace
    if not setup.data:
        require_simulated(study.all_names(), "Give RLDS directories with --data, or add --dry-run to see the plan")
    sweeps = plan_asked(study, axes)
    sources = trial_closure()  # trials refuse to run if the sources change later
    require_trainable(study, sweeps, launcher_options)
    say_notes(setup, sweeps, launcher_options)
    await_lease(workspace)
    # The launcher comes first: without it every trial would fail, after everything was prepared.
    with launcher_options.launcher(workspace.root) as launcher, workspace.locked() as lock:
        earlier = find_earlier(setup, sweeps, replace)
        every = join_axes(study, workspace.root, earlier.axes if earlier else (), axes)
        planned = plan_sweeps(study, tuple(every.values()))
        say_unplanned(workspace, planned)
        provenance = prepare_apart(setup, replace)
        if setup.data:
            study = _count_again(setup, sweeps)
            sweeps, planned = plan_asked(study, axes), plan_sweeps(study, tuple(every.values()))
        require_judged(study, workspace, all_judged(sweeps))
        if earlier and (changes := diff(earlier.provenance, provenance)):
            say(f"note: changed since the last run here: {'; '.join(changes)}. The trials that depend on it run again")
        shown = unique_trials(planned, provenance)
        trials = unique_trials(sweeps, provenance)
        require_agreement(workspace, shown, trials, sources, accept_code)
        kept = keep_axes(every, workspace.root)
        if setup.arguments.registry:  # some axes are planned with its entries
            write_file(workspace.registry, setup.arguments.registry.read_bytes())
        else:  # it may be left from a study that this one replaces
            workspace.registry.unlink(missing_ok=True)
        record = Record(study, setup.data, kept, whole_command(setup, kept), provenance=provenance)
        save_record(workspace, record)
        common = {"provenance": to_dict(provenance), "execution": to_dict(study.execution), "code": sources}
        former = find_trained(workspace.trials, trials, provenance, None if accept_code else sources)
        jobs = make_jobs(trials, titles(sweeps, provenance), provenance, common, former)
        say_trained(jobs, former, workspace)
        states = run_jobs(jobs, workspace, launcher, lock, retry_failed)
        draw(workspace, record)
    require_results(jobs, states, again, accept_code)


def _count_again(setup: StudySetup, sweeps: Sequence[Sweep]) -> Study:
    """The study that its tokens allow, once they are made. Prints which points of `sweeps` it no longer has."""
    from experiments.dry_run.notes import say_points

    counted = count_again(setup)
    if counted.study != setup.study:
        say_points(counted, sweeps)
    return counted.study


def await_lease(workspace: Workspace) -> None:
    """Waits while the directory is held by another machine, or by this one from before it was rebooted: until the lease
    is over, or is renewed, which shows that its command still runs. So a study may be started when its machine
    boots."""
    lock, renewed = workspace.root / LOCK, 0.0
    while (holder := workspace.holder) and holder.machine != machine() and find_held(lock):
        time_renewed = lock.stat().st_mtime
        if not renewed:
            say(
                f"{workspace.root} was in use by {holder}; waiting {EXPIRES / 60:.0f} minutes at most to see whether it "
                "still runs"
            )
            renewed = time_renewed
        if time_renewed != renewed:
            return
        time.sleep(POLL_SECONDS)


def say_unplanned(workspace: Workspace, planned: Sequence[Sweep]) -> None:
    """Names the user's preregistered predictions for points that are in none of the `planned` sweeps, which are all
    sweeps of the study.

    Raises ConfigError, as the page at the end would, for a line that cannot be read.
    """
    from experiments.analysis.preregistered import FILE, find_unplanned, read_expected

    path = workspace.predictions / FILE
    if lines := find_unplanned(read_expected(path), planned):
        say(
            f"note: {path.name} predicts points that this study does not plan, so these predictions stay open: "
            f"{few(lines)}"
        )


def prepare_apart(setup: StudySetup, replace: Step | None) -> Provenance:
    """Prepares the study. If there are accelerators, this happens in a process of its own: JAX reserves them for the
    process in which it computes, and the trials need them."""
    accelerators = find_accelerators()
    if accelerators is None:
        return _prepare(setup, replace)

    specs = [find_spec(name) for name in setup.study.all_names()]
    own = [spec for spec in specs if spec is not None]
    return call_in_subprocess("prepares the data", _prepare, setup, replace, own, accelerators.kind)


def _prepare(
    setup: StudySetup, replace: Step | None, specs: Sequence[DatasetSpec] = (), accelerator: str = ""
) -> Provenance:
    """`specs`: registry entries, since a new process lacks the user's own; `accelerator`: the expected kind."""
    require_accelerator(accelerator)
    from experiments.preparing.pipeline import prepare

    register(specs)
    return prepare(setup.study, setup.workspace, setup.data, setup.tokenizer, replace=replace)


def make_jobs(
    trials: dict[str, Trial],
    names: dict[str, str],
    provenance: Provenance,
    common: dict[str, Any],
    former: Mapping[str, Trial] = {},
) -> list[Job]:
    """A job for every trial, the widest and longest first, so that none of these is left running alone at the end. A
    trial waits for the shorter ones that share the beginning of its training, and for its source. Training that it
    shares with `former` trials is not repeated."""
    shared = share_runs(trials, former)
    jobs = []
    for id, trial in sorted(trials.items(), key=lambda item: (-item[1].model.width, -item[1].train.steps)):
        record = {"trial": to_dict(trial), **common, "shared": to_dict(shared[id])}
        sources = {trial_id(other, provenance) for other in trial.with_source()[:-1]}
        jobs.append(Job(id, names[id], record, after=frozenset(sources | {other for other, _ in shared[id].before})))
    return jobs


def say_trained(jobs: Sequence[Job], former: Collection[str], workspace: Workspace) -> None:
    """Prints how many of the trials to be run begin from a checkpoint of `former` ones."""
    missing = [job for job in jobs if not (workspace.trials / job.id / RESULT).exists()]
    count = 0
    for job in missing:
        before = [(id, step) for id, step in job.record["shared"]["before"] if id in former]
        begun = newest_step(workspace.trials / job.id / RUN)
        count += not begun and latest_common(workspace.trials, before)[1] > 0
    if count:
        what = "go on from checkpoints that were trained here for other trials"
        console.print(f"{count} of {len(missing)} trials to be run {what}")


def whole_command(setup: StudySetup, axes: Sequence[str]) -> str:
    """The command line that runs all `axes` of the study anew, whichever commands ran them; files of axes are relative
    to its directory."""
    paths = [short(setup.workspace.root / axis) if is_file(axis) else axis for axis in axes]
    settings = [one for one in setup.arguments.set if one.partition("=")[0].strip() != "axes"]
    if tuple(axes) != get_preset(setup.arguments.preset).axes:
        settings.append(f"axes={','.join(paths)}")
    return dataclasses.replace(setup, arguments=dataclasses.replace(setup.arguments, set=tuple(settings))).command(
        "study"
    )


def require_agreement(
    workspace: Workspace, shown: Collection[str], requested: Collection[str], sources: Closure, accept_code: bool
) -> None:
    """Raises ConfigError if a finished trial was changed, or if the finished trials, and those of `requested` that are
    still to be run, have different sources and `accept_code` is not given. `shown`: ids of all trials of the study;
    `requested`: ids."""
    from experiments.running.trial_checks import check_finished, require_one_closure

    check_finished(workspace.trials, shown)
    complete = all((workspace.trials / id / RESULT).exists() for id in requested)
    require_one_closure(workspace.trials, shown, None if complete else sources, accept_code)


def find_earlier(setup: StudySetup, asked: Sequence[Sweep], replace: Step | None) -> Record | None:
    """The record of what was run here before, if the study continues it: its axes then have the same trials under both.
    If the study is replaced: the record with only those axes that still have the same trials or are `asked` for again.

    Raises ConfigError, unless `replace` allows it, for an earlier study with other settings, whose report would be
    overwritten, or with other data; and for what `require_preparable` refuses.
    """
    from experiments.preparing.changes import require_preparable

    study, workspace = setup.study, setup.workspace
    earlier, lines = None, []
    try:
        earlier = find_record(workspace)
        if earlier is not None:
            before, now = (plan_sweeps(s, earlier.axes, workspace.root) for s in (earlier.study, study))
            lines = diff(earlier.study, study) if before != now else []
    except ConfigError as error:  # it cannot be read, or one of its axes does not fit
        earlier, lines = None, [str(error)]
    changed = Change("study", workspace.record, lines)
    require_preparable(study, workspace, setup.data, setup.tokenizer, replace, [changed])
    if earlier is None or not lines:
        return earlier
    names = [sweep.name for sweep in asked]
    other = {axis: old.name for axis, old, new in zip(earlier.axes, before, now, strict=True) if old != new}
    gone = [axis for axis, name in other.items() if name not in names]
    if gone:
        paths = [short(workspace.root / axis) if is_file(axis) else axis for axis in gone]
        say(
            f"note: the page will leave out axes that ran with other settings: {few(paths)}. To have one again, run "
            f"`{PROGRAM} sweep` for it with these settings"
        )
    return dataclasses.replace(earlier, axes=tuple(axis for axis in earlier.axes if axis not in gone))


def run_jobs(
    jobs: Sequence[Job], workspace: Workspace, launcher: Launcher, lock: Lock, retry_failed: bool
) -> dict[str, State]:
    """Runs the trials that are missing, and shows their progress."""
    ledger = Ledger(workspace.ledger)
    before = read_states([job.id for job in jobs], workspace.trials, ledger)
    kept = sum(state.event == FINISHED for state in before.values())
    if kept:
        console.print(f"{kept} of {len(jobs)} trials are finished already")
    if kept == len(jobs):
        return before
    with SweepMonitor(len(jobs), kept) as monitor:
        return run_missing(
            jobs, workspace.trials, ledger, launcher, lost=lock.lost, retry_failed=retry_failed, monitor=monitor
        )


def require_results(jobs: Sequence[Job], states: dict[str, State], again: str, accept_code: bool) -> None:
    """Raises TrialsFailed, naming every trial without a result and the command that tries them again: `again`, with
    --accept-code if changed code stopped the sweep. That command leaves diverged trials as they are."""
    bad = [(job, states[job.id]) for job in jobs if states[job.id].event != FINISHED]
    if not bad:
        return
    diverged = sum(state.event == DIVERGED for _, state in bad)
    refused = [state for _, state in bad if state.event == REFUSED]
    words = [f"{len(bad)} of {len(jobs)} trials have no result:"]
    words += [f"  {_without_result(job, state, bool(refused))}" for job, state in bad]
    if diverged:
        words.append(
            f"{diverged} diverged, which is final: from the same seed they would diverge again. The report shows it"
        )
    if len(bad) > diverged:
        how = "To try the others again" if diverged else "To try them again"
        if any("--accept-code" in state.message for state in refused) and not accept_code:  # not for its data
            how, again = f"{how}, if the change of the sources alters no result", f"{again} --accept-code"
        words.append(f"{how}: {again}")
    raise TrialsFailed("\n".join(words), Exit.DIVERGED if len(bad) == diverged else Exit.FAILED)


def _without_result(job: Job, state: State, refused: bool) -> str:
    """A trial, its state and the reason. `refused`: another trial was refused, after which the runner starts no
    more."""
    why = state.message
    if not why and refused and state.event in (MISSING, PREEMPTED):
        why = "not started, because another trial was refused"
    return ": ".join(filter(None, (state.event, job.title, why)))
