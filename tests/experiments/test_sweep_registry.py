"""Axes: all that there are can be asked for, and a stranger's file is one of them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

import experiments.sweeps
from experiments.cli.main import main
from experiments.presets import CPU_FULL
from experiments.report.draw import draw
from experiments.running.trial import Trial
from experiments.running.workspace import Workspace, load_record, save_record
from experiments.sweeps.registry import AXES, find_axis, join_axes, keep_axes, plan_sweeps
from experiments.sweeps.sweep import CONTROL, titles
from hma_jax.config import ConfigError
from hma_jax.config.json import from_dict, stable_hash, to_dict
from tests.experiments.fakes import PROVENANCE, STUDY, finished_study, record_of

FOLDER = Path(experiments.sweeps.__file__).parent
PAGE = Path(__file__).parents[2] / "docs/own_axis.md"


def test_every_file_with_a_plan_is_registered():
    """A line that is forgotten in the registry is found here, not by who asks for the axis."""
    files = {path.stem for path in FOLDER.glob("*.py") if re.search(r"^def plan\(", path.read_text(), re.MULTILINE)}
    assert files == set(AXES)


def test_every_axis_says_what_the_page_needs():
    for axis, sweep in zip(AXES, plan_sweeps(CPU_FULL, AXES), strict=True):
        assert sweep.name == axis and sweep.question and sweep.gain
        assert sweep.title or sweep.single_curve, f"{axis} has a section of its own, without a title"


def test_every_axis_is_a_program_of_its_own():
    for axis in AXES:
        assert (FOLDER / f"{axis}.py").read_text().endswith(f'if __name__ == "__main__":\n    run_sweep("{axis}")\n')


@pytest.mark.parametrize(("axis", "words"), [("widht", "did you mean width"), ("colour", "known: datasets, ")])
def test_an_unknown_axis_is_named(axis, words, capsys):
    with pytest.raises(ConfigError, match=words):
        find_axis(axis)
    assert main(["sweep", axis, "--preset", "smoke", "--dry-run"]) == 2 and words in capsys.readouterr().err


OWN = """from dataclasses import replace
from experiments.sweeps.sweep import make_sweep

def plan(study):
    return make_sweep(
        study, "own", "x", study.dataset_names(), (1, 3), lambda trial, x: {}, 3, question="?", gain="it"
    )
"""
NAMED = """from dataclasses import replace
from experiments.sweeps.sweep import make_ablation

def plan(study):
    variants = {"as it is": lambda trial: trial, "per [/s]": lambda trial: replace(trial, tau=1.0)}
    return make_ablation(study, "own", "x", variants, "as it is", question="?", gain="it", title="t")
"""
POINTS = """from experiments.sweeps.sweep import Point, Sweep, reference_trial

def plan(study):
    return Sweep("own", "x", study.dataset_names(), ({},))
"""


@pytest.fixture
def documented(tmp_path) -> Path:
    """The example of the documentation as a file."""
    (text,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    path = tmp_path / "temperature.py"
    path.write_text(text)
    return path


def test_the_documented_axis_is_planned(documented, capsys):
    assert main(["sweep", str(documented), "--preset", "smoke", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "4 trials" in said and "reference" in said
    assert "temperature 1 " in said and "temperature 10 " in said, "rows of other positions look alike"


def test_brackets_of_a_label_are_words_in_a_plan(tmp_path, capsys):
    (tmp_path / "own.py").write_text(NAMED)
    asked = ["--preset", "smoke", "--set", "ablation_seeds=0", "--dry-run"]
    assert main(["sweep", str(tmp_path / "own.py"), *asked]) == 0
    assert "per [/s]" in capsys.readouterr().out


def test_the_documented_axis_is_drawn_without_its_file(documented, unrendered, tmp_path):
    root = tmp_path / "study"
    root.mkdir()
    documented.write_text(documented.read_text().replace("another mixture", "another <mixture>"))
    (kept,) = keep_axes({"temperature": str(documented)}, root)
    documented.unlink()
    axes = ("width", kept)
    save_record(Workspace(root), record_of(axes=axes))
    draw(finished_study(root, axes=axes), load_record(Workspace(root)))
    page = (root / "report.html").read_text()
    assert "how strongly the mixture favours" in page and "more width and another &lt;mixture&gt;" in page
    assert (root / "figures/temperature.png").exists()
    rows = (root / "results.csv").read_text()
    assert all(f"temperature,{x}," in rows.replace(".0,", ",") for x in (1, 3, 10))
    lines = titles(plan_sweeps(STUDY, (*axes, "trajectories"), root), PROVENANCE).values()
    assert len(set(lines)) == len(lines) and sum("temperature of the mixture 10" in line for line in lines) == 2
    assert "seed 0 · temperature of the mixture 10" in page and "temperature of the mixture 3" not in page


def test_an_axis_without_its_reference_is_refused(tmp_path, capsys):
    root, path = tmp_path / "study", tmp_path / "mine.py"
    path.write_text(OWN.replace("(1, 3)", "(1, 10)").format("replace(trial, tau=float(x))"))
    for words in ["--preset", "smoke", "--dry-run"], ["--preset", "smoke", "--out", str(root)]:
        assert main(["sweep", str(path), *words]) == 2
        assert "reference_x 3 is not among the values (1, 10)" in " ".join(capsys.readouterr().err.split())


def test_files_are_kept_by_the_names_of_their_axes(tmp_path):
    """Two people's `mine.py` are two axes; an axis of a name that is there takes its place."""
    root = tmp_path / "study"
    root.mkdir()
    axes = ("width",)
    for folder, name, width in (("a", "narrow", 8), ("b", "wide", 32), ("c", "narrow", 4)):
        path = tmp_path / folder / "mine.py"
        path.parent.mkdir()
        path.write_text(
            "from dataclasses import replace\nfrom experiments.sweeps import width\n"
            f"def plan(study):\n    return replace(width.plan(replace(study, widths=({width},))), name={name!r})\n"
        )
        axes = keep_axes(join_axes(STUDY, root, axes, [str(path)]), root)
    assert axes == ("width", "axes/narrow.py", "axes/wide.py")
    assert [min(p.x for p in s.points) for s in plan_sweeps(STUDY, axes, root)] == [8, 4, 16]


def test_an_axis_of_other_trials_each_time_is_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "import random\nfrom dataclasses import replace\nfrom experiments.sweeps import width\n"
        "def plan(study):\n"
        "    widths = (8, random.choice(range(16, 2**20, 8)))\n"
        "    return replace(width.plan(replace(study, widths=widths)), name='own')\n"
    )
    assert main(["sweep", "mine.py", "--preset", "smoke", "--dry-run"]) == 2
    assert "returned another sweep when it was called again" in capsys.readouterr().err


TWICE = """
from dataclasses import replace
from experiments.sweeps import width
def plan(study):
    sweep = width.plan(study)
    return replace(sweep, name="mine", points=(*sweep.points, sweep.points[0]))
"""


EDITED = """
from dataclasses import replace
from experiments.sweeps import width
def plan(study):
    sweep = width.plan(study)
    return replace(sweep, name="mine", points=(replace(sweep.points[0], {}), *sweep.points[1:]))
"""
LABELLED = """
whole = plan
def plan(study):
    return replace(whole(study), labels=("as it is",), points=whole(study).points[:1])
"""


def test_values_of_an_array_are_numbers_and_the_controls_stand_at_the_ends_of_whatever_order(tmp_path):
    """An array's were refused as names, and of (3, 1, 10) the least had no control."""
    path, made = tmp_path / "mine.py", []
    study = replace(STUDY, designs=replace(STUDY.designs, end_controls=True))
    for values in ("(3, 1, 10)", "__import__('numpy').array([3, 1, 10])"):
        path.write_text(OWN.replace("(1, 3)", values).format("replace(trial, tau=x)"))
        made += plan_sweeps(study, [str(path)])
    listed, of_array = made
    assert listed == of_array and {type(p.x) for p in of_array.points} == {int}
    assert [p.x for p in listed.points if p.role == CONTROL] == [1, 3, 10]


def test_a_whole_number_in_a_field_of_floats_gives_a_trial_no_other_name(tmp_path):
    """Its process reads it as a float, and names the trial by that."""
    path = tmp_path / "mine.py"
    path.write_text(OWN.format("replace(trial, tau=x, model=replace(trial.model, mlp_ratio=4))"))
    assert STUDY.model.mlp_ratio == 4
    trials = [point.trial for point in plan_sweeps(STUDY, [str(path)])[0].points]
    assert {trial.tau for trial in trials} == {1, 3}
    for trial in trials:
        assert stable_hash(trial) == stable_hash(from_dict(Trial, json.loads(json.dumps(to_dict(trial)))))
    path.write_text(OWN.format("replace(trial, tau=3)"))
    with pytest.raises(ConfigError, match="has the same trial at 1 and 3: nothing of it changes there"):
        plan_sweeps(STUDY, [str(path)])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "has no function plan"),
        ("def plan(study): return 3", "must return a Sweep, got int"),
        (OWN.format("trial"), "has the same trial at 1 and 3: nothing of it changes there"),
        (OWN.format("None"), "axis own: change must return a trial, but returned None"),
        (OWN.replace("(1, 3)", "()"), "line 5: axis own: values is empty, so only its control would run"),
        (OWN.replace('"it"', '"it", seeds=()').format("trial"), "line 5: axis own: seeds is empty"),
        (
            OWN.replace("study.dataset_names()", "()").format("trial"),
            "trial at 1 is averaged over no robot; list those",
        ),
        (
            OWN.replace("names(), (", "names() + study.dataset_names()[:1], (").format("replace(trial, tau=float(x))"),
            "trial at 1 is averaged over arm more than once, but robots count equally",
        ),
        (
            OWN.format("replace(trial, capped=('rovre',)) if x == 1 else trial"),
            "trial at 1 caps trajectories of rovre, but",
        ),
        (
            OWN.format("replace(trial, max_trajectories=0) if x == 1 else trial"),
            "trial at 1: max_trajectories must be at",
        ),
        (
            OWN.format("replace(trial, capped=trial.datasets, max_trajectories=None) if x == 1 else trial"),
            "trial at 1 caps trajectories of .* at no number; set max_trajectories",
        ),
        (OWN.format("replace(trial, tau=2.0 + x)"), r"does not stand at reference_x 3, .* \(tau: 3.0 -> 5.0\)"),
        (OWN.format("replace(trial, tau='3' if x == 1 else 3.0)"), "Trial.tau: expected float, got '3'"),
        (
            OWN.format("replace(trial, datasets=trial.datasets[:x])"),
            "trial at 1 evaluates rover, pusher, but is not trained",
        ),
        (
            OWN.format("replace(trial, datasets=trial.datasets[:x], evaluated=trial.datasets[:x])"),
            "at 1 does not evaluate",
        ),
        (
            OWN.format("replace(trial, datasets=('toto',), evaluated=('toto',)) if x == 1 else trial"),
            "trained on toto, wh",
        ),
        (OWN.format("replace(trial, tau=x - 1.0 if x == 1 else trial.tau)"), "trial at 1: tau must be positive, got 0"),
        (
            OWN.format("replace(trial, model=replace(trial.model, factor_vocab=5 + x)) if x == 1 else trial"),
            "trial at 1: model.factor_vocab is 6 but the tokenizer makes",
        ),
        (OWN.format("replace(trial, rate=float(x)) if x == 1 else trial"), "has rate 1.0, and all .* frozen for 2.0"),
        (
            OWN.format("replace(trial, eval=replace(trial.eval, windows_per_dataset=x)) if x == 1 else trial"),
            "has eval.windows_per_dataset 1, and all trials of a study",
        ),
        (POINTS.format("reference_trial(study, 0)"), "point 1 must be a Point with a Trial, got a Trial"),
        (POINTS.format("Point('wide', reference_trial(study, 0))"), "position 'wide' of point 1 is not a number"),
        (EDITED.format("role='extra'"), "role of point 1 must be one of .*'control'.*, got 'extra'"),
        (
            EDITED.format("role='control'"),
            "trial at 8 is a control, but is not trained on shuffled actions; make it with",
        ),
        (EDITED.format("series='long'"), "some points have a series and others have none"),
        (EDITED.format("x=0, series='long'") + LABELLED, "has labels and several series"),
        (EDITED.format("x=0") + LABELLED, "reference_x is 16, but .* with labels .* the default, from 0 to 0"),
        ("from experiments.sweeps.width import plan", "'width' is taken"),
        (NAMED.replace('"own"', "3"), "the sweep has a setting of a wrong type .Sweep.name: expected str, got 3"),
        (EDITED.format("scope=['rover']"), "trial at 8 has a setting of a wrong type: a list instead of a tuple"),
        (EDITED.format("scope=3"), "trial at 8 has a setting of a wrong type .Point.scope: expected a list, got 3"),
        (TWICE, "returned 2 points at 8, point, seed 0; give each a position or a series of its own"),
    ],
)
def test_a_file_that_is_no_axis_is_refused(text, words, tmp_path):
    path = tmp_path / "mine.py"
    path.write_text(text)
    with pytest.raises(ConfigError, match=words):
        plan_sweeps(STUDY, [str(path)])
    with pytest.raises(ConfigError, match="no such file"):
        plan_sweeps(STUDY, [str(tmp_path / "other.py")])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            OWN.format("replace(\n        trial, tua=x)"),
            "line 6: TypeError: Trial.__init__() got .* argument 'tua'; correct the file",
        ),
        (OWN.replace("gain=", "gian="), "line 5: TypeError: make_sweep() got .*'gian'; correct the file"),
        (
            "def plan(study):\n    assert study.seed",
            "line 2: AttributeError: 'Study' object has no attribute 'seed'; correct the file",
        ),
        ("def plan(study):\n    assert study.unseen", "line 2: AssertionError; correct the file"),
        ("import replace", "line 1: ModuleNotFoundError: No module named 'replace'; correct the file"),
        ("\ndef plan(study)\n    return 3", "line 2: SyntaxError: expected ':'; correct the file"),
        (
            "def plan(): return 3",
            "mine.py: TypeError: plan() takes 0 positional arguments but 1 was given; correct the file",
        ),
        (OWN.format("replace(trial, train=replace(trial.train, steps=0))"), "line 6: train.steps must be at least 1"),
    ],
)
def test_what_a_file_raises_names_its_line(text, words, tmp_path, capsys):
    """It was a traceback, as of a bug of the program."""
    path = tmp_path / "mine.py"
    path.write_text(text)
    assert main(["sweep", str(path), "--preset", "smoke", "--dry-run"]) == 2
    said = capsys.readouterr().err
    assert re.search(words.replace("(", r"\(").replace(")", r"\)"), said) and said.count(str(path)) == 1
    with pytest.raises(ConfigError) as debugged:
        main(["--debug", "sweep", str(path), "--preset", "smoke", "--dry-run"])
    assert debugged.value.__cause__ is not None
