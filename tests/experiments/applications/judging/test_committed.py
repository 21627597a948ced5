"""The judgements that are committed: table, summary and docs/judging.md say the same."""

import json
from pathlib import Path

import pytest

from experiments.applications.judging.agreement import pearson, rate_interval, share, spearman
from experiments.applications.judging.outcomes import read_outcomes, successes
from experiments.applications.judging.summary import COLUMNS, COMPARED, shown

ROOT = Path(__file__).parents[4]
RESULTS = sorted((ROOT / "experiments" / "results").glob("judge-*"))


@pytest.mark.parametrize("directory", RESULTS, ids=lambda path: path.name)
def test_the_summary_is_that_of_the_table_and_of_the_page(directory):
    summary = json.loads((directory / "agreement.json").read_text())
    outcomes = read_outcomes(directory / "outcomes.csv")
    names = list(summary["policies"])
    each = {column: successes(outcomes, names, *where) for column, where in COLUMNS.items()}
    page = (ROOT / "docs" / "judging.md").read_text()
    for i, name in enumerate(names):
        for column, found in each.items():
            assert summary["policies"][name][column]["mean"] == pytest.approx(rate_interval(found[i]).mean, abs=1e-4)
        cells = " | ".join(f"{summary['policies'][name][column]['mean']:.2f}" for column in COLUMNS)
        assert f"| {name} | {cells} |" in page, name
    same = each["learned, by head"] == each["true, by state"]
    for kind, among in (("all episodes", same | ~same), ("those that truly succeed", each["true, by state"])):
        alike = share(same, among)
        assert summary["episodes alike"][kind] == {
            key: pytest.approx(getattr(alike, key), abs=1e-4) for key in ("mean", "low", "high")
        }
    true = each["true, by state"].mean(1)
    for kind, column in COMPARED.items():
        agreed = summary["agreement"][kind]["policies and starts"]
        rates = each[column].mean(1)
        if agreed["pearson"]["mean"] is not None:
            assert agreed["pearson"]["mean"] == pytest.approx(pearson(true, rates), abs=1e-4)
            assert agreed["spearman"]["mean"] == pytest.approx(spearman(true, rates), abs=1e-4)
        cells = " | ".join(shown(agreed[name]) for name in ("pearson", "spearman", "rank violation"))
        assert f"| {kind} | {cells} |" in page, kind


@pytest.mark.parametrize("robot", ["pusher_sand", "arm_chalk"])
def test_another_seed_came_as_the_page_says(robot):
    """And within what had been expected."""
    page = (ROOT / "docs" / "judging.md").read_text()
    for name, label in (("pearson", "Pearson"), ("bias", "bias")):
        first, other = (
            json.loads((ROOT / "experiments" / "results" / f"judge-{robot}-reach-{run}" / "agreement.json").read_text())
            ["agreement"]["learned model"]["policies and starts"][name]["mean"]
            for run in ("weighed", "seed1")
        )  # fmt: skip
        (line,) = [line for line in page.splitlines() if line.startswith(f"| {label}, `{robot}` |")]
        expected, came, before = (cell.strip() for cell in line.strip("|").split("|")[1:])
        low, high = map(float, expected.partition("(")[2].strip(")").split(" to "))
        assert (came, before) == (f"{other:.2f}", f"{first:.2f}") and low <= other <= high
