"""What a study's author wrote down before, and makes of it, stands with its axis on the page."""

import math
import re
from dataclasses import replace

import pytest

from experiments import run_study
from experiments.analysis.preregistered import (
    FILE,
    ExpectationOutcome,
    Expected,
    compare_expected,
    find_unplanned,
    read_expected,
)
from experiments.analysis.rows import curve, difference, read_rows
from experiments.report.draw import draw
from experiments.report.findings import describe_expected
from experiments.running.launchers.registry import LauncherOptions
from experiments.running.workspace import Workspace
from experiments.study_setup import StudyArguments, make_setup
from experiments.sweeps.registry import plan_sweeps
from hma_jax.config import ConfigError
from tests.experiments.judged import WIDE, judged_study

COLUMNS = "sweep,series,x,against,metric,mean,low,high,commit"
WIDTH = Expected("width", "", "8", "", "cross_entropy", 5.0, 4.0, 6.0, "abc1234")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    workspace, record = judged_study(tmp_path_factory.mktemp("expected") / "study", replace(WIDE, widths=(8, 16)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("experiments.report.draw.draw_figures", lambda *_: None)
        draw(workspace, record)
        yield workspace, record


@pytest.fixture
def rows(study):
    return read_rows(study[0])


def test_an_expectation_meets_the_mean_over_seeds(rows):
    [came] = compare_expected([WIDTH], rows)
    first = curve(rows, "width", "cross_entropy")[0]
    assert (came.observed, came.seed_sem) == (first.mean, first.seed_sem)
    assert came.inside is (4.0 <= first.mean <= 6.0)
    [other] = compare_expected([replace(WIDTH, low=first.mean + 0.1, mean=first.mean + 0.2, high=first.mean + 1)], rows)
    assert other.inside is False


def test_or_the_difference_of_two_points_seed_by_seed(rows):
    [came] = compare_expected([replace(WIDTH, against="16")], rows)
    first, last = curve(rows, "width", "cross_entropy")
    assert (came.observed, came.seed_sem) == difference(first, last)


def test_what_has_not_run_is_open(rows):
    unfinished = [replace(r, metric="", status="missing") for r in rows if r.x == 8]
    [came] = compare_expected([WIDTH], [*(r for r in rows if r.x != 8), *unfinished])
    assert came.observed is None and came.inside is None
    assert compare_expected([replace(WIDTH, sweep="compute")], rows) == []  # an axis that this study does not have
    one = [r for r in rows if r.x == 8 or r.seed == 1]
    [came] = compare_expected([replace(WIDTH, against="16")], [r for r in one if r.x == 16 or r.seed != 1])
    assert came.observed is None  # no seed has both


def test_seeds_are_counted(rows):
    unfinished = [replace(r, metric="", status="missing") if r.seed else r for r in rows]
    [came] = compare_expected([WIDTH], unfinished)
    assert (came.seeds, came.planned) == (1, 3)


def test_some_seeds_alone_may_be_meant(rows, tmp_path):
    (tmp_path / FILE).write_text(
        f"{COLUMNS},seeds\nwidth,,8,,cross_entropy,5,4,6,abc1234,0 2\nwidth,,8,,cross_entropy,5,4,6,abc1234,\n"
    )
    some, every = read_expected(tmp_path / FILE)
    assert some == replace(WIDTH, seeds=(0, 2)) and every == WIDTH
    [came] = compare_expected([some], rows)
    seeds = curve(rows, "width", "cross_entropy")[0].seeds
    assert came.observed == pytest.approx((seeds[0] + seeds[2]) / 2) and (came.seeds, came.planned) == (2, 2)


def test_seeds_that_were_known_are_read_and_must_leave_something_to_predict(tmp_path):
    def read(line: str) -> list[Expected]:
        (tmp_path / FILE).write_text(f"{COLUMNS},seeds,known\nwidth,,8,,cross_entropy,5,4,6,abc1234,{line}\n")
        return read_expected(tmp_path / FILE)

    assert read(",0") == [replace(WIDTH, known=(0,))] and read("0 2,0")[0].known == (0,)
    for wrong in ("0 2,0 2", "0 2,1"):
        with pytest.raises(ConfigError, match="line 2: known must name some of the seeds"):
            read(wrong)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"x": "12"}, "width has no point '12', but 8, 16"),
        ({"against": "wide"}, "width has no point 'wide', but 8, 16"),
        ({"series": "8,000 steps"}, "width, 8,000 steps: no such curve"),
        ({"seeds": (1, 7)}, "width has no seed 7"),
    ],
)
def test_what_is_not_planned_yet_is_open(rows, study, wrong, message):
    """It has to be written down before; until the plan had it, no page was drawn."""
    early = replace(WIDTH, **wrong)
    sweeps = plan_sweeps(study[1].study, study[1].axes)
    assert find_unplanned([WIDTH, early, replace(WIDTH, sweep="compute")], sweeps) == [message]
    [came] = compare_expected([early], rows)
    assert (came.observed, came.planned, came.lacks) == (None, 0, "not planned")


def test_an_axis_that_the_study_does_not_have_yet_is_open(rows):
    """Of a file that had not run there, no page was drawn."""
    own = replace(WIDTH, sweep="smoothing")
    assert find_unplanned([own, replace(own, x="16")], []) == ["no axis 'smoothing'"]
    assert compare_expected([own], rows) == []


def test_expectations_without_an_outcome_are_not_counted(study):
    """The page had "0 of 0 intervals contain the outcome"."""
    [sweep] = [s for s in plan_sweeps(study[1].study, study[1].axes) if s.name == "width"]
    said = describe_expected(sweep, [ExpectationOutcome(WIDTH, None, math.nan, 0, 2, "not run yet")])
    assert "None has an outcome yet." in said and "0 of 0" not in said


def test_what_these_trials_do_not_measure_is_said(rows):
    [came] = compare_expected([replace(WIDTH, metric="lpips")], rows)
    assert came.observed is None and came.lacks == "not measured"


def test_a_study_reads_what_is_expected_before_it_prepares_anything(tmp_path, monkeypatch, capsys):
    """A typo ended it without a page after all trials had run."""
    workspace = Workspace(tmp_path)
    workspace.predictions.mkdir()

    def prepare(*_):
        raise ConfigError("prepares")

    monkeypatch.setattr(run_study, "prepare_apart", prepare)

    def run(line: str) -> str:
        (workspace.predictions / FILE).write_text(f"{COLUMNS}\n{line}\n")
        with pytest.raises(ConfigError) as refused:
            run_study.run_study(
                make_setup(StudyArguments("smoke", tmp_path)), ("width",), again="", launcher_options=LauncherOptions(), retry_failed=False,
                accept_code=False, replace=None,
            )  # fmt: skip
        return str(refused.value)

    assert "line 2: low must not be above" in run("width,,8,,cross_entropy,7,4,6,abc1234")
    assert run("width,,12,,cross_entropy,5,4,6,abc1234") == "prepares"
    said = " ".join(capsys.readouterr().out.split())
    assert (
        f"note: {FILE} predicts points that this study does not plan, so these predictions stay open: "
        "width has no point '12', but"
    ) in said


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("width,,8,,cross_entropy,five,4,6,abc", "line 2: not a prediction"),
        ("width,,8,,cross_entropy,5,4,6", "line 2: not a prediction .it has too few columns"),
        ("width,,8,,cross_entropy,5,4,6,abc,more", "line 2: not a prediction"),
        ("width,,8,,cross_entropy,7,4,6,abc", "line 2: low must not be above mean, and mean not above high"),
        ("width,,8,,cross_entropy,7,4,inf,abc", "line 2: low and high must be finite"),
        ("width,,8,8.0,cross_entropy,0,-1,1,abc", "line 2: x must name a point, and against, .* another point"),
        ("width,,,,cross_entropy,5,4,6,abc", "line 2: x must name a point"),
        ("width,,,8,cross_entropy,0,-1,1,abc", "line 2: x must name a point"),  # was open for ever
        ("width,,8,,cross-entropy,5,4,6,abc", "line 2: no metric 'cross-entropy'; known: cross_entropy"),
        ("width,,8,,loss,5,4,6,abc", "line 2: no metric 'loss'"),  # not over judged robots
    ],
)
def test_a_line_that_cannot_be_read_is_named(tmp_path, line, message):
    path = tmp_path / FILE
    path.write_text(f"{COLUMNS}\n{line}\n")
    with pytest.raises(ConfigError, match=message):
        read_expected(path)


@pytest.mark.parametrize(
    "again",
    [
        "8,,cross_entropy,5,4,6,abc1234,0 2", "8.0,,cross_entropy,9,8,10,def5678,2 0",
        "16,8,cross_entropy,-1,-2,0,abc1234,0 2",
    ],
)  # fmt: skip
def test_a_number_is_expected_once(tmp_path, again):
    """A line that stood twice, and one beside another interval for the same, counted as two."""
    path = tmp_path / FILE
    first = "8,16,cross_entropy,1,0,2" if again.startswith("16,8") else "8,,cross_entropy,5,4,6"
    lines = [f"{COLUMNS},seeds", f"width,,{first},abc1234,0 2", "width,,16,,cross_entropy,5,4,6,abc1234,"]
    path.write_text("\n".join(lines))
    assert len(read_expected(path)) == 2
    path.write_text("\n".join([*lines, f"width,,{again}"]))
    with pytest.raises(
        ConfigError, match=f"{FILE}, line 4: it predicts the same number as line 2, which would count twice"
    ):
        read_expected(path)


def test_the_table_may_come_from_a_spreadsheet_in_utf_8_alone(tmp_path):
    line = f"{COLUMNS}\nwidth,,8,,cross_entropy,5,4,6,abc1234\n"
    (tmp_path / FILE).write_text(line, encoding="utf-8-sig")
    assert read_expected(tmp_path / FILE) == [WIDTH]
    (tmp_path / FILE).write_bytes(line.encode().replace(b"abc", b"\xe4bc"))
    with pytest.raises(ConfigError, match=f"{FILE} is not UTF-8 .*; save it in this encoding"):
        read_expected(tmp_path / FILE)


def test_columns_are_checked(tmp_path):
    (tmp_path / FILE).write_text("sweep,x,mean\nwidth,8,5\n")
    with pytest.raises(ConfigError, match="columns must be"):
        read_expected(tmp_path / FILE)


def test_the_page_shows_both_at_the_axis(study):
    workspace, record = study
    workspace.predictions.mkdir()
    (workspace.predictions / FILE).write_text(
        f"{COLUMNS},seeds,known\nwidth,,8,,cross_entropy,50,40,60,abc1234,,\n"
        "width,,8,16,cross_entropy,0,-9,9,abc1234,,0\nwidth,,64,,cross_entropy,1,0,2,abc1234,,\n"
    )
    workspace.findings.write_text(
        "# What it says\n\nIn short: little.\n\n"
        "## `width`\n\n* **Wide** pays <script>.\n\n| a | b |\n|---|---|\n| 1 | 2 |\n\n"
        "![its figure](figures/width.png)\n\n[a](javascript:alert(1))\n\n## Elsewhere\n\nNothing of `width`.\n\n## <b>"
    )
    draw(workspace, record)
    page = workspace.report.read_text()
    axis, elsewhere = page.index("<h3>Width</h3>"), page.index("<h2>Elsewhere</h2>")
    of_axis = page[axis : page.index("</section>", axis)]
    assert "1 of 2 intervals contain the outcome" in of_axis and "<code>abc1234</code>" in of_axis
    assert "Of 1 of them, 1 of which hold, some seeds were known by then." in of_axis
    assert (
        "not planned" in of_axis
        and "8 minus 16, seed 0 known before" in of_axis
        and re.search(r"50 <span class=sem>\[40, 60\]", of_axis)
    )
    assert "<strong>Wide</strong> pays &lt;script&gt;." in of_axis and "<td>1</td>" in of_axis
    assert "its figure" not in page and axis < elsewhere
    assert "In short: little." in page and "<h2>&lt;b&gt;</h2>" in page and 'href="javascript' not in page
