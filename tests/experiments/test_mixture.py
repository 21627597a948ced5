"""Whoever trains on several datasets sees how often each is drawn, and on the page what an axis changes of it."""

from __future__ import annotations

from dataclasses import replace

import pytest

from data_pipelines.loading.selection import select_windows
from data_pipelines.tokens.store import TokenStore
from experiments.cli.mixture import show_mixture
from experiments.report.mixture import describe_data_along, describe_mixture
from experiments.running.trial import Trial, loader_of, trial_id
from experiments.sweeps.registry import plan_sweeps
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset
from tests.experiments.fakes import PROVENANCE, STUDY
from tests.tiny import train_config

LENGTHS = {"many": [12] * 30, "long": [60] * 6, "short": [1] * 4}
TRIAL = Trial(tuple(LENGTHS), None, tuple(LENGTHS), STUDY.model, train_config(batch=8, steps=500), STUDY.eval, rate=2.0)


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> TokenStore:
    root = tmp_path_factory.mktemp("data")
    for name, lengths in LENGTHS.items():
        spec = make_spec(name)
        tokenize_dataset(spec, write_rlds(root, spec, lengths), FakeTokenizer(), root / "store", frame_step=1)
    return TokenStore(root / "store")


@pytest.mark.parametrize("weighed", ["used", "all"])
@pytest.mark.parametrize("cap", [None, 3])
def test_the_shares_that_are_shown_are_those_of_the_loader(store, capsys, cap, weighed):
    trial = replace(TRIAL, max_trajectories=cap, weighed=weighed)
    chosen = select_windows(store, loader_of(trial))
    show_mixture(store, trial)
    said = capsys.readouterr().out
    lines = {w[0]: w[1:] for line in said.splitlines() if (w := line.split()) and w[0] in LENGTHS}
    assert set(lines) == set(LENGTHS) and lines["short"] == ["0", "0", "0.0%", "0.0"]
    for name, weight in zip(chosen.mixture.names, chosen.mixture.weights, strict=True):
        windows = len(chosen.sets[name])
        passes = weight * 8 * 500 / windows
        expected = [str(len(chosen.sets[name].episodes)), str(windows), f"{weight:.1%}"]
        assert lines[name] == [*expected, f"{passes:.{0 if passes >= 10 else 1}f}"]
    assert ("by the windows of all trajectories" in said) == (weighed == "all")


def test_a_mixture_of_one_is_not_shown(store, capsys):
    show_mixture(store, replace(TRIAL, datasets=("many", "short"), evaluated=("many",)))
    assert not capsys.readouterr().out


def result_of(trial: Trial, store: TokenStore) -> dict:
    drawn = select_windows(store, loader_of(trial)).drawn()
    return {
        "trajectories": {name: one.trajectories for name, one in drawn.items()},
        "mixture": {name: {"windows": one.windows, "share": one.share} for name, one in drawn.items()},
    }


def test_a_page_tells_what_its_trials_were_trained_on(store):
    """A plateau was drawn over points that had the same trajectories."""
    study = replace(STUDY, datasets=tuple(LENGTHS), dataset_counts=(3,), trajectory_counts=(2, 5, 100, 1000))
    (sweep,) = plan_sweeps(study, ("trajectories",))
    results = {trial_id(p.trial, PROVENANCE): result_of(p.trial, store) for p in sweep.points}
    said = describe_data_along(sweep, PROVENANCE, results, {})
    assert "No dataset has more trajectories from 100 to 1,000: the trials" in said
    shares = {p.x: results[trial_id(p.trial, PROVENANCE)]["mixture"] for p in sweep.points}
    at = {
        name: f"from {shares[2][name]['share']:.1%} at 2 to {shares[1000][name]['share']:.1%} at 1,000"
        for name in LENGTHS
    }
    # Of two datasets' shares the changes are equal.
    assert any(f"that of {name} most, {at[name]}" in said for name in ("many", "long"))
    reference = next(p.trial for p in sweep.points if p.x == 1000)
    shown = describe_mixture(reference, results[trial_id(reference, PROVENANCE)])
    assert f"<td>{shares[1000]['many']['share']:.1%}</td>" in shown and "n<sup>1/3</sup>" in shown

    whole = [replace(p, trial=replace(p.trial, weighed="all")) for p in sweep.points]
    same = replace(sweep, points=tuple(whole))
    results = {trial_id(p.trial, PROVENANCE): result_of(p.trial, store) for p in whole}
    assert "draws" not in describe_data_along(same, PROVENANCE, results, {})


def test_a_page_of_earlier_results_says_nothing_of_it():
    (sweep,) = plan_sweeps(replace(STUDY, trajectory_counts=(2, 5)), ("trajectories",))
    results = {trial_id(p.trial, PROVENANCE): {} for p in sweep.points}
    assert describe_data_along(sweep, PROVENANCE, results, {}) == describe_mixture(sweep.points[0].trial, {}) == ""
    counted = dict.fromkeys(STUDY.dataset_names(), 2)
    assert "No dataset has more trajectories from 2 to 5" in describe_data_along(sweep, PROVENANCE, results, counted)
