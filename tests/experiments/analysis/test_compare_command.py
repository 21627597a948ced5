"""`hma compare` on trials and studies as they lie on disk."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis.compare import Side, compare
from experiments.analysis.intervals import OVERALL
from experiments.cli.compare import _table
from experiments.cli.main import main
from experiments.preparing.evaluation_stamp import STAMP
from experiments.preparing.made_from import MadeFrom
from experiments.running.workspace import Workspace, save_record
from experiments.sweeps.sweep import reference_trial
from hma_jax.evaluation.windows import FILE
from hma_jax.runtime.exits import Exit
from tests.experiments.analysis.trials import write_trial
from tests.experiments.analysis.worlds import judged, under_seeds, with_loss
from tests.experiments.fakes import PROVENANCE, STUDY, record_of


def better(table, by=0.1):
    return with_loss(table, table.metrics["cross_entropy"] - by)


@pytest.fixture
def table():
    return judged(np.random.default_rng(0), robots=3, mean=2.0)


def rows_of(path):
    with path.open(newline="") as file:
        return {(row["scope"], row["metric"]): row for row in csv.DictReader(file)}


def test_two_trials_are_compared_per_robot_and_overall(table, tmp_path, capsys):
    trial = reference_trial(STUDY, 0)
    a = write_trial(tmp_path / "a", trial, better(table))
    b = write_trial(tmp_path / "b", replace(trial, max_trajectories=4), table)
    assert main(["compare", str(a), str(b), "--to", str(tmp_path / "made" / "c.csv")]) == Exit.DONE
    rows = rows_of(tmp_path / "made" / "c.csv")
    assert set(rows) == {(scope, "cross_entropy") for scope in (OVERALL, "r0", "r1", "r2")}
    overall = rows[OVERALL, "cross_entropy"]
    assert float(overall["mean"]) == pytest.approx(-0.1, abs=1e-6) and overall["seeds"] == "1"
    assert float(overall["ratio"]) == pytest.approx(np.exp(-0.1), rel=1e-6)
    said = capsys.readouterr().out
    assert f"{a.name} - {b.name}" in said and "-0.1000 ± 0.0000" in said and "x 0.9048" in said


def test_a_trial_may_be_named_from_within_it_or_by_a_link(table, tmp_path, monkeypatch, capsys):
    a = write_trial(tmp_path, reference_trial(STUDY, 0), better(table))
    b = write_trial(tmp_path, reference_trial(STUDY, 1), table)
    (tmp_path / "best").symlink_to(b)
    monkeypatch.chdir(a)
    assert main(["compare", ".", "../best", "--to", str(tmp_path / "c.csv")]) == 0
    assert f"{a.name} - {b.name}" in capsys.readouterr().out


@pytest.mark.parametrize(("loss", "nats"), [("cross_entropy", "nats"), ("diffusion_loss", "loss")])
def test_every_column_has_its_own_unit_if_it_has_one(loss, nats, table, tmp_path, capsys):
    """Of latents action-nats are differences of the diffusion loss."""
    values = table.metrics["cross_entropy"]
    names = (loss, "action_nats", "psnr", "lpips", "action_error")
    table = replace(table, metrics=dict.fromkeys(names, values))
    trial = write_trial(tmp_path / "a", reference_trial(STUDY, 0), table)
    assert main(["compare", str(trial), str(trial), "--to", str(tmp_path / "c.csv")]) == 0
    said = capsys.readouterr().out
    assert f"action_nats ({nats})" in said and "psnr (dB)" in said and "action_error (variances)" in said
    assert "lpips" in said and "lpips (" not in said


def test_two_studies_are_compared_by_their_reference_models_over_seeds(table, tmp_path, capsys):
    rng = np.random.default_rng(1)
    for name, own in (("one", better(table, 0.3)), ("two", table)):
        workspace = Workspace(tmp_path / name)
        for seed, windows in under_seeds(own, rng, 2, 0.01).items():
            write_trial(workspace.trials, reference_trial(STUDY, seed), windows)
        save_record(workspace, record_of())
    assert main(["compare", *(str(tmp_path / n) for n in ("one", "two")), "--to", str(tmp_path / "c.csv")]) == 0
    overall = rows_of(tmp_path / "c.csv")[OVERALL, "cross_entropy"]
    assert overall["seeds"] == "2" and float(overall["low"]) < -0.3 < float(overall["high"])
    said = " ".join(capsys.readouterr().out.split())
    assert "over 2 seeds" in said and "only" not in said


def test_seeds_of_a_study_that_the_other_has_not_are_left_out_and_it_is_said(table, tmp_path, capsys):
    workspace = Workspace(tmp_path / "study")
    for seed, windows in under_seeds(table, np.random.default_rng(1), 2, 0.01).items():
        write_trial(workspace.trials, reference_trial(STUDY, seed), windows)
    save_record(workspace, record_of())
    one = write_trial(tmp_path / "one", reference_trial(replace(STUDY, widths=(8,)), 1), better(table))
    assert main(["compare", str(one), str(workspace.root), "--to", str(tmp_path / "c.csv")]) == 0
    assert rows_of(tmp_path / "c.csv")[OVERALL, "cross_entropy"]["seeds"] == "1"
    said = " ".join(capsys.readouterr().out.split())
    assert "Of the seeds of study (0, 1) only 1 is compared." in said


def test_of_other_seeds_two_models_are_compared_and_it_is_said_and_two_studies_are_not(table, tmp_path, capsys):
    """Of studies with one finished seed each these were paired, whichever they were, without a word."""
    trials = []
    for seed, name in enumerate(("one", "two")):
        workspace = Workspace(tmp_path / name)
        trials.append(write_trial(workspace.trials, reference_trial(STUDY, seed), table))
        save_record(workspace, record_of())
    to = ["--to", str(tmp_path / "c.csv")]
    assert main(["compare", *(str(tmp_path / n) for n in ("one", "two")), *to]) == 2
    assert "one has seeds 0 and two 1: none in common" in " ".join(capsys.readouterr().err.split())
    a, b = trials
    assert main(["compare", str(a), str(b), *to]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"{a.name} is of seed 0, {b.name} is of seed 1: differences include those between seeds" in said
    assert main(["compare", str(a), str(a), *to]) == 0 and "also those of seeds" not in capsys.readouterr().out


def test_several_seeds_that_are_left_are_compared_in_the_plural(table):
    seeds = under_seeds(table, np.random.default_rng(1), 3, 0.01)
    whole, two = Side("whole", seeds, ""), Side("two", {seed: seeds[seed] for seed in (1, 2)}, "")
    assert "Of the seeds of whole (0, 1, 2) only 1, 2 are compared." in _table(compare(whole, two), whole, two).caption


def test_robots_that_one_was_not_judged_on_are_left_out_and_it_is_said(table, tmp_path, capsys):
    """The mean over those that remain was called overall, without a word."""
    trial = reference_trial(STUDY, 0)
    a = write_trial(tmp_path / "a", trial, better(table))
    b = write_trial(tmp_path / "b", replace(trial, max_trajectories=4), table.among(("r0", "r2")))
    for one, other in ((a, b), (b, a)):
        assert main(["compare", str(one), str(other), "--to", str(tmp_path / "c.csv")]) == 0
        assert {scope for scope, _ in rows_of(tmp_path / "c.csv")} == {OVERALL, "r0", "r2"}
        said = " ".join(capsys.readouterr().out.split())
        assert said.count("Only") == 1 and f"Only {a.name} was judged on r1: no value here includes them." in said


def test_metrics_that_are_left_out_are_named(table, tmp_path, capsys):
    """The table and the file lacked them without a word."""
    trial, n = reference_trial(STUDY, 0), len(table)
    chance = {k: replace(table, metrics={**table.metrics, "retrieval": np.ones(n), "retrieval_chance": np.full(n, 1 / k)})
              for k in (4, 16)}  # fmt: skip
    a = write_trial(tmp_path / "a", trial, chance[16])
    b = write_trial(tmp_path / "b", replace(trial, max_trajectories=4), chance[4])
    c = write_trial(tmp_path / "c", replace(trial, max_trajectories=2), table)
    for other, kept in ((a, True), (b, False), (c, False)):
        assert main(["compare", str(a), str(other), "--to", str(tmp_path / "c.csv")]) == 0
        said = " ".join(capsys.readouterr().out.split())
        assert ("Not compared, since not both have them, or among as many actions: retrieval." in said) != kept
        assert any(metric == "retrieval" for _, metric in rows_of(tmp_path / "c.csv")) == kept


@pytest.mark.parametrize(("of_a", "of_b", "said"), [
    (16, 4, "for each window 15 of a, 3 of b, the longer list beginning with the shorter one."), (4, 4, ""), (4, None, ""),
])  # fmt: skip
def test_action_nats_over_other_numbers_of_sequences_are_said_to_be(table, of_a, of_b, said):
    """They were subtracted without a word."""

    def among(number):
        chance = {} if number is None else {"retrieval_chance": np.full(len(table), 1 / number)}
        return {0: replace(table, metrics=table.metrics | {"action_nats": np.ones(len(table))} | chance)}

    a, b = Side("a", among(of_a), ""), Side("b", among(of_b), "")
    caption = _table(compare(a, b), a, b).caption
    assert ("Action-nats are over other numbers of sequences" in caption) == bool(said) and said in caption


def test_what_is_not_comparable_ends_with_a_message_and_no_file(table, tmp_path, capsys):
    trial = reference_trial(STUDY, 0)
    a = write_trial(tmp_path / "a", trial, table)
    shorter = write_trial(tmp_path / "b", trial, table.rows(np.arange(1, len(table))))
    (tmp_path / "nothing").mkdir()
    for b, why in (
        (shorter, "only one of the two evaluations has window ('r0', 100, 0)"),
        (tmp_path / "nothing", "neither a study, nor a finished trial, nor an evaluated model"),
    ):
        assert main(["compare", str(a), str(b), "--to", str(tmp_path / "c.csv")]) == Exit.REFUSED == 2
        assert why in capsys.readouterr().err and not (tmp_path / "c.csv").exists()
    assert main(["compare", str(a), str(a), "--to", str(tmp_path)]) == 2
    assert f"is a directory; name a file, such as --to {tmp_path / 'comparison.csv'}" in capsys.readouterr().err
    workspace = Workspace(tmp_path / "empty")
    workspace.root.mkdir()
    save_record(workspace, record_of())
    assert main(["compare", str(a), str(workspace.root)]) == 2
    said = capsys.readouterr().err
    assert "no reference trial of this study" in said and f"Copy it to {workspace.trials} from where" in said


def test_nats_of_two_tokenizers_are_left_out_and_it_is_said(table, tmp_path, capsys):
    trial = reference_trial(STUDY, 0)
    psnr = replace(table, metrics={**table.metrics, "psnr": table.metrics["psnr_copy"] + 1})
    a = write_trial(tmp_path / "a", trial, psnr)
    b = write_trial(tmp_path / "b", trial, psnr, replace(PROVENANCE, tokenizer="other"))
    assert main(["compare", str(a), str(b), "--to", str(tmp_path / "c.csv")]) == 0
    assert {metric for _, metric in rows_of(tmp_path / "c.csv")} == {"psnr"}
    assert "Nats are not compared: the tokenizers differ (70c3, other)" in " ".join(capsys.readouterr().out.split())


def test_losses_of_other_noising_processes_are_left_out_and_it_is_said(table, tmp_path, capsys):
    of_latents = replace(table, metrics=dict.fromkeys(("diffusion_loss", "psnr"), table.metrics["cross_entropy"]))
    for steps in (1000, 20):
        write_evaluated(tmp_path / str(steps), of_latents, noising_steps=steps)
    compared = (str(tmp_path / steps) for steps in ("1000", "20"))
    assert main(["compare", *compared, "--to", str(tmp_path / "c.csv")]) == 0
    assert {metric for _, metric in rows_of(tmp_path / "c.csv")} == {"psnr"}
    said = " ".join(capsys.readouterr().out.split())
    assert "Losses are not compared: the noising processes have other numbers of steps (1000, 20)" in said


def write_evaluated(directory, windows, seed=None, **recorded):
    directory.mkdir(parents=True)
    windows.save(directory / FILE, directory.name)
    recorded = {"step": 3} | recorded | ({} if seed is None else {"seed": seed})
    MadeFrom({"tokenizer": PROVENANCE.tokenizer}, recorded).save(directory, STAMP)
    return directory


@pytest.mark.parametrize(
    ("seed", "kept"),
    [
        (1, "1 is compared."),
        (None, "0 is compared. model does not say with which seed it was trained, and stands for 0."),
    ],
)
def test_an_evaluated_model_is_compared_with_a_study_of_its_seed(seed, kept, table, tmp_path, capsys):
    """It stood for seed 0, whichever it was trained with."""
    workspace = Workspace(tmp_path / "study")
    for number, by in ((0, 0.1), (1, 0.2)):
        write_trial(workspace.trials, reference_trial(STUDY, number), better(table, by))
    save_record(workspace, record_of())
    model = write_evaluated(tmp_path / "a" / "model", table, seed)
    assert main(["compare", str(model), str(workspace.root), "--to", str(tmp_path / "c.csv")]) == 0
    assert f"Of the seeds of study (0, 1) only {kept}" in " ".join(capsys.readouterr().out.split())
    found = float(rows_of(tmp_path / "c.csv")[OVERALL, "cross_entropy"]["mean"])
    assert found == pytest.approx(0.1 if seed is None else 0.2, abs=1e-6)


@pytest.mark.parametrize(
    ("of_a", "of_b", "made"),
    [
        ({"step": 1, "steps": 3}, {"steps": 3}, "a/model 1 of 3, b/model 3 of 3."),
        ({"step": 1, "steps": 3}, {"step": 1, "steps": 3}, "a/model 1 of 3, b/model 1 of 3."),
        ({"step": 1, "steps": 3}, {"step": 0}, "a/model 1 of 3."),  # b is a converted model
        ({"step": 1}, {"steps": 3}, "a/model 1, b/model 3 of 3."),  # a was evaluated by an earlier version
        ({"steps": 3}, {"steps": 3}, ""),
        ({}, {"steps": 3}, ""),  # both of step 3
    ],
)
def test_models_whose_training_differs_or_is_not_finished_are_compared_and_it_is_said(
    of_a, of_b, made, table, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for name, recorded in (("a", of_a), ("b", of_b)):
        write_evaluated(tmp_path / name / "model", table, 0, **recorded)
    assert main(["compare", "a/model", "b/model"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert f"Steps of training when they were evaluated: {made}" in said if made else "Steps of training" not in said


def test_a_comparison_stays_where_no_place_is_named_for_another(table, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name, by in (("a", 0.1), ("b", 0.0), ("d", 0.3)):
        write_evaluated(tmp_path / name / "model", better(table, by), 0)
    for _ in range(2):
        assert main(["compare", "a/model", "b/model"]) == 0
        assert "a/model - b/model" in capsys.readouterr().out
    before = (tmp_path / "comparison.csv").read_bytes()
    assert main(["compare", "a/model", "d/model"]) == 2
    said = capsys.readouterr()
    assert (
        "a/model - d/model" in said.out
        and "comparison.csv holds another comparison, which is not overwritten" in said.err
    )
    assert (tmp_path / "comparison.csv").read_bytes() == before
    assert main(["compare", "a/model", "d/model", "--to", "comparison.csv"]) == 0
    assert (tmp_path / "comparison.csv").read_bytes() != before
