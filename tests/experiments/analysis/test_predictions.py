"""Predictions are made before their trials run, stay as they were written, and are held against what came."""

import json
import re
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.analysis import predictions
from experiments.analysis.fits import MIN_POSITIONS, Coefficient
from experiments.analysis.isoflop import IsoFlop
from experiments.analysis.measured import Position
from experiments.analysis.predictions import Outcome, Prediction, compare, load_predictions, save_prediction
from experiments.analysis.scaling import Curve
from experiments.cli.main import main
from experiments.presets import CPU
from experiments.report import numbers
from experiments.report.draw import draw
from experiments.report.fits import describe_fits
from experiments.report.numbers import read_numbers
from experiments.report.validity import _prediction
from experiments.running.attempts import RESULT
from experiments.running.ledger import FINISHED, Ledger
from experiments.running.result_file import write_result
from experiments.running.workspace import Workspace, load_record
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import POINT, unique_trials
from experiments.sweeps.width import plan as plan_width
from experiments.user_input.override import override
from tests.experiments.analysis.test_measured import windows_of
from tests.experiments.fakes import PROVENANCE
from tests.experiments.judged import WIDE, finish, judged_study

HELD = 64
WHOLE = replace(WIDE, widths=(*WIDE.widths, HELD))


@pytest.fixture(scope="module")
def before(tmp_path_factory):
    """A study whose largest width is planned and has not run."""
    return judged_study(tmp_path_factory.mktemp("fits") / "study")[0].root


@pytest.fixture
def root(before, tmp_path):
    shutil.copytree(before, tmp_path / "study")
    return tmp_path / "study"


@pytest.fixture(scope="module")
def with_prediction(before, tmp_path_factory):
    """The same once the loss at that width is predicted."""
    root = shutil.copytree(before, tmp_path_factory.mktemp("predicted") / "study")
    assert predict(root) == 0
    return root


@pytest.fixture
def predicted(with_prediction, tmp_path):
    return shutil.copytree(with_prediction, tmp_path / "study")


def command(root, *words):
    return main(["fit", str(root), *words])


def test_the_law_of_best_sizes_stands_under_exponents(monkeypatch, tmp_path, capsys):
    """It stood under the loss."""
    law = IsoFlop(
        exponent=Coefficient("a", 0.5, 0.45, 0.55),
        near=Coefficient("a", 0.6, 0.4, 0.8),
        apart=Coefficient("d", -0.1, -0.2, -0.05),
    )
    monkeypatch.setattr(numbers, "read_numbers", lambda _: SimpleNamespace(fits=[], isoflop=law, results={}))
    assert command(tmp_path) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert lines[0].index("N_opt ~ C^0.500") == head.index("exponents")
    assert "by three sizes N_opt ~ C^0.600" in lines[1] and "another exponent" in lines[2]


def predict(root, *words):
    return command(root, "--predict", f"width={HELD}", "--set", f"widths=8,16,24,32,48,{HELD}", *words)


def run_the_rest(root, study=WHOLE):
    """The trials of the whole study that are not there yet."""
    workspace = Workspace(root)
    for id, trial in unique_trials(plan_sweeps(study, ("width",)), PROVENANCE).items():
        if not (workspace.trials / id).exists():
            finish(workspace, id, trial)
    values = json.loads(workspace.record.read_text())
    values["study"]["widths"] = list(study.widths)
    workspace.record.write_text(json.dumps(values))


def test_the_command_shows_the_fit(before, capsys):
    assert command(before) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "trunk parameters" in shown and ("alpha 0.4" in shown or "alpha 0.5" in shown)
    assert re.search(r"E [\d.]+ \[[\d.]+, [\d.]+\]", shown)


def test_a_prediction_comes_true(root, capsys):
    assert predict(root) == 0
    assert "git add -f" in capsys.readouterr().out  # studies lie in runs, which .gitignore leaves out
    [prediction] = load_predictions(root / "predictions").values()
    assert len(prediction.inputs) == 15 and len(prediction.trials) == 3
    [waiting] = read_numbers(Workspace(root), draws=20).outcomes
    assert waiting.observed is None and waiting.inside is None
    run_the_rest(root)
    [outcome] = read_numbers(Workspace(root), draws=20).outcomes
    assert outcome.inside and outcome.seeds == 3 and not outcome.marks
    width = prediction.high - prediction.low
    assert width < 0.1 * prediction.mean and abs(outcome.observed - prediction.mean) < width
    draw(Workspace(root), load_record(Workspace(root)))
    page = (root / "report.html").read_text()
    assert "A preregistered prediction of a fit holds." in page and "Preregistered predictions" in page


def test_a_part_of_what_was_predicted_is_on_the_level_of_all_seeds_and_has_no_verdict():
    """Where each seed has robots of its own, which one finished first decided whether the prediction held."""
    x, hard = (1.0, 2.0, 4.0, 8.0), {"a": 1.0, "b": 4.0}
    places = [Position(f"{robot}{at:g}", "run", seed, (at,), (robot,)) for seed, robot in enumerate(hard) for at in x]
    tables = {p.trial: windows_of([hard[p.scope[0]] * p.x[0] ** -0.5], p.scope[0], [0]) for p in places}
    inputs, held = ({p.trial: "" for p in places if (p.x[0] == 8) == last} for last in (False, True))
    mean = 2 * 8**-0.5  # at the geometric mean of both robots
    made = Prediction("own", ("steps",), (8.0,), tuple(held), mean, 0.9 * mean, 1.1 * mean, 0.9, "", {}, inputs, ())
    curve = Curve("own", ("steps",), tuple(places))
    for lacking, inside in (("", True), ("b8", None), ("a8", None)):
        there = {id: table for id, table in tables.items() if id != lacking}
        outcome = compare(made, [curve], there, inputs)
        assert outcome.observed == pytest.approx(mean) and outcome.inside is inside and not outcome.marks, lacking
    assert _prediction(outcome).verdict == "open" and "so far 0.707 (1 of 2 trials)" in _prediction(outcome).text
    alone = {id: tables[id] for id in ("a8", "b1", "b2")}
    outcome = compare(made, [curve], alone, inputs)
    assert outcome.observed is None and "every seed was evaluated on other robots" in outcome.marks[-1]


def test_a_mean_over_more_seeds_is_predicted_the_more_narrowly():
    rng, axes = np.random.default_rng(0), ("steps",)
    places = [Position(f"{x:g}-{seed}", "run", seed, (x,), ("a",)) for x in np.geomspace(1, 64, 7) for seed in range(3)]
    tables = {
        p.trial: windows_of([(1.5 + p.x[0] ** -0.5) * np.exp(0.01 * rng.standard_normal())], "a", [0]) for p in places
    }
    new = [Position(f"new-{seed}", "run", seed, (20.0,), ("a",)) for seed in range(16)]

    def width(seeds: int) -> float:
        held = tuple(new[:seeds])
        made = predictions.predict(Curve("own", axes, (*places, *held)), held, tables, dict.fromkeys(tables, ""))
        return np.log(made.high / made.low)

    assert width(16) < 0.6 * width(1)


def test_nothing_is_predicted_of_a_trial_that_exists(root, capsys):
    assert command(root, "--predict", "width=48") == 2
    assert "exists already (finished)" in capsys.readouterr().err
    assert not (root / "predictions").exists()


def test_nothing_is_predicted_of_a_trial_that_ran_and_was_removed(root, capsys):
    """Its prediction was sealed as any other, and held."""
    for id, trial in unique_trials(plan_sweeps(WHOLE, ("width",)), PROVENANCE).items():
        if trial.model.width == HELD:
            Ledger(Workspace(root).ledger).append(id, FINISHED)
    assert predict(root) == 2
    assert "has run, says ledger.jsonl; a prediction must be made before its trial runs" in capsys.readouterr().err
    assert not (root / "predictions").exists()


def test_a_prediction_is_not_made_twice(predicted, capsys):
    assert predict(predicted) == 2
    assert "is an earlier prediction, which is not overwritten" in capsys.readouterr().err


def test_a_prediction_that_was_edited_is_refused(predicted, capsys):
    [path] = (predicted / "predictions").glob("*.json")
    values = json.loads(path.read_text())
    path.write_text(json.dumps(values | {"high": values["high"] * 1.001}))
    assert command(predicted) == 2
    assert "was changed after it was written" in capsys.readouterr().err
    for other in ("null", "[]", "{}"):
        path.write_text(other)
        assert command(predicted) == 2
        assert f"{path}: the prediction cannot be read" in capsys.readouterr().err


def test_what_was_made_from_other_results_is_marked(predicted):
    [prediction] = load_predictions(predicted / "predictions").values()
    directory = predicted / "trials" / next(iter(prediction.inputs))
    result = json.loads((directory / RESULT).read_text())
    result.pop("hash")
    write_result(directory, result | {"parameters": 1})
    [outcome] = read_numbers(Workspace(predicted), draws=20).outcomes
    assert any("1 of the 15 results" in mark for mark in outcome.marks)


def test_a_prediction_after_the_fact_is_marked(predicted):
    [prediction] = load_predictions(predicted / "predictions").values()
    run_the_rest(predicted)
    late = replace(prediction, finished=(*prediction.finished, prediction.trials[0]))
    save_prediction(predicted / "predictions" / "late.json", late)
    marks = {o.prediction.finished: o.marks for o in read_numbers(Workspace(predicted), draws=20).outcomes}
    assert any("no prediction" in mark for mark in marks[late.finished]) and not marks[prediction.finished]


def test_a_copy_of_a_prediction_counts_once(predicted):
    """It was shown twice, as if two had come true."""
    folder = predicted / "predictions"
    [path] = folder.glob("*.json")
    shutil.copy(path, folder / "a_copy.json")
    [prediction] = load_predictions(folder).values()
    save_prediction(folder / "other.json", replace(prediction, high=prediction.high + 1))
    assert len(load_predictions(folder)) == 2


@pytest.mark.parametrize(
    "words, says",
    [
        (("--predict", "width"), "write it as AXIS=X"),
        (("--predict", "width=50"), "plans no trial there"),
        (("--predict", "lr=0.1"), "not an axis with numbers as positions"),
        (("--out", "x.json"), "give --predict"),
        (
            ("--predict", f"width={HELD}", "--set", f"widths=8,16,24,32,48,{HELD}", "--set", "seeds=0"),
            "width: every point has one seed, but the interval of a prediction needs the noise between seeds; run the trials",
        ),
    ],
)
def test_what_cannot_be_predicted_says_why(before, words, says, capsys):
    assert command(before, *words) == 2
    assert says in " ".join(capsys.readouterr().err.split())


def test_a_position_that_is_no_whole_number_is_said_as_it_is():
    """A quarter of the data was 'at 0 part of the data'."""
    made = Prediction("own", ("part of the data",), (0.25,), ("a",), 3.0, 2.9, 3.1, 0.9, "", {}, {}, ())
    outcome = Outcome(made, None, 0, ())
    assert "own at 0.25 part of the data: predicted 3.000" in _prediction(outcome).text
    assert "<td class=text>0.25 part of the data</td>" in describe_fits([], None, [outcome], "")
    assert replace(made, x=(132480.0,), axes=("trunk parameters",)).position == "132,480 trunk parameters"


def test_the_sweeps_of_the_page_have_the_seeds_that_a_prediction_needs():
    """After its first one, of 26 minutes, the prediction that it was for was refused."""
    page = (Path(__file__).parents[3] / "docs" / "fits.md").read_text()
    sweeps = re.findall(r"^    hma sweep width (.*) --out", page, re.MULTILINE)
    for words in sweeps:
        points = plan_width(override(CPU, words.replace("--set ", "").split())).points
        seeds = Counter(point.x for point in points if point.role == POINT)
        assert len(seeds) >= MIN_POSITIONS and min(seeds.values()) > 1, words
    assert len(sweeps) == 2


def with_own_axis(root, change):
    """The study has a file's axis `own`, too: its widths once more, its trials finished; `change` is what becomes of
    it."""
    (root / "axes").mkdir()
    (root / "axes/mine.py").write_text(
        "from dataclasses import replace\nfrom experiments.sweeps import width\n\n\n"
        f"def plan(study):\n    sweep = replace(width.plan(study), name='own')\n    return {change}\n"
    )
    values = json.loads((root / "study.json").read_text())
    (root / "study.json").write_text(json.dumps(values | {"axes": ["width", "axes/mine.py"]}))


def predict_own(root, asked):
    return command(root, "--predict", f"{asked}={HELD}", "--set", f"widths=8,16,24,32,48,{HELD}")


def test_an_axis_of_a_file_is_predicted(root):
    with_own_axis(root, "sweep")
    assert predict_own(root, "own") == 0
    [prediction] = load_predictions(root / "predictions").values()
    assert prediction.curve == "own" and len(prediction.inputs) == 15 and len(prediction.trials) == 3


def test_a_position_that_no_axis_of_a_file_has_is_added_to_that_file(root, capsys):
    """No setting adds it, and one was asked for."""
    with_own_axis(root, "sweep")
    assert command(root, "--predict", "own=50") == command(root, "--predict", "width=50") == 2
    own, width = capsys.readouterr().err.split("error: ")[1:]
    assert own.strip().endswith(f"add it to the plan in {root / 'axes/mine.py'}"), own
    assert width.strip().endswith("add it to the plan with --set")


def test_of_several_curves_one_is_chosen(root, capsys):
    with_own_axis(
        root, "replace(sweep, points=tuple(replace(p, series=s) for s in ('a/b', 'as well') for p in sweep.points))"
    )
    assert predict_own(root, "own") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"which curve of own? Write one of own-a/b={HELD}, 'own-as well={HELD}'" in said
    assert not (root / "predictions").exists()
    assert predict_own(root, "own-as well") == predict_own(root, "own-a/b") == 0
    found = {name: prediction.curve for name, prediction in load_predictions(root / "predictions").items()}
    assert found == {f"own-as well-{HELD}.json": "own-as well", f"own-a_b-{HELD}.json": "own-a/b"}


def test_nothing_is_predicted_where_the_lowest_loss_is_within(root, capsys):
    with_own_axis(root, "replace(sweep, interior_minimum=True)")
    assert predict_own(root, "own") == 2
    assert "along own the loss has a minimum inside the range, so it is not a power law" in " ".join(
        capsys.readouterr().err.split()
    )
