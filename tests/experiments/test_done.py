"""What a dry run does not count again."""

import shutil
from dataclasses import replace

import pytest

from experiments.dry_run.cost import plan_trials
from experiments.dry_run.done import NOTHING, find_done
from experiments.dry_run.plan_table import plan_table
from experiments.running.attempts import RESULT
from experiments.running.ledger import DIVERGED, FAILED, Ledger
from experiments.running.workspace import save_record
from experiments.study import SCALING, TokenizerTrainConfig
from experiments.study_setup import StudyArguments, StudySetup
from experiments.sweeps.registry import plan_sweeps
from tests.experiments import fakes

STUDY = replace(fakes.STUDY, datasets=("pusher_sand", "rover_road", "arm_chalk"))  # robots whose sizes are known


@pytest.fixture
def setup(tmp_path) -> StudySetup:
    """Of a study all of whose trials are finished."""
    workspace = fakes.finished_study(tmp_path, STUDY)
    save_record(workspace, fakes.record_of(STUDY))
    return StudySetup(StudyArguments(out=tmp_path), STUDY, (), workspace, STUDY.trajectory_counts)


def test_finished_trials_are_not_priced_again_and_begun_ones_from_their_step(setup):
    sweeps = plan_sweeps(STUDY, SCALING)
    whole = sum(plan.flops for plan in plan_trials(STUDY, sweeps).values())
    done = find_done(setup, sweeps)
    assert whole > 0 and {plan.seconds for plan in plan_trials(STUDY, sweeps, done=done).values()} == {0.0}
    count = len(done.finished)
    said = plan_table(STUDY, sweeps, done=done).caption
    assert said.startswith(f"Already done, and not counted: {count} of {count} trials. About 31 s to prepare: ")
    said = plan_table(STUDY, sweeps, done=replace(done, tokens=True)).caption
    assert said == f"Already done, and not counted: tokens, {count} of {count} trials. "

    first, second, *_ = sorted(done.finished)
    for id in (first, second):
        (setup.workspace.trials / id / RESULT).unlink()
    (setup.workspace.trials / first / "run" / "checkpoints" / "2").mkdir(parents=True)
    done = find_done(setup, sweeps)
    plans = plan_trials(STUDY, sweeps, done=done)
    assert {id for id, plan in plans.items() if plan.seconds} == {first, second}
    assert plans[first].flops == pytest.approx(plans[first].cost.flops - 2 / 3 * plans[first].cost.train_flops)
    assert plans[second].flops == plans[second].cost.flops
    said = plan_table(STUDY, sweeps, done=done).caption
    assert f"{len(done.finished)} of {len(plans)} trials, 2 steps of training. About " in said


def test_trials_that_are_judged_otherwise_are_not_trained_again(setup):
    """Where what was trained is still here; by other sources only where the user accepts them, as the study would."""
    sweeps = plan_sweeps(replace(STUDY, eval=replace(STUDY.eval, random_actions=3)), SCALING)
    for id in find_done(setup, plan_sweeps(STUDY, SCALING)).finished:
        (setup.workspace.trials / id / "run" / "checkpoints" / "3").mkdir(parents=True)
    for accept in (False, True):
        done = find_done(setup, sweeps, accept_code=accept)
        plans = plan_trials(STUDY, sweeps, done=done).values()
        trained = [0.0 if accept else plan.cost.train_flops for plan in plans]
        assert [plan.flops - plan.cost.evaluation_flops for plan in plans] == pytest.approx(trained, abs=1)


def test_trials_that_stay_without_a_result_are_priced_only_where_they_are_tried_again(setup):
    sweeps = plan_sweeps(STUDY, SCALING)
    failed, diverged, *_ = sorted(find_done(setup, sweeps).finished)
    ledger = Ledger(setup.workspace.ledger)
    for id, event in ((failed, FAILED), (diverged, DIVERGED)):
        (setup.workspace.trials / id / RESULT).unlink()
        (setup.workspace.trials / id / "run" / "checkpoints" / "2").mkdir(parents=True)
        ledger.append(id, event)

    done = replace(find_done(setup, sweeps), tokens=True)
    plans, table = plan_trials(STUDY, sweeps, done=done), plan_table(STUDY, sweeps, done=done)
    assert not any(plan.seconds for plan in plans.values())
    assert {"failed", "diverged", "finished"} == set(table.columns[-1].cells)
    assert table.caption.endswith(
        f"2 of {len(plans)} trials diverged or failed: not run again, and not counted; --retry-failed runs the failed ones again. "
    )

    done = find_done(setup, sweeps, retry_failed=True)
    plans = plan_trials(STUDY, sweeps, done=done)
    assert plans[failed].flops == pytest.approx(plans[failed].cost.flops - 2 / 3 * plans[failed].cost.train_flops)
    assert not plans[diverged].seconds and done.left == {diverged: DIVERGED}
    shutil.rmtree(setup.workspace.trials / diverged)
    assert find_done(setup, sweeps).left == {failed: FAILED}


def test_nothing_of_a_study_on_other_tokens_or_none_is_taken_for_done(setup, tmp_path):
    sweeps = plan_sweeps(STUDY, SCALING)
    other = replace(setup, study=replace(STUDY, tokenizer_train=TokenizerTrainConfig(steps=7)))
    assert find_done(other, sweeps) == replace(NOTHING, other=len(find_done(setup, sweeps).finished)) != NOTHING
    setup.workspace.record.write_text("{")
    assert find_done(setup, sweeps) == NOTHING
    setup.workspace.record.unlink()
    assert find_done(setup, sweeps) == NOTHING
