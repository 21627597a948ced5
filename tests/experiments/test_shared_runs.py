"""Trials that share the beginning of their training, and those that go on from another trial."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from experiments.presets import CPU_FULL
from experiments.run_study import make_jobs, say_trained
from experiments.running.attempts import RUN
from experiments.running.provenance import FILE, Start, TrialRecord, read_record
from experiments.running.runner import Job
from experiments.running.shared_runs import begin_shared, share_runs
from experiments.running.trained import find_trained
from experiments.running.trial import Trial, trial_id
from experiments.running.workspace import Workspace
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import control_of, reference_trial, titles, unique_trials
from experiments.terminal.progress import console
from hma_jax.config.json import from_dict, to_dict
from tests.experiments import fakes
from tests.experiments.fakes import PROVENANCE
from tests.experiments.test_runner import events, job, run

STEPS = (100, 200, 400)
WSD = replace(CPU_FULL.train.optimizer, warmup_steps=10)


def trial(steps: int, **changes):
    train = replace(CPU_FULL.train, steps=steps, optimizer=WSD)
    return replace(reference_trial(replace(CPU_FULL, train=train), 0), **changes)


def test_trials_that_differ_in_steps_or_judging_alone_share_their_run():
    trials = {f"{n}": trial(n) for n in STEPS}
    trials["judged on five"] = trial(200, evaluated=CPU_FULL.dataset_names()[:5])
    trials["another seed"] = replace(trial(200), train=replace(trial(200).train, seed=1))
    trials["control"] = control_of(trial(400))
    shared = share_runs(trials)
    assert shared["100"].before == () and shared["100"].keep == (80,)
    assert shared["200"].before == (("100", 80),) and shared["200"].keep == (160, 200)
    assert shared["judged on five"].before == (("100", 80), ("200", 200))
    assert dict(shared["400"].before) == {"100": 80, "200": 160, "judged on five": 160} and shared["400"].keep == ()
    for alone in ("another seed", "control"):
        assert shared[alone].before == () and shared[alone].keep == ()


def test_cosine_shares_nothing():
    cosine = replace(WSD, schedule="cosine")
    trials = {f"{n}": replace(trial(n), train=replace(trial(n).train, optimizer=cosine)) for n in STEPS}
    assert all(s.before == () and s.keep == () for s in share_runs(trials).values())


def checkpoint(trials: Path, id: str, *steps: int) -> None:
    for step in steps:
        (trials / id / RUN / "checkpoints" / str(step)).mkdir(parents=True)
        (trials / id / RUN / "metrics.jsonl").write_text("{}\n")


def test_a_trial_begins_at_the_latest_step_that_it_has_in_common(tmp_path):
    checkpoint(tmp_path, "100", 80, 100)
    checkpoint(tmp_path, "200", 160, 200)
    before = (("100", 80), ("200", 160), ("300", 240))
    assert begin_shared(tmp_path / "400", before) == ("200", 160)
    assert (tmp_path / "400" / RUN / "checkpoints/160").is_dir()
    assert begin_shared(tmp_path / "400", before) is None, "it has begun"
    assert begin_shared(tmp_path / "other", (("300", 240),)) is None
    assert begin_shared(tmp_path / "other", (("100", 70),)) is None, "its checkpoints are of the decay"


def test_a_trial_that_is_judged_otherwise_goes_on_from_what_is_trained(tmp_path):
    """Of its finished namesake in all but the judging: from the last step, or, with other steps, from before the
    decay."""
    former = {"200": trial(200), "other": replace(trial(200), tau=1.0)}
    judged = replace(trial(200), eval=replace(trial(200).eval, random_actions=3))
    adapted = replace(judged, source=trial(100))
    now = {"judged": judged, "longer": trial(400), "adapted": adapted, "seed": replace(judged, weighed="all")}
    former["adapted"] = replace(trial(200), source=replace(trial(100), eval=judged.eval))
    shared = share_runs(now, former)
    assert shared["judged"].before == (("200", 200),) and not shared["seed"].before
    assert shared["longer"].before == (("200", 160), ("judged", 160)) and shared["adapted"].before == (
        ("adapted", 200),
    )
    assert shared["judged"].keep == (160,)
    source = replace(trial(100), train=replace(trial(100).train, steps=99))
    assert share_runs({"a": replace(adapted, source=source)}, former)["a"].before == ()


def test_trials_are_said_to_go_on_only_from_checkpoints_that_they_can_begin_from(tmp_path):
    trials = {"begun": trial(400, tau=1.0), "400": trial(400), "alone": replace(trial(400), weighed="all")}
    former = {"200": trial(200), "other": trial(200, tau=1.0)}
    jobs = make_jobs(trials, dict.fromkeys(trials, ""), PROVENANCE, {}, former)
    assert {job.id: len(job.after) for job in jobs} == {"begun": 1, "400": 1, "alone": 0}
    workspace = Workspace(tmp_path)
    checkpoint(workspace.trials, "200", 200)  # of the decay, in which their learning rates differ
    checkpoint(workspace.trials, "other", 160)
    checkpoint(workspace.trials, "begun", 20)

    def said() -> str:
        with console.capture() as capture:
            say_trained(jobs, former, workspace)
        return " ".join(capture.get().split())

    assert said() == ""
    checkpoint(workspace.trials, "200", 160)
    assert said() == "1 of 3 trials to be run go on from checkpoints that were trained here for other trials"


def test_it_says_then_what_both_ran(tmp_path):
    """The sources and machines of the trial that it goes on from, and its own."""
    checkpoint(tmp_path, "200", 160, 200)
    (tmp_path / "new").mkdir()
    for id, code in (("200", "old"), ("new", "now")):
        record = TrialRecord(PROVENANCE, {code: {"experiments.running.trial": code}}, {}, (Start(code, {}),))
        (tmp_path / id / FILE).write_text(json.dumps(to_dict(record)))
    assert begin_shared(tmp_path / "new", (("200", 200),)) == ("200", 200)
    record = read_record(tmp_path / "new")
    assert record.code == "now" and set(record.closures) == {"old", "now"} and len(record.starts) == 2
    assert begin_shared(tmp_path / "new", (("200", 200),)) is None


def test_what_is_trained_is_found_where_its_name_tokens_and_sources_are_today_s(tmp_path):
    trials = fakes.finished_study(tmp_path).trials
    ids = sorted(path.name for path in trials.iterdir())
    ran = dict(fakes.RECORD.closures["c0de"])
    assert find_trained(trials, (), PROVENANCE, ran) == {}, "no checkpoint is left"
    for id in ids:
        checkpoint(trials, id, 3)
    windows = replace(PROVENANCE, manifest="other")
    assert (
        sorted(find_trained(trials, (), windows, ran)) == ids
        and sorted(find_trained(trials, ids[2:], windows, ran)) == ids[:2]
    )
    assert find_trained(trials, (), replace(PROVENANCE, store="other"), ran) == {}
    other = {"experiments.running.trial": "2"}
    assert find_trained(trials, (), PROVENANCE, other) == {} and len(find_trained(trials, (), PROVENANCE, None)) == len(
        ids
    )
    (trials / ids[0]).rename(trials / "renamed")
    (trials / ids[1] / "job.json").write_text("{")
    assert sorted(find_trained(trials, (), PROVENANCE, ran)) == ids[2:]


def test_a_job_waits_for_those_that_it_goes_on_from(tmp_path):
    """Beside others that do not: it is listed first, and its place is given to one that is ready."""
    jobs = [Job("c", "c", job("c").record, after=frozenset("ab")), job("a"), job("b", "crash"), job("d")]
    states = run(tmp_path, jobs, workers=2)
    assert {id: s.event for id, s in states.items()} == {
        "a": "finished",
        "b": "failed",
        "c": "finished",
        "d": "finished",
    }
    lines = [json.loads(line) for line in (tmp_path / "ledger.jsonl").read_text().splitlines()]
    began = next(i for i, line in enumerate(lines) if line["trial"] == "c")
    ended = [i for i, line in enumerate(lines) if line["trial"] in "ab" and line["event"] != "running"]
    assert len(ended) == 2 and began > max(ended) and events(tmp_path, "c")[0] == "running"


def test_jobs_of_the_designs_wait_for_their_sources_and_siblings():
    sweeps = plan_sweeps(CPU_FULL, ("fewshot", "horizon"))
    trials = unique_trials(sweeps, PROVENANCE)
    jobs = {j.id: j for j in make_jobs(trials, titles(sweeps, PROVENANCE), PROVENANCE, {})}
    adapted = {id: t for id, t in trials.items() if t.source}
    assert len(adapted) == 36
    for id, one in adapted.items():
        assert trial_id(one.source, PROVENANCE) in jobs[id].after
    longest = trial_id(reference_trial(CPU_FULL, 0, 32_000), PROVENANCE)
    assert len(jobs[longest].after) == 6  # 500 to 16,000 steps
    assert len({j.title for j in jobs.values()}) == len(jobs)


@pytest.mark.parametrize("seed", CPU_FULL.seeds)
def test_a_trial_reads_back_from_its_record_with_its_source(seed):
    sweeps = plan_sweeps(replace(CPU_FULL, seeds=(seed,)), ("fewshot", "newcomers"))
    for one in unique_trials(sweeps, PROVENANCE).values():
        assert from_dict(Trial, json.loads(json.dumps(to_dict(one)))) == one
