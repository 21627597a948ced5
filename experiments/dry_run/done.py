"""Which parts of a study exist already, for dry runs: prepared data, finished trials, and progress of unfinished ones.

Nothing is made and no data are read, so a dataset that has been changed since is not noticed here: the study's own
command refuses it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from data_pipelines.errors import DataError
from experiments.preparing.changes import find_changes
from experiments.preparing.made_from import Step
from experiments.preparing.suite import suite_is_there
from experiments.preparing.windows import windows_are_frozen
from experiments.running.attempts import RESULT, RUN, newest_step, read_states
from experiments.running.ledger import DIVERGED, FAILED, FINISHED, Ledger
from experiments.running.provenance import Provenance, trial_closure
from experiments.running.results_version import RESULTS_VERSION
from experiments.running.shared_runs import latest_common, share_runs
from experiments.running.trained import find_trained
from experiments.running.trial import Trial
from experiments.running.workspace import Workspace, find_record
from experiments.study import Study
from experiments.study_setup import StudySetup
from experiments.sweeps.sweep import Sweep, unique_trials
from hma_jax.config import ConfigError

UNKNOWN = Provenance("", "", "")
"""A placeholder where the provenance is unknown and only the trials' own fields matter."""


@dataclass(frozen=True)
class Done:
    """Trials are named by what they hold and their `provenance`."""

    suite: bool = False
    tokenizer: bool = False
    tokens: bool = False  # tokens and the evaluation windows
    provenance: Provenance = UNKNOWN
    finished: frozenset[str] = frozenset()
    left: Mapping[str, str] = field(default_factory=dict)  # how trials ended that are not run again
    steps: Mapping[str, int] = field(default_factory=dict)  # steps of unfinished trials: made, or taken from others
    other: int = 0  # finished trials whose data will be replaced


NOTHING = Done()


def find_done(
    setup: StudySetup, sweeps: Sequence[Sweep], retry_failed: bool = False, accept_code: bool = False
) -> Done:
    """What exists of the trials of `sweeps` in the study's directory; nothing if the directory holds another study.

    `retry_failed`: trials that failed are run again; `accept_code`: they may continue from what other sources trained.
    Raises ConfigError for a damaged ledger.
    """
    study, workspace = setup.study, setup.workspace
    try:
        record = find_record(workspace)
    except ConfigError:  # it cannot be read, which the study's own command reports
        return NOTHING
    other = record is not None and _prepared_by(record.study) != _prepared_by(study)
    done = NOTHING if other else find_prepared(setup)
    if record is None:
        return done
    if other or _changed(setup):
        return dataclasses.replace(done, other=len(list(workspace.trials.glob(f"*/{RESULT}"))))
    provenance = dataclasses.replace(record.provenance, results=RESULTS_VERSION)
    trials = unique_trials(sweeps, provenance)
    former = find_trained(workspace.trials, trials, provenance, None if accept_code else trial_closure())
    return dataclasses.replace(done, provenance=provenance, **_trials(workspace, trials, former, retry_failed))


def find_prepared(setup: StudySetup) -> Done:
    """What is prepared with the study's present settings and entries: the steps before the first one that is made
    again."""
    changed = _changed(setup)
    suite = not setup.data and suite_is_there(setup.study, setup.workspace)
    tokenizer = setup.workspace.tokenizer.exists() and not changed & {"suite", "tokenizer"}
    return Done(suite, tokenizer, not changed and _frozen(setup.study, setup.workspace))


def _changed(setup: StudySetup) -> set[Step]:
    return {one.step for one in find_changes(setup.study, setup.workspace, setup.data, setup.tokenizer)}


def _trials(
    workspace: Workspace, ids: Mapping[str, Trial], former: Mapping[str, Trial], retry_failed: bool
) -> dict[str, Any]:
    events = {
        id: state.event for id, state in read_states(list(ids), workspace.trials, Ledger(workspace.ledger)).items()
    }
    finished = frozenset(id for id in ids if events[id] == FINISHED)
    left = {id: events[id] for id in ids if events[id] in ((DIVERGED,) if retry_failed else (FAILED, DIVERGED))}
    to_run = [id for id in ids if id not in finished and id not in left]
    steps = {id: newest_step(workspace.trials / id / RUN) for id in to_run}
    if former:
        shared = share_runs(ids, former)
        for id in to_run:
            before = [one for one in shared[id].before if one[0] in former]
            steps[id] = steps[id] or latest_common(workspace.trials, before)[1]
    return {"finished": finished, "left": left, "steps": {id: n for id, n in steps.items() if n}}


def _prepared_by(study: Study) -> list[Any]:
    """The settings that determine the trials' inputs."""
    protocol = study.eval
    return [
        study.all_names(), study.suite, study.tokenizer, study.tokenizer_train, study.store, study.tau, study.rate,
        study.model.frames, protocol.windows_per_dataset, protocol.seed, protocol.prompt_frames,
    ]  # fmt: skip


def _frozen(study: Study, workspace: Workspace) -> bool:
    try:
        return windows_are_frozen(study, workspace)
    except (ConfigError, DataError):  # others, or none of some datasets
        return False
