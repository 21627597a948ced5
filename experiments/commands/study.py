"""What the commands of `hma` do. The command line itself is in `cli`; heavy imports happen here.

Every command ends by saying what it wrote and what to run next.
"""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from data_pipelines.publishing.claims import pauses_between_looks
from experiments import (
    ablate_conditioning,
    ablate_settings,
    scale_datasets,
    scale_trajectories,
    scale_width,
    transfer_lr,
)
from experiments.preparing.made_from import Step, require_same
from experiments.program import command_line
from experiments.progress import SweepMonitor, console
from experiments.running.attempts import State, read_states
from experiments.running.closure import Closure
from experiments.running.launchers.registry import Launching
from experiments.running.ledger import FINISHED, Ledger
from experiments.running.runner import Job, run_missing
from experiments.setting import Setting, short
from experiments.study import Study
from experiments.sweep import Sweep, titles, unique_trials
from experiments.workspace import Busy, Record, Workspace, find_record, load_record, save_record
from hma_jax.config import ConfigError
from hma_jax.config.json import diff, to_dict

if TYPE_CHECKING:
    from experiments.rows import Row

AXES = {
    "datasets": scale_datasets.plan,
    "trajectories": scale_trajectories.plan,
    "width": scale_width.plan,
    "settings": ablate_settings.plan,
    "conditioning": ablate_conditioning.plan,
    "lr": transfer_lr.plan,
}
SCALING = ("datasets", "trajectories", "width")
"""What `hma study` runs."""


class TrialsFailed(Exception):
    """The sweep went on to its end, but some trials have no result."""


def dry_run(study: Study, axes: Sequence[str]) -> None:
    from experiments.cost import plan_table

    console.print(plan_table(study, [AXES[axis](study) for axis in axes]))


def run_study(
    setting: Setting,
    axes: Sequence[str],
    *,
    again: str,
    launcher: Launching,
    retry_failed: bool,
    accept_code: bool,
    replace: Step | None,
) -> None:
    """Prepares, runs what is missing, and draws the results. Raises TrialsFailed at the end.

    `again` is the command that tries failed trials once more. Raises ConfigError, before anything is done, if the
    directory holds another study, unless `replace` allows it, and before any trial, if one that is finished was
    changed, or if trials ran other sources than there are now and nobody accepts that.
    """
    from experiments.pipeline import prepare
    from experiments.preparing.suite import require_simulated
    from experiments.preparing.windows import require_judged, require_same_windows
    from experiments.running.provenance import trial_closure

    study, workspace = setting.study, setting.workspace
    if not setting.data:
        require_simulated(study.dataset_names(), "Give RLDS directories with --data, or add --dry-run to see the plan")
    sweeps, sources = [AXES[axis](study) for axis in axes], trial_closure()  # a later change is refused by the trials
    with workspace.claimed():
        require_same_windows(study, workspace, replace)
        earlier = find_earlier(workspace, study, replace)
        provenance = prepare(study, workspace, setting.data, setting.tokenizer, replace=replace)
        require_judged(study, workspace, {name for sweep in sweeps for name in sweep.scope})
        if earlier and earlier.provenance and (changes := diff(earlier.provenance, provenance)):
            what = f"note: changed since the last run here: {'; '.join(changes)}. Trials depend on it and run again"
            console.print(what, markup=False, soft_wrap=True)
        all_axes = tuple(dict.fromkeys([*(earlier.axes if earlier else ()), *axes]))
        record = Record(study, setting.data, all_axes, command_line(), provenance)
        trials = unique_trials(sweeps, provenance)
        require_agreement(workspace, record, trials, sources, accept_code)
        save_record(workspace, record)
        common = {"provenance": to_dict(provenance), "execution": to_dict(study.execution), "code": sources}
        # The widest take longest: first, so that no worker is left with one at the end.
        ordered = sorted(trials.items(), key=lambda item: -item[1].model.width)
        names = titles(sweeps, provenance)
        jobs = [Job(id, names[id], {"trial": to_dict(trial), **common}) for id, trial in ordered]
        states = run_jobs(jobs, workspace, launcher, retry_failed)
        draw(workspace, record)
    complain(jobs, states, again)


def require_agreement(
    workspace: Workspace, record: Record, asked: Collection[str], sources: Closure, accept_code: bool
) -> None:
    """Raises ConfigError if a finished trial of the study is not what it was, or if its trials, with those to be run
    of the ids that are `asked` for, ran different sources and nobody accepts that."""
    from experiments.running.agreement import check_finished, require_one_closure
    from experiments.running.sealed import RESULT

    shown = unique_trials([AXES[axis](record.study) for axis in record.axes], record.provenance)
    check_finished(workspace.trials, shown)
    complete = all((workspace.trials / id / RESULT).exists() for id in asked)
    require_one_closure(workspace.trials, shown, None if complete else sources, accept_code)


def find_earlier(workspace: Workspace, study: Study, replace: Step | None) -> Record | None:
    """What was run here before, if `study` goes on with it: its axes then have the same trials under both.

    Raises ConfigError for a study of other settings, unless `replace` allows it: its report would be drawn over.
    """
    try:
        earlier = find_record(workspace)
        lines = []
        if earlier and any(AXES[axis](earlier.study) != AXES[axis](study) for axis in earlier.axes):
            lines = diff(earlier.study, study)
    except ConfigError as error:  # it cannot be read
        earlier, lines = None, [str(error)]
    require_same("study", workspace.record, lines, replace)
    return None if lines else earlier


def run_jobs(
    jobs: Sequence[Job], workspace: Workspace, launching: Launching, retry_failed: bool
) -> dict[str, State]:
    """Runs what is missing, visibly."""
    ledger = Ledger(workspace.ledger)
    before = read_states([job.id for job in jobs], workspace.trials, ledger)
    kept = sum(state.event == FINISHED for state in before.values())
    if kept:
        console.print(f"{kept} of {len(jobs)} trials are finished already")
    if kept == len(jobs):
        return before
    with launching.launcher(workspace.root) as launcher, SweepMonitor(len(jobs), kept) as monitor:
        return run_missing(
            jobs, workspace.trials, ledger, launcher, retry_failed=retry_failed, monitor=monitor
        )


def draw(workspace: Workspace, record: Record) -> None:
    """CSV, figures and page from whatever trials are finished, by one process at a time: others wait."""
    for pause in pauses_between_looks():
        try:
            with workspace.claimed(".report.lock"):
                _draw(workspace, record)
            return
        except Busy:
            time.sleep(pause)


def _draw(workspace: Workspace, record: Record) -> None:
    from experiments.optima import Optimum, find_optima
    from experiments.report.page import write_report
    from experiments.rows import Row, collect, read_csv, write_csv

    provenance = record.provenance
    if provenance is None:
        raise ConfigError(f"the study in {workspace.root} has not run yet; run `{record.command}`")
    sweeps = [AXES[axis](record.study) for axis in record.axes]
    states = read_states(list(unique_trials(sweeps, provenance)), workspace.trials, Ledger(workspace.ledger))
    write_csv(workspace.results, Row, collect(sweeps, provenance, workspace.trials, states))
    rows = read_csv(workspace.results)  # figures show what the file says
    draw_figures(workspace, sweeps, rows)
    tables = [workspace.results]
    optima = find_optima(rows, sweeps)
    if optima:
        write_csv(workspace.optima, Optimum, optima)
        tables.append(workspace.optima)
    write_report(workspace, record, sweeps, rows, optima, states, provenance)
    wrote(*tables, workspace.figures, workspace.report)


def draw_figures(workspace: Workspace, sweeps: Sequence[Sweep], rows: Sequence[Row]) -> None:
    """A figure for each sweep, and one of the scaling ones together."""
    from experiments.report.plots import plot_overview, plot_sweep

    workspace.figures.mkdir(exist_ok=True)
    for sweep in sweeps:
        plot_sweep(rows, sweep, workspace.figures / f"{sweep.name}.png")
    plot_overview(rows, [s for s in sweeps if s.scaling], workspace.figures / "scaling.png")


def complain(jobs: Sequence[Job], states: dict[str, State], again: str) -> None:
    """Raises TrialsFailed, naming every trial without a result, and the command that tries them again."""
    bad = [(job, states[job.id]) for job in jobs if states[job.id].event != FINISHED]
    if bad:
        lines = "\n".join(f"  {s.event}: {job.title}: {s.message}" for job, s in bad)
        raise TrialsFailed(f"{len(bad)} of {len(jobs)} trials have no result:\n{lines}\nTo try them again: {again}")


def wrote(*paths: Path, then: str = "") -> None:
    """Says what was written, and the whole command that comes `then`."""
    for path in paths:
        console.print("wrote", Text(short(path), "bold"), soft_wrap=True)
    if then:
        console.print(Text(f"next: {then}"), soft_wrap=True)


# --- Single steps ----------------------------------------------------------------------------


def write_suite(setting: Setting, replace: Step | None) -> None:
    from experiments.preparing.suite import make_suite

    with setting.workspace.claimed():
        make_suite(setting.study, setting.workspace, replace)
    wrote(setting.workspace.suite, then=setting.command("tokenizer train"))


def train_tokenizer(setting: Setting, replace: Step | None) -> None:
    from experiments.preparing.sources import find_sources
    from experiments.preparing.suite import make_suite
    from experiments.preparing.tokenizer import make_tokenizer

    study, workspace = setting.study, setting.workspace
    with workspace.claimed():
        sources = find_sources(study, setting.data) if setting.data else make_suite(study, workspace, replace)
        make_tokenizer(study, workspace, sources, replace)
    wrote(workspace.tokenizer, then=setting.command("tokenize"))


def draw_again(out: Path) -> None:
    """Report of a study that ran before, without touching its data or trials.

    Where its trials are not, as with results that are kept for the record, its figures are drawn from its table,
    and table and page stay as they are.
    """
    from experiments.rows import read_csv

    workspace = Workspace(out.absolute())
    record = load_record(workspace)
    if workspace.trials.exists() or not workspace.results.exists():
        draw(workspace, record)
        return
    sweeps = [AXES[axis](record.study) for axis in record.axes]
    draw_figures(workspace, sweeps, read_csv(workspace.results))
    console.print(f"no trials in {short(workspace.root)}: drawn from its table, as it is; the page stays as it is")
    wrote(workspace.figures)
