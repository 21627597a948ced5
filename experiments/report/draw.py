"""CSV, figures and page of a study, from the trials that are finished."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_pipelines.publishing.output_lock import backoff
from experiments.running.attempts import State, read_states
from experiments.running.ledger import FINISHED, Ledger
from experiments.running.trial import trial_id
from experiments.running.workspace import Busy, Record, Workspace, load_record
from experiments.sweeps.registry import AXES, KEPT, plan_sweeps
from experiments.sweeps.sweep import CONTROL, POINT, Sweep, control_of, reference_trial, titles, unique_trials
from experiments.terminal.progress import console, say, short, wrote
from experiments.terminal.words import few
from hma_jax.runtime.outputs import make_directory

if TYPE_CHECKING:
    from experiments.analysis.rows import Row
    from experiments.report.numbers import Numbers


def draw(workspace: Workspace, record: Record) -> None:
    """Writes CSV, figures and page from the trials that are finished, in one process at a time: others wait."""
    for pause in backoff():
        try:
            with workspace.locked(".report.lock"):
                _draw(workspace, record)
            return
        except Busy:
            time.sleep(pause)


def _draw(workspace: Workspace, record: Record) -> None:
    from experiments.analysis.best_steps import BestSteps, judge_at_best
    from experiments.analysis.changes import Change, find_changes, find_differences
    from experiments.analysis.growth import Growth, find_growth
    from experiments.analysis.optima import Optimum, find_optima
    from experiments.analysis.rows import collect, place_rows, read_rows, write_csv, write_rows
    from experiments.data_size import count_usable
    from experiments.report.fits import FitRow, fit_rows
    from experiments.report.numbers import compute_numbers, find_fewer, find_other_x
    from experiments.report.page import write_report
    from experiments.report.sweeps import AxisStatistics
    from experiments.report.validity import check_numbers

    provenance = record.provenance
    sweeps = plan_sweeps(record.study, record.axes, workspace.root)
    states = read_states(list(unique_trials(sweeps, provenance)), workspace.trials, Ledger(workspace.ledger))
    written, _ = place_rows(read_rows(workspace) if workspace.results.exists() else [], sweeps)
    numbers = compute_numbers(workspace, sweeps, provenance)
    write_rows(workspace, collect(sweeps, provenance, workspace.trials, states, numbers.results))
    rows = read_rows(workspace)  # figures show what is in the files
    checked = check_numbers(written, rows, numbers.results, numbers.windows, record.study.eval.perplexity_group)
    if checked.verdict == "bad":
        say(f"note: {checked.text}")
    available = count_usable(workspace.data_summary)
    if fewer := find_fewer(unique_trials(sweeps, provenance), numbers.results, available):
        say(
            f"note: trained on fewer trajectories than were asked for, since damaged ones are not replaced: {few(fewer)}"
        )
    if other := find_other_x(sweeps, provenance, numbers.results, available):
        say(f"note: x of the axis episodes is what the datasets have, not what was trained on: {few(other)}")
    draw_figures(workspace, sweeps, rows, numbers)
    write_csv(workspace.fits, FitRow, fit_rows(numbers.fits, numbers.isoflop))
    others = _write_tables(workspace, record, sweeps, states, numbers.results, available)
    tables = [workspace.results, workspace.robots, workspace.fits, *others]
    along = AxisStatistics(
        find_changes(sweeps, provenance, numbers.windows),
        judge_at_best(sweeps, provenance, numbers.windows),
        find_growth(sweeps, provenance, numbers.windows, numbers.results, available),
        find_differences(sweeps, provenance, numbers.windows),
        find_optima(rows, sweeps),
    )
    for path, kind, table_rows in (
        (workspace.changes, Change, along.changes),
        (workspace.best_steps, BestSteps, along.best),
        (workspace.growth, Growth, along.growth),
        (workspace.optima, Optimum, along.optima),
    ):
        if table_rows:
            write_csv(path, kind, table_rows)
            tables.append(path)
        else:
            path.unlink(missing_ok=True)  # figures of other trials, drawn before
    write_report(workspace, record, sweeps, rows, along, states, numbers, checked)
    wrote(*tables, workspace.figures, workspace.report)


def _write_tables(
    workspace: Workspace,
    record: Record,
    sweeps: Sequence[Sweep],
    states: Mapping[str, State],
    results: Mapping[str, dict[str, Any]],
    available: Mapping[str, int],
) -> list[Path]:
    """Writes trials.parquet and, if reference trials kept the numbers of their windows, controllability.csv on them and
    their controls."""
    from experiments.analysis.controllability import Controllability, controllability
    from experiments.analysis.rows import write_csv
    from experiments.analysis.tables import read_trials
    from experiments.analysis.trials import trial_row, write_trials
    from hma_jax.evaluation.windows import FILE

    provenance = record.provenance
    names, rows = titles(sweeps, provenance), []
    for id, trial in unique_trials(sweeps, provenance).items():
        state = states[id].event
        result = results[id] if state == FINISHED else None
        rows.append(trial_row(id, names[id], state, trial, provenance, result, available))
    write_trials(workspace.trial_table, rows)
    controllability_rows = []
    references = [reference_trial(record.study, seed) for seed in record.study.seeds]
    for role, trials in {POINT: references, CONTROL: [control_of(trial) for trial in references]}.items():
        ids = [trial_id(trial, provenance) for trial in trials]
        kept = [id for id in ids if (workspace.trials / id / FILE).exists()]
        seeds = {judged.seed: judged.windows for judged in read_trials(workspace.trials, kept).values()}
        controllability_rows += (
            controllability(dict(sorted(seeds.items())), role, rate=record.study.rate) if seeds else []
        )
    if not controllability_rows:
        workspace.controllability.unlink(missing_ok=True)  # from trials that are no longer the reference
        return [workspace.trial_table]
    write_csv(workspace.controllability, Controllability, controllability_rows)
    return [workspace.trial_table, workspace.controllability]


def draw_figures(
    workspace: Workspace, sweeps: Sequence[Sweep], rows: Sequence[Row], numbers: Numbers | None = None
) -> None:
    """A figure for each sweep, one for the scaling sweeps together, and figures of fits if `numbers` are given for
    them.

    Figures of axes that the study no longer has are removed.
    """
    from experiments.report.plot_fits import plot_fits, plot_isoflop
    from experiments.report.plots import plot_overview, plot_sweep

    workspace.figures.mkdir(exist_ok=True)
    own = [path.stem for path in (workspace.root / KEPT).glob("*.py")]
    for name in {*AXES, *own} - {sweep.name for sweep in sweeps}:
        (workspace.figures / f"{name}.png").unlink(missing_ok=True)
    for sweep in sweeps:
        plot_sweep(rows, sweep, workspace.figures / f"{sweep.name}.png")
    plot_overview(rows, [s for s in sweeps if s.single_curve], workspace.figures / "scaling.png")
    if numbers is not None:
        plot_fits(numbers.fits, numbers.outcomes, workspace.figures / "fits.png")
        plot_isoflop(numbers.isoflop, workspace.figures / "isoflop.png")


def draw_again(out: Path) -> None:
    """Draws the report of a study that ran before, without touching its data or trials.

    If its trials are missing, as in results that are kept for the record, only figures are drawn, from its table.
    """
    from experiments.analysis.rows import place_rows, read_rows

    workspace = Workspace(out.absolute())
    record = load_record(workspace)
    make_directory(workspace.root, option=None)
    if workspace.trials.exists() or not workspace.results.exists():
        draw(workspace, record)
        return
    sweeps = plan_sweeps(record.study, record.axes, workspace.root)
    rows, gone = place_rows(read_rows(workspace), sweeps)
    if gone:
        say(f"note: left out, since the study no longer has it: {few(gone)}")
    draw_figures(workspace, sweeps, rows)
    console.print(
        f"no trials in {short(workspace.root)}: figures are drawn from the existing table; the page is not changed"
    )
    wrote(workspace.figures)
