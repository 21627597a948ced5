"""What tests of committed endurance tables share: the tables' rows, and how pages show them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from experiments.applications.endurance.tables import over_robots, read_rows
from tests.pages import table

ROOT = Path(__file__).parents[4]
RESULTS = ROOT / "experiments" / "results" / "endurance"
PAGE, SMALL = ROOT / "docs" / "endurance.md", ROOT / "docs" / "endurance_small.md"
"""Of the model that `make play` serves, and of smaller ones."""

SHOWN = {
    "psnr": 1, "psnr_still": 1, "tool_found": 2, "tool_close": 2, "object_found": 2, "object_close": 2, "follows": 2,
    "moves": 2,
}  # fmt: skip
"""Measures of the page's tables, in the order of their columns, and digits."""


def check_tables(page: Path, shown: Mapping[str, Callable[[str], list[dict]]]) -> None:
    """Every line of the page's tables is the mean over eight robots; `shown`: header -> a line's rows by its first
    cell."""
    for header, rows_of in shown.items():
        for label, cells in table(page, header).items():
            mine = rows_of(label)
            assert len({row["robot"] for row in mine}) == 8, f"{label}: all eight robots"
            for (measure, digits), cell in zip(SHOWN.items(), cells, strict=True):
                mean, half, robots = over_robots(mine, measure)
                assert cell == ("" if robots < 2 else f"{mean:.{digits}f} ± {half:.{digits}f}"), (label, measure)


def by_label(rows: list[dict]) -> Callable[[str], list[dict]]:
    """Those whose variant and seconds a first cell names."""
    return lambda label: [row for row in rows if f"{row['variant']}, {_seconds(row)}" == label]


def words_of(page: Path) -> str:
    return " ".join(page.read_text().split())


def rows_of_trained() -> list[dict]:
    """Of all models that were watched for a minute from the same four starts of each robot."""
    names = (
        "chained", "weighed", "long", "mended", "coarse", "resumed", "displaced", "larger", "hours", "grown", "drawn",
        "kept",
    )  # fmt: skip
    return [row for name in names for row in read_rows(RESULTS / f"{name}.csv")]


def gains(name: str, measure: str, beside: str = "shipped") -> tuple[float, float]:
    """(mean, half its interval) over robots, from 20 to 60 s, from the same starts; of the variance, how much nearer it
    is."""

    def goodness(row: dict) -> float:
        return -abs(row[measure] - 1) if measure == "variance" else row[measure]

    rows = rows_of_trained()
    cells = {(row["variant"], row["robot"], row["start"], row["part"]): row for row in rows if row["part"] > 1}
    assert len(cells) == 13 * 8 * 4 * 2
    apart = [
        {**row, measure: goodness(row) - goodness(cells[beside, *place])}
        for (variant, *place), row in cells.items()
        if variant == name
    ]
    mean, half, robots = over_robots(apart, measure)
    assert robots == 8
    return mean, half


def mean_in(minute: int, of: Mapping[tuple, dict], measure: str) -> float:
    """The mean of a measure over eight robots in a minute, which is the last part of a row's key."""
    mean, _, robots = over_robots([row for (*_, at), row in of.items() if at == minute], measure)
    assert robots == 8
    return mean


def percent_in(minute: int, of: Mapping[tuple, dict], measure: str = "object_found") -> str:
    return f"{100 * mean_in(minute, of, measure):.0f}"


def by_place(name: str, variant: str | None = None) -> dict[tuple, dict]:
    """(robot, start, part) -> row of a committed table, of one variant where it has several."""
    rows = [row for row in read_rows(RESULTS / name) if variant in (None, row["variant"])]
    places = {(row["robot"], row["start"], row["part"]): row for row in rows}
    assert len(places) == len(rows)
    return places


def of_three_starts(name: str) -> dict[tuple, dict]:
    """(robot, start, minute) -> row of the served model over ten minutes: "grown", or with tokens "drawn"."""
    return by_place(f"{name}_ten.csv") | by_place("more_starts.csv", name)


def gain(measure: str, pairs: list[tuple[dict, dict]]) -> tuple[float, float]:
    """(mean, half its interval) over robots, of how much more the first of each pair of rows has than the second."""
    mean, half, robots = over_robots([{**row, measure: row[measure] - other[measure]} for row, other in pairs], measure)
    assert robots == 8
    return mean, half


def _seconds(row: dict) -> str:
    end = row["part"] * row["seconds"]
    return f"{end - row['seconds']:.0f} to {end:.0f}"
