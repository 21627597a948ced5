"""Checks that each trial of a study is the trial that its name says, and that all ran the same sources."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from experiments.running.attempts import JOB, RESULT, RUN
from experiments.running.closure import Closure, changed, closure_hash
from experiments.running.job import trial_in
from experiments.running.provenance import CodeChanged, read_record
from experiments.running.result_file import read_result
from experiments.running.trial import trial_id
from experiments.terminal.words import counted, few
from hma_jax.config import require
from hma_jax.training.run_lock import CHECKPOINTS


@dataclass
class Sources:
    """Trials that ran the same sources."""

    code: str  # hash of the closure of the first of them
    modules: dict[str, str]  # of all of them, by name
    trials: list[str]
    commits: list[str]


def check_finished(trials: Path, ids: Iterable[str]) -> None:
    """Raises ConfigError if a trial that has a result is incomplete, or is not the one that its name says.

    The trial may have run here or have been copied from anywhere.
    """
    for id in ids:
        directory = trials / id
        if (directory / RESULT).exists():
            read_result(directory)
            actual_id = trial_id(*trial_in(directory))
            require(
                actual_id == id,
                f"{directory}: its {JOB} describes trial {actual_id}: it was renamed or edited. Remove the directory "
                "to run the trial again",
            )


def group_by_sources(trials: Path, ids: Iterable[str]) -> list[Sources]:
    """The trials that began, grouped by the sources that they ran; a trial that continued under other sources is in
    several groups."""
    groups: list[Sources] = []
    for id in ids:
        record = read_record(trials / id)
        if record is not None and _began(trials / id):
            for code, modules in record.sources().items():
                commits = {start.machine.get("commit", "") for start in record.starts if start.code == code}
                _join(groups, Sources(code, modules, [id], sorted(commits - {""})))
    return groups


def require_one_closure(trials: Path, ids: Iterable[str], now: Closure | None, accept: bool) -> None:
    """Raises CodeChanged, unless the user accepts it, if trials ran different sources from each other or from those of
    `now` (None: no trial is to be run)."""
    groups = group_by_sources(trials, ids)
    if now is not None and not any(not changed(group.modules, now) for group in groups):
        groups.append(Sources(closure_hash(now), dict(now), [], []))
    if len(groups) > 1 and not accept:
        raise CodeChanged(
            "this study would contain trials that ran different versions of the code:\n  "
            + "\n  ".join(describe(groups))
            + (
                "\nNothing was run. CHANGELOG.md says what has to be made again after an update. If the change alters no "
                "result, add --accept-code: the report then says how many versions ran. If it does and is your own, raise "
                "RESULTS_VERSION (experiments/running/results_version.py): trials of the earlier version then run "
                "again. Or go back to the earlier code"
            )
        )


def describe(groups: list[Sources]) -> list[str]:
    """A line for each group; from the second on, what differs from the first."""
    lines = []
    for group in groups:
        count = counted(len(group.trials), "trial") if group.trials else "to be run"
        where = f" (commit {', '.join(group.commits)})" if group.commits else ""
        names = changed(groups[0].modules, group.modules)
        differs = f"; differs in {few(names)}" if names else ""
        lines.append(f"{group.code}: {count}{where}{differs}")
    return lines


def _began(directory: Path) -> bool:
    """Whether any computed result is kept."""
    return (directory / RESULT).exists() or any((directory / RUN / CHECKPOINTS).glob("*"))


def _join(groups: list[Sources], one: Sources) -> None:
    """Adds the sources of one trial to the first group in which none of its modules has another hash."""
    group = next((group for group in groups if not changed(group.modules, one.modules)), None)
    if group is None:
        groups.append(one)
        return
    group.modules |= one.modules
    group.trials += [id for id in one.trials if id not in group.trials]
    group.commits += [commit for commit in one.commits if commit not in group.commits]
