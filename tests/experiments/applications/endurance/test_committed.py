"""The committed tables of how long the shipped model holds, and that docs/endurance.md shows their figures."""

from __future__ import annotations

import csv
from pathlib import Path

from experiments.applications.detector import OUT as DETECTOR
from experiments.applications.detector import WEIGHTS, Detector
from experiments.applications.endurance.tables import over_robots, read_rows

ROOT = Path(__file__).parents[4]
RESULTS = ROOT / "experiments" / "results" / "endurance"
PAGE = ROOT / "docs" / "endurance.md"

SHOWN = {
    "psnr": 1, "psnr_still": 1, "tool_found": 2, "tool_close": 2, "object_found": 2, "object_close": 2, "follows": 2,
    "moves": 2,
}  # fmt: skip
"""Measures of the page's tables, in the order of their columns, and digits."""


def table(header: str) -> dict[str, list[str]]:
    """First cell -> the others, of the page's table whose head begins with `header`."""
    rows = {}
    for line in PAGE.read_text().split(header, 1)[1].splitlines()[2:]:
        if not line.startswith("|"):
            break
        first, *rest = (cell.strip() for cell in line.strip().strip("|").split("|"))
        rows[first] = rest
    assert rows
    return rows


def test_the_page_shows_what_was_measured():
    ten, unlike = (read_rows(RESULTS / name) for name in ("endurance.csv", "unlike.csv"))
    tried = [row for name in ("variants.csv", "own_past.csv") for row in read_rows(RESULTS / name)]
    trained = read_rows(RESULTS / "chained.csv")
    shown = {
        "| minute |": lambda label: [row for row in ten if row["part"] == float(label)],
        "| variant, seconds |": lambda label: [row for row in tried if f"{row['variant']}, {_seconds(row)}" == label],
        "| trained, seconds |": lambda label: [row for row in trained if f"{row['variant']}, {_seconds(row)}" == label],
        "| drive |": lambda label: [row for row in unlike if row["drive"] == label and row["part"] == 3],
    }
    for header, rows_of in shown.items():
        for label, cells in table(header).items():
            mine = rows_of(label)
            assert len({row["robot"] for row in mine}) == 8, f"{label}: all eight robots"
            for (measure, digits), cell in zip(SHOWN.items(), cells, strict=True):
                mean, half, robots = over_robots(mine, measure)
                assert cell == ("" if robots < 2 else f"{mean:.{digits}f} ± {half:.{digits}f}"), (label, measure)


def test_chained_factors_keep_bodies_and_cost_decibels():
    rows, page = read_rows(RESULTS / "chained.csv"), " ".join(PAGE.read_text().split())
    cells = {(row["variant"], row["robot"], row["start"], row["part"]): row for row in rows if row["part"] > 1}
    assert len(cells) == 2 * 8 * 4 * 2
    for measure, digits, words in (
        ("tool_found", 2, "in {} more of the frames"), ("variance", 2, "nearer to the truth's by {}, at the edge of chance"),
        ("tool_close", 2, "better in place ({})"), ("object_found", 2, "than chance allows ({})"),
        ("psnr", 1, "at wrong places cost {} dB"),
    ):  # fmt: skip
        def gain(row, measure=measure):
            return -abs(row[measure] - 1) if measure == "variance" else row[measure]

        apart = [
            {**row, measure: gain(row) - gain(cells["shipped", *place])}
            for (variant, *place), row in cells.items()
            if variant == "chained"
        ]
        mean, half, robots = over_robots(apart, measure)
        sign = "+" if measure == "object_found" else ""
        said = f"{-mean if measure == 'psnr' else mean:{sign}.{digits}f} ± {half:.{digits}f}"
        assert robots == 8 and words.format(said) in page, (measure, said)


def test_what_was_hidden_for_long_does_not_come_back():
    rows, page = read_rows(RESULTS / "hidden.csv"), " ".join(PAGE.read_text().split())
    hidden, control = ([row for row in rows if row["kind"] == kind] for kind in ("hidden", "control"))
    assert len(hidden) == len(control) == 48
    for mine in (hidden, control):
        found, close = ([round(100 * x) for x in over_robots(mine, name)[:2]] for name in ("found", "close"))
        assert f"{found[0]} ± {found[1]} " in page and f"{close[0]} ± {close[1]} %" in page
    short, long = ([r["found"] for r in hidden if (r["gone"] >= 4) == late] for late in (False, True))
    assert f"it is {sum(short):.0f} of {len(short)}, after four or more none of {len(long)}" in page and not sum(long)


def _seconds(row: dict) -> str:
    end = row["part"] * row["seconds"]
    return f"{end - row['seconds']:.0f} to {end:.0f}"


def test_the_detector_finds_what_is_there():
    detector = Detector.load(DETECTOR / WEIGHTS)
    with (DETECTOR / "errors.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["robot"] for row in rows} == set(detector.robots) and len(detector.robots) == 8
    for row in rows:
        if row["frames_of"] == "true":
            assert float(row["within_4px"]) > 0.9 and float(row["median_px"]) < 0.6, row
