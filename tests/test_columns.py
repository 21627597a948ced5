"""Every column of the tables that a study writes is explained in docs/statistics.md."""

from __future__ import annotations

import csv
import re
from dataclasses import fields
from pathlib import Path

import pyarrow.parquet as pq

from experiments.analysis.compare import Difference

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "statistics.md"


def columns_of(path: Path) -> list[str]:
    if path.suffix == ".parquet":
        return pq.read_schema(path).names
    with open(path, newline="") as file:
        return next(csv.reader(file))


def test_every_column_is_explained():
    table = PAGE.read_text().split("| column | meaning |")[1].split("\n\n")[0]
    rows = [row.split("|")[1] for row in table.splitlines() if row.startswith("| `")]
    explained = {name for row in rows for name in re.findall("`([a-z_]+)`", row)}
    study = ROOT / "experiments" / "results" / "cpu-full"
    written = {field.name for field in fields(Difference)}
    for path in (*study.glob("*.csv"), study / "robots.parquet"):
        written |= set(columns_of(path))
    assert written == explained
