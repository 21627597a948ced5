"""Results that are kept for the record: nobody edits them, and what can be computed again is.

A study that is kept with its trials (per-window numbers and all) is drawn again, byte for byte. One that is kept as a
table alone cannot be: its files are held by their hashes.
"""

import hashlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from experiments.report.draw import draw, draw_again
from experiments.rows import read_csv
from experiments.running.ledger import FINISHED
from experiments.running.workspace import Workspace, load_record

RESULTS = Path(__file__).parents[2] / "experiments" / "results"
STUDIES = sorted(path.parent.name for path in RESULTS.glob("*/study.json"))
SUMS = RESULTS / "SHA256SUMS"
"""Of tables whose trials are not kept; made again, when a study is, by `sha256sum */*.csv` where they lie."""


def sums() -> dict[str, str]:
    return {name: digest for digest, name in (line.split() for line in SUMS.read_text().splitlines())}


def test_tables_are_those_that_were_kept():
    kept = set(sums())
    tables = {str(p.relative_to(RESULTS)) for p in RESULTS.glob("*/*.csv") if not (p.parent / "trials").exists()}
    assert kept == tables, "a table came or went: make experiments/results/SHA256SUMS again"
    for name, digest in sums().items():
        assert hashlib.sha256((RESULTS / name).read_bytes()).hexdigest() == digest, f"{name} was changed"


@pytest.mark.parametrize("name", sorted(p.parent.name for p in RESULTS.glob("*/results.csv")))
def test_every_trial_of_a_table_is_finished_and_judged(name):
    rows = read_csv(RESULTS / name / "results.csv")
    assert {r.status for r in rows} == {FINISHED}
    assert all(r.metric for r in rows)
    assert len({r.manifest for r in rows}) == 1, "judged on different windows"


def test_the_first_axis_by_how_much_data_a_robot_has_is_as_the_page_on_designs_says():
    folder = RESULTS / "cpu-full-horizon"
    windows = {name: d["windows"] for name, d in json.loads((folder / "data.json").read_text()).items()}
    rows = [r for r in read_csv(folder / "results.csv") if r.metric == "cross_entropy" and r.role == "point"]
    page = (RESULTS.parents[1] / "docs/designs.md").read_text()
    for least, most in ((0, 400), (400, 2000), (2000, 10**9)):
        mine = [r for r in rows if least <= windows.get(r.scope, -1) < most]
        means = [np.mean([r.mean for r in mine if r.x == n]) for n in (500, 1000, 2000, 4000, 8000, 16_000)]
        line = " | ".join([str(len({r.scope for r in mine})), *(f"{mean:.2f}" for mean in means)])
        assert f"| {line} |" in page, line


@pytest.mark.parametrize("name", STUDIES)
def test_figures_are_drawn_again_from_what_is_kept(name, tmp_path):
    shutil.copytree(RESULTS / name, tmp_path / name)
    figures = {p.name for p in (RESULTS / name / "figures").iterdir()}
    shutil.rmtree(tmp_path / name / "figures")
    workspace = Workspace(tmp_path / name)
    draw_again(workspace.root)
    assert {p.name for p in workspace.figures.iterdir()} >= figures
    assert workspace.results.read_bytes() == (RESULTS / name / "results.csv").read_bytes()


def test_tables_follow_from_the_trials_that_are_kept(tmp_path):
    for name in (n for n in STUDIES if (RESULTS / n / "trials").exists()):
        shutil.copytree(RESULTS / name, tmp_path / name)
        workspace = Workspace(tmp_path / name)
        tables = list(workspace.root.glob("*.csv"))
        for path in tables:
            path.unlink()
        draw(workspace, load_record(workspace))
        for path in tables:
            assert path.read_bytes() == (RESULTS / name / path.name).read_bytes(), path.name
        page = workspace.report.read_text()
        assert "<li class=bad><span class=mark>\u2717</span><div><b>Every" not in page, f"{name}: see its page"
