"""Results that are kept for the record: nobody edits them, and what can be computed again is.

A study that is kept with its trials (per-window numbers and all) is drawn again, byte for byte. One that is kept as a
table alone cannot be: its files are held by their hashes.
"""

import hashlib
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from experiments.applications import DRIVEN
from experiments.presets import PRESETS
from experiments.report.draw import draw_again
from experiments.rows import read_rows
from experiments.running.ledger import FINISHED
from experiments.running.workspace import Workspace
from hma_jax.training.runs import load_run

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
    rows = read_rows(Workspace(RESULTS / name))
    assert {r.status for r in rows} == {FINISHED}
    assert all(r.metric for r in rows)
    assert len({r.manifest for r in rows}) == 1, "judged on different windows"


@pytest.mark.parametrize("name", STUDIES)
def test_what_is_kept_is_drawn_again(name, tmp_path):
    """Figures from a table; where trials are kept, tables too, byte for byte, and the page's checks of them hold."""
    shutil.copytree(RESULTS / name, tmp_path / name)
    workspace = Workspace(tmp_path / name)
    figures, kept = {p.name for p in workspace.figures.iterdir()}, workspace.trials.exists()
    tables = [*workspace.root.glob("*.csv"), *workspace.root.glob("*.parquet")]
    shutil.rmtree(workspace.figures)
    for path in tables if kept else ():
        path.unlink()
    draw_again(workspace.root)
    assert {p.name for p in workspace.figures.iterdir()} >= figures
    for path in tables:
        before = RESULTS / name / path.name
        same = path.read_bytes() == before.read_bytes()
        assert same or path.suffix == ".parquet" and pq.read_table(path).equals(pq.read_table(before)), path.name
    page = workspace.report.read_text()
    assert not kept or "<li class=bad><span class=mark>\u2717</span><div><b>Every" not in page, "see its page"


def test_the_model_that_is_driven_was_trained_as_its_preset_says():
    run = load_run(RESULTS.parents[1] / DRIVEN)
    assert (run.model, run.train) == (PRESETS["play"].model, PRESETS["play"].train)
