"""Tables of a study beside its CSV: its trials flat, and which robots its reference model follows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from experiments.analysis.controllability import Controllability, controllability
from experiments.analysis.rows import write_csv
from experiments.data_size import count_usable
from experiments.running.attempts import State
from experiments.running.ledger import FINISHED
from experiments.running.trial import trial_id
from experiments.running.workspace import Record, Workspace
from experiments.sweeps.sweep import CONTROL, POINT, Sweep, control_of, reference_trial, titles, unique_trials
from hma_jax.evaluation.windows import FILE


def write_tables(
    workspace: Workspace,
    record: Record,
    sweeps: Sequence[Sweep],
    states: Mapping[str, State],
    results: Mapping[str, dict[str, Any]],
) -> list[Path]:
    """Writes trials.parquet and, if reference trials kept the numbers of their windows, controllability.csv on them and
    their controls."""
    from experiments.analysis.tables import read_trials
    from experiments.analysis.trials import trial_row, write_trials

    provenance = record.provenance
    names, rows = titles(sweeps, provenance), []
    available = count_usable(workspace.data_summary)
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
