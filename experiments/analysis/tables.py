"""Per-window numbers of finished trials, read from their directories."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.analysis.compare import Side
from experiments.preparing.evaluation_stamp import NOISING_STEPS, STAMP
from experiments.preparing.made_from import read_stamp
from experiments.running.attempts import RESULT
from experiments.running.job import trial_in
from experiments.running.provenance import Provenance
from experiments.running.result_file import read_result
from experiments.running.trial import Trial, trial_id
from experiments.running.workspace import Workspace, load_record
from experiments.sweeps.sweep import reference_trial
from hma_jax.config import ConfigError
from hma_jax.evaluation.windows import FILE, WindowTable
from hma_jax.training.run_lock import CHECKPOINTS


@dataclass(frozen=True)
class FinishedTrial:
    """A finished trial, its identity, and every window's numbers."""

    id: str
    trial: Trial
    provenance: Provenance
    windows: WindowTable

    @property
    def seed(self) -> int:
        return self.trial.train.seed


def read_trial(directory: Path) -> FinishedTrial:
    """Raises ConfigError for a trial that is not finished, was changed, or kept no numbers of its windows."""
    if not (directory / RESULT).exists():
        raise ConfigError(f"{directory}: not a finished trial (it has no {RESULT})")
    read_result(directory)  # checks that its files are those with which it was sealed
    windows = WindowTable.load(directory / FILE)
    return FinishedTrial(directory.name, *trial_in(directory), windows)


def read_trials(trials: str | Path, ids: Iterable[str] | None = None) -> dict[str, FinishedTrial]:
    """The finished ones among `ids` (None: all in the directory), by id and sorted by it. Raises ConfigError."""
    trials = Path(trials)
    chosen = [p.name for p in trials.iterdir()] if ids is None else ids
    return {id: read_trial(trials / id) for id in sorted(chosen) if (trials / id / RESULT).exists()}


def read_side(path: str | Path) -> Side:
    """One side of `hma compare`: a study (its reference trials, by seed), a finished trial, or an evaluated model.

    Raises ConfigError if it is none of these, or if its trials have no result.
    """
    path = Path(path).resolve()  # a trial's directory bears its id; '.' and links do not
    workspace = Workspace(path)
    if workspace.record.exists():
        record = load_record(workspace)
        ids = {s: trial_id(reference_trial(record.study, s), record.provenance) for s in record.study.seeds}
        found = read_trials(workspace.trials, ids.values()) if workspace.trials.is_dir() else {}
        seeds = {seed: found[id].windows for seed, id in ids.items() if id in found}
        if not seeds:
            raise ConfigError(
                f"{path}: no reference trial of this study ({', '.join(ids.values())}) is finished here, whose windows "
                f"could be compared. Copy it to {workspace.trials} from where the study ran, run `{record.command}`, or "
                "name two trials; most studies in experiments/results are kept without their trials"
            )
        trial = reference_trial(record.study, record.study.seeds[0])
        return Side(path.name, seeds, record.provenance.tokenizer, of_study=True, **_steps_of(trial))
    if (path / RESULT).exists():
        judged = read_trial(path)
        windows = {judged.seed: judged.windows}
        return Side(path.name, windows, judged.provenance.tokenizer, **_steps_of(judged.trial))
    if (path / FILE).exists():
        tokenizer, recorded = _said_of(path)
        seed, numbers = recorded.get("seed"), ("step", "steps", NOISING_STEPS)
        windows = {seed or 0: WindowTable.load(path / FILE)}
        steps = {name: recorded[name] for name in numbers if name in recorded}
        return Side(path.name, windows, tokenizer, says_seed=seed is not None, **steps)
    raise ConfigError(f"{path}: neither a study, nor a finished trial, nor an evaluated model (no {FILE})")


def _steps_of(trial: Trial) -> dict[str, int]:
    """The numbers of steps that a `Side` has of a finished trial."""
    noising = trial.model.diffusion.steps if trial.model.diffusion else 0
    return {"step": trial.train.steps, "steps": trial.train.steps, "noising_steps": noising}


def _said_of(run: Path) -> tuple[str, dict[str, Any]]:
    """The identity of the tokenizer on whose tokens a model was evaluated, and the seed and numbers of steps of its
    training, from the stamp of `hma evaluate`, or else the seed from the run's latest checkpoint; "" and nothing if
    neither says it."""
    from hma_jax.training.reading import list_steps, read_description

    if (stamp := read_stamp(run, STAMP)) is not None:
        return stamp.inputs.get("tokenizer", ""), stamp.recorded
    steps = list_steps(run / CHECKPOINTS)
    described = read_description(run / CHECKPOINTS / str(steps[-1])) if steps else {}
    provenance = described.get("provenance", {})
    return provenance.get("tokenizer", ""), {"seed": described["train"]["seed"]} if "loader" in provenance else {}
