"""What makes a study's numbers unbelievable shows at the top of its page."""

import csv
import errno
import html
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis import rows
from experiments.analysis.preregistered import FILE as PREREGISTERED
from experiments.analysis.preregistered import ExpectationOutcome, Expected
from experiments.report import validity
from experiments.report.draw import draw
from experiments.running.attempts import RESULT
from experiments.running.result_file import write_result
from experiments.running.trial import trial_id
from experiments.running.workspace import Workspace
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import CONTROL, POINT
from hma_jax.evaluation.summary import summarise
from hma_jax.evaluation.windows import FILE, WindowTable, read_arrow, write_arrow
from tests.experiments.conftest import leave_unrendered
from tests.experiments.fakes import PROVENANCE
from tests.experiments.judged import WIDE, judged_study

SMALL = replace(WIDE, widths=(8, 16))
ITEMS = ("trial", "seeds", "numbers", "untrained", "controls", "copying")
NAMES = dict(zip(ITEMS, (
    "Every planned trial is finished", "At least 3 seeds", "Every number follows", "An untrained model is at chance",
    "Trained without true actions, ΔPSNR is zero", "Prediction beats copying",
), strict=True))  # fmt: skip


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """A small study that all checks pass, drawn."""
    root = tmp_path_factory.mktemp("valid")
    workspace, record = judged_study(root / "study", SMALL)
    with pytest.MonkeyPatch.context() as patch:
        leave_unrendered(patch)
        draw(workspace, record)
    return workspace, record


@pytest.fixture
def copied(study, tmp_path, monkeypatch):
    """Another to spoil; drawn without figures, which take longer than all the rest."""
    monkeypatch.setattr("experiments.report.draw.draw_figures", lambda *_: None)
    shutil.copytree(study[0].root, tmp_path / "copy")
    return Workspace(tmp_path / "copy"), study[1]


def verdicts(workspace):
    """{item: (verdict, text)} of the page's box."""
    page = workspace.report.read_text()
    found = {}
    for item, name in NAMES.items():
        before, _, after = page.partition(f"<b>{name}")
        found[item] = before.rpartition("<li class=")[2].partition(">")[0], after.partition("</div>")[0]
    return found


def trials_of(record, **wanted):
    """Ids of the study's trials at a width, a seed or a role."""
    found = []
    for point in plan_sweeps(record.study, record.axes)[0].points:
        facts = {"width": point.x, "seed": point.trial.train.seed, "role": point.role}
        if all(facts[k] == v for k, v in wanted.items()):
            found.append(trial_id(point.trial, PROVENANCE))
    return found


def rejudge(workspace, id, change):
    """Windows of a trial changed, and all that follows from them made again: nothing but the numbers can tell."""
    directory = workspace.trials / id
    windows = WindowTable.load(directory / FILE)
    metrics = change(dict(windows.metrics))
    windows = replace(windows, metrics={k: v.astype(np.float32).astype(np.float64) for k, v in metrics.items()})
    windows.save(directory / FILE, id)
    result = json.loads((directory / RESULT).read_text())
    result.pop("hash")
    write_result(directory, result | {"evaluation": summarise(windows, 1).to_dict()})


def test_a_good_study_passes_everything(study):
    found = verdicts(study[0])
    assert {v for v, _ in found.values()} == {"good"}, found
    assert "6 of 6 hold" in study[0].report.read_text()
    assert "from 252 windows" in found["numbers"][1]  # seven trials of three robots, six episodes, two windows each


def test_tables_have_the_control_and_what_changes_along_the_axis(study):
    workspace, _ = study
    with open(workspace.controllability) as file:
        rows = [r for r in csv.DictReader(file) if r["metric"] == "delta_psnr"]
    errors = {role: [float(r["errors"]) for r in rows if r["role"] == role] for role in (POINT, CONTROL)}
    assert len(errors[POINT]) == len(errors[CONTROL]) == 3
    assert max(errors[POINT]) > 10 and max(map(abs, errors[CONTROL])) < 4
    page = workspace.report.read_text()
    assert "From 8 to 16, paired by window: nats per token \u22120." in page and "seeds (3) and episodes" in page


def test_drawing_again_changes_no_byte_of_the_tables(copied):
    workspace, record = copied
    tables = [workspace.results, workspace.fits, workspace.changes, workspace.controllability]
    before = [path.read_bytes() for path in tables]
    for path in tables:
        path.unlink()
    draw(workspace, record)
    assert [path.read_bytes() for path in tables] == before


def test_a_deleted_trial_is_missed(copied):
    workspace, record = copied
    shutil.rmtree(workspace.trials / trials_of(record, width=8, seed=1)[0])
    draw(workspace, record)
    found = verdicts(workspace)
    assert found["trial"] == ("bad", ".</b> 6 of 7 finished, 1 missing.")
    assert found["seeds"][0] == "bad" and "2 to 3 per point" in found["seeds"][1]


def test_a_seed_that_was_dropped_from_the_study_is_missed(copied):
    workspace, record = copied
    draw(workspace, replace(record, study=replace(SMALL, seeds=(0, 1))))
    found = verdicts(workspace)
    assert found["trial"][0] == "good"  # all that is planned
    assert found["seeds"][0] == "bad" and "2 per point" in found["seeds"][1]


@pytest.mark.parametrize("column", ["mean", "sem", "n"])
def test_one_digit_of_the_table_is_noticed_and_put_right(copied, column):
    workspace, record = copied
    whole = workspace.results.read_text()
    head, *lines = whole.splitlines()
    at = next(i for i, line in enumerate(lines) if ",overall,psnr," in line)
    cells = lines[at].split(",")
    k = head.split(",").index(column)
    digit = str((int(cells[k][-2]) + 1) % 10)  # the last of seventeen may be none of the number
    cells[k] = cells[k][:-2] + digit + cells[k][-1]
    workspace.results.write_text("\n".join([head, *lines[:at], ",".join(cells), *lines[at + 1 :], ""]))
    draw(workspace, record)
    verdict, text = verdicts(workspace)["numbers"]
    assert verdict == "bad" and "1 line of the table differs" in text and "overall, psnr" in text
    assert workspace.results.read_text() == whole
    draw(workspace, record)
    assert verdicts(workspace)["numbers"][0] == "good"


def test_a_line_taken_out_of_the_table_is_noticed(copied):
    workspace, record = copied
    lines = workspace.results.read_text().splitlines(keepends=True)
    del lines[5]
    workspace.results.write_text("".join(lines))
    draw(workspace, record)
    assert verdicts(workspace)["numbers"][0] == "bad"


@pytest.mark.parametrize("grown", [False, True], ids=["the first", "one of a study that grew"])
def test_a_report_that_ended_between_its_two_tables_is_not_taken_for_an_edited_one(grown, copied, monkeypatch):
    """Rows of all robots were lost, it said, of trials that the second table had never had."""
    workspace, record = copied
    if grown:
        table, new = read_arrow(workspace.robots), trials_of(record, width=16)
        write_arrow(workspace.robots, table.filter([id not in new for id in table["trial"].to_pylist()]))
    else:
        workspace.robots.unlink()
    workspace.results.unlink()

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(rows, "write_arrow", full)
        draw(workspace, record)
    assert workspace.results.exists() and workspace.robots.exists() == grown
    draw(workspace, record)
    assert verdicts(workspace)["numbers"][0] == "good"


@pytest.mark.parametrize("number", ["mean", "sem"])
def test_results_that_do_not_follow_from_their_windows_are_noticed(copied, number):
    """Though sealed again, as somebody who edits numbers would not do by accident."""
    workspace, record = copied
    directory = workspace.trials / trials_of(record, width=8, seed=0)[0]
    result = json.loads((directory / RESULT).read_text())
    result.pop("hash")
    result["evaluation"][SMALL.datasets[1]]["psnr"][number] += 1e-4
    write_result(directory, result)
    workspace.results.unlink()
    draw(workspace, record)
    verdict, text = verdicts(workspace)["numbers"]
    assert verdict == "bad" and directory.name in text


def test_a_model_without_a_number_of_some_windows_is_named_and_not_compared(copied):
    """Its windows without one were left out of every difference, which favoured it; nothing said so."""
    workspace, record = copied
    broken, *_ = trials_of(record, width=16, seed=0)

    rejudge(workspace, broken, lambda metrics: metrics | {"cross_entropy": without(metrics["cross_entropy"], 3)})
    workspace.results.unlink()
    draw(workspace, record)
    verdict, text = verdicts(workspace)["numbers"]
    assert verdict == "bad" and f"{broken} has no cross_entropy of 3 windows; no difference is taken of these." in text
    said = workspace.report.read_text()
    assert "From 8 to 16, paired by window: ΔPSNR (dB) " in said


def test_means_of_windows_that_some_model_lacks_are_said_to_be_of_the_others(copied):
    """They were said to be in no difference, which left open that means, and counts of robots, leave them out."""
    workspace, record = copied
    sound, broken = (trials_of(record, width=16, seed=seed)[0] for seed in (1, 0))
    for id, lost in ((sound, 0), (broken, 3)):
        rejudge(workspace, id, lambda m, lost=lost: m | {"action_nats": without(0.1 + 0 * m["psnr"], lost)})
    workspace.results.unlink()
    draw(workspace, record)
    verdict, text = verdicts(workspace)["numbers"]
    assert (
        verdict == "bad" and f"{broken} has no action_nats of 3 windows; no difference is taken of these, and" in text
    )
    assert "the means of action_nats are of the other windows." in text


def without(values, first):
    """A copy of `values` whose `first` ones are no numbers."""
    return np.where(np.arange(len(values)) < first, np.nan, values)


def test_trials_that_kept_no_windows_leave_the_question_open(copied):
    workspace, record = copied
    directory = workspace.trials / trials_of(record, width=8, seed=0)[0]
    (directory / FILE).unlink()
    result = json.loads((directory / RESULT).read_text())
    result.pop("hash")
    write_result(directory, result)
    draw(workspace, record)
    verdict, text = verdicts(workspace)["numbers"]
    assert verdict == "open" and "1 of 7" in text and "5 of 6 hold, 1 is undecided." in workspace.report.read_text()


def test_a_control_that_follows_actions_is_bad(copied):
    workspace, record = copied
    [control] = trials_of(record, role=CONTROL)
    rejudge(workspace, control, lambda m: m | {"delta_psnr": m["delta_psnr"] + 0.5})
    workspace.results.unlink()
    draw(workspace, record)
    assert verdicts(workspace)["controls"][0] == "bad"


@pytest.mark.parametrize("rounded", [-2.4e-7, 0.0])
def test_what_rounding_leaves_of_a_control_is_none_of_its_effects(copied, rounded):
    """It scatters so little that its standard errors would say that the model follows actions."""
    workspace, record = copied
    [control] = trials_of(record, role=CONTROL)
    rejudge(workspace, control, lambda m: m | {"delta_psnr": np.full_like(m["delta_psnr"], rounded)})
    workspace.results.unlink()
    draw(workspace, record)
    assert verdicts(workspace)["controls"] == (
        "good", ".</b> One control: +0.0 standard errors from zero (allowed: 3 each, 2 for the mean).",
    )  # fmt: skip


def test_a_control_of_one_episode_per_robot_leaves_the_question_open(copied):
    workspace, record = copied
    [control] = trials_of(record, role=CONTROL)
    directory = workspace.trials / control
    result = json.loads((directory / RESULT).read_text())
    result.pop("hash")
    windows = WindowTable.load(directory / FILE)
    windows = replace(windows, episode=np.zeros_like(windows.episode), start=np.arange(len(windows)))
    windows.save(directory / FILE, control)
    write_result(directory, result | {"evaluation": summarise(windows, 1).to_dict()})
    workspace.results.unlink()
    draw(workspace, record)
    assert verdicts(workspace)["controls"] == (
        "open", ".</b> The errors of 1 of 1 controls are unknown: one episode per robot gives none.",
    )  # fmt: skip


def test_robots_worse_than_copying_are_named(copied):
    workspace, record = copied
    for id in trials_of(record, width=16):
        last = np.arange(36) >= 24
        rejudge(workspace, id, lambda m, last=last: m | {"psnr": m["psnr"] - 5 * last})
    workspace.results.unlink()
    draw(workspace, record)
    verdict, text = verdicts(workspace)["copying"]
    assert (
        verdict == "bad"
        and "On 2 of 3 robots the reference is ahead, on 2 by more" in text
        and f"Not on {SMALL.datasets[2]}" in text
    )


def test_an_untrained_model_that_knows_something_is_bad(copied):
    workspace, record = copied
    [directory] = [workspace.trials / id for id in trials_of(record, width=16, seed=0)[:1]]
    result = json.loads((directory / RESULT).read_text())
    result.pop("hash")
    for stats in result["untrained"].values():
        stats["cross_entropy"]["mean"] -= 0.1
    write_result(directory, result)
    workspace.results.unlink()
    draw(workspace, record)
    assert verdicts(workspace)["untrained"][0] == "bad"


def test_the_box_counts_the_intervals_of_the_author(copied):
    """It spoke of predictions of fits alone, which held, above pages on which most of the author's did not."""
    workspace, record = copied
    workspace.predictions.mkdir(exist_ok=True)
    (workspace.predictions / PREREGISTERED).write_text(
        "sweep,series,x,against,metric,mean,low,high,commit\n"
        "width,,8,,cross_entropy,50,40,60,abc1234\nwidth,,8,16,cross_entropy,0,-9,9,abc1234\n"
    )
    draw(workspace, record)
    page = html.unescape(workspace.report.read_text())
    assert "<b>The author's preregistered intervals contain the outcomes.</b> 1 of 2 do." in page
    assert "6 of 7 hold, 1 does not." in page


WIDTH = Expected("width", "", "8", "", "cross_entropy", 5, 4, 6, "abc1234")


@pytest.mark.parametrize(
    ("observed", "verdict", "said"),
    [
        ({"width": [5, 4], "horizon": [6]}, "good", "3 of 3 do: width 2 of 2, horizon 1 of 1."),
        ({"width": [5, 7], "horizon": [3]}, "bad", "1 of 3 do: width 1 of 2, horizon 0 of 1."),
        ({"width": [5, None]}, "open", "1 of 1 do. 1 more has no outcome yet."),
        ({"width": [7, None, None]}, "bad", "0 of 1 do. 2 more have no outcome yet."),
        ({"width": [None]}, "open", "None has an outcome yet."),
    ],
)  # fmt: skip
def test_intervals_of_the_author_hold_if_all_contain_what_came(observed, verdict, said):
    outcomes = [
        ExpectationOutcome(replace(WIDTH, sweep=axis), value, 0.1, 3, 3) for axis, v in observed.items() for value in v
    ]
    [check] = validity.check_expected(outcomes)
    assert (check.verdict, check.text) == (verdict, said)
    assert validity.check_expected([]) == []
