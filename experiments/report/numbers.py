"""The inputs of a study's report: results and per-window numbers of its finished trials, fits and predictions."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from experiments.analysis.fits import DRAWS
from experiments.analysis.isoflop import IsoFlop
from experiments.analysis.predictions import Outcome, compare, load_predictions
from experiments.analysis.scaling import CurveFit, curves_of, fit_budgets, fit_study
from experiments.running.attempts import RESULT
from experiments.running.provenance import Provenance
from experiments.running.result_file import read_result
from experiments.running.trial import Trial, trajectories_of, trial_id
from experiments.running.workspace import Workspace, load_record
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import Sweep, unique_trials
from hma_jax.config.json import stable_hash
from hma_jax.evaluation.windows import FILE, WindowTable


@dataclass(frozen=True)
class Numbers:
    results: Mapping[str, dict[str, Any]]  # results of finished trials, by id
    windows: Mapping[str, WindowTable]  # windows of trials that kept them
    fits: Sequence[CurveFit]
    isoflop: IsoFlop | None
    outcomes: Sequence[Outcome]


def read_results(workspace: Workspace, ids: Iterable[str]) -> tuple[dict[str, dict[str, Any]], dict[str, WindowTable]]:
    """Results and windows of those of the trials `ids` that are finished. Raises ConfigError for one that was
    changed."""
    finished = [id for id in ids if (workspace.trials / id / RESULT).exists()]
    results = {id: read_result(workspace.trials / id) for id in finished}
    windows = {
        id: WindowTable.load(workspace.trials / id / FILE) for id in finished if (workspace.trials / id / FILE).exists()
    }
    return results, windows


def result_hashes(results: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """The hash with which each result is sealed."""
    return {id: stable_hash(result) for id, result in results.items()}


def compute_numbers(
    workspace: Workspace, sweeps: Sequence[Sweep], provenance: Provenance, draws: int = DRAWS
) -> Numbers:
    """Raises ConfigError for a trial or a prediction that was changed."""
    results, windows = read_results(workspace, unique_trials(sweeps, provenance))
    flops = {id: float(result["train_flops"]) for id, result in results.items()}
    isoflop = fit_budgets(sweeps, provenance, windows, flops, draws)
    hashes, curves = result_hashes(results), curves_of(sweeps, provenance)
    predictions = load_predictions(workspace.predictions).values()
    outcomes = [compare(p, curves, windows, hashes) for p in predictions]
    return Numbers(results, windows, fit_study(sweeps, provenance, windows, draws), isoflop, outcomes)


def find_fewer(trials: Mapping[str, Trial], results: Mapping[str, Any], available: Mapping[str, int]) -> list[str]:
    """In words, the subsets of which finished trials found only a part, since other episodes were skipped when
    tokenising."""
    found = []
    for id, trial in trials.items():
        asked, used = trajectories_of(trial, available), trajectories_of(trial, available, results.get(id))
        short = [name for name in asked if used.get(name, asked[name]) < asked[name]]
        found += [f"{used[name]} of {asked[name]} of {name} (seed {trial.train.seed})" for name in short]
    return list(dict.fromkeys(found))


def find_other_x(
    sweeps: Sequence[Sweep], provenance: Provenance, results: Mapping[str, Any], available: Mapping[str, int]
) -> list[str]:
    """In words, points of the axis `episodes` whose finished trials were trained on a number of trajectories other than
    x."""
    found = []
    for p in (p for sweep in sweeps if sweep.name == "episodes" for p in sweep.points):
        result = results.get(trial_id(p.trial, provenance), {})
        used = sum(trajectories_of(p.trial, available, result).values())
        if "trajectories" in result and used != p.x:
            found.append(f"{used} at x = {p.x:g} (seed {p.trial.train.seed})")
    return list(dict.fromkeys(found))


def read_numbers(workspace: Workspace, draws: int = DRAWS) -> Numbers:
    """The numbers of the study in `workspace`. Raises ConfigError if there is no study."""
    record = load_record(workspace)
    sweeps = plan_sweeps(record.study, record.axes, workspace.root)
    return compute_numbers(workspace, sweeps, record.provenance, draws)
