"""Results that are kept for the record: nobody edits them, and what can be computed again is.

A study that is kept with its trials (per-window numbers and all) is drawn again, byte for byte: the largest by `make
test-slow`. All tables are held by their hashes, and trials by those in their results.
"""

import hashlib
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from experiments.analysis.rows import TRAINING
from experiments.applications import DRIVEN
from experiments.presets import PRESETS
from experiments.report.draw import draw_again
from experiments.running.ledger import FINISHED
from experiments.running.result_file import read_result
from experiments.running.workspace import Workspace
from hma_jax.evaluation.measures import METRICS
from hma_jax.training.runs import load_run
from tests.experiments.committed_findings import rows_of

RESULTS = Path(__file__).parents[2] / "experiments" / "results"
STUDIES = sorted(path.parent.name for path in RESULTS.glob("*/study.json"))
LARGEST = "cpu-full"
SUMS = RESULTS / "SHA256SUMS"
"""Of all tables; made again, when one is, by `sha256sum */*.csv */*.parquet` where they lie."""


def sums() -> dict[str, str]:
    return {name: digest for digest, name in (line.split() for line in SUMS.read_text().splitlines())}


def test_tables_are_those_that_were_kept():
    kept = set(sums())
    tables = {str(p.relative_to(RESULTS)) for kind in ("csv", "parquet") for p in RESULTS.glob(f"*/*.{kind}")}
    assert kept == tables, "a table came or went: make experiments/results/SHA256SUMS again"
    for name, digest in sums().items():
        assert hashlib.sha256((RESULTS / name).read_bytes()).hexdigest() == digest, f"{name} was changed"


@pytest.mark.parametrize("name", sorted(p.parent.name for p in RESULTS.glob("*/results.csv")))
def test_every_trial_of_a_table_is_finished_and_judged(name):
    rows, trials = rows_of(name), Workspace(RESULTS / name).trials
    assert {r.status for r in rows} == {FINISHED}
    assert all(r.metric for r in rows)
    assert {r.metric for r in rows if r.scope != TRAINING} <= {*METRICS}, "what is measured can be expected"
    assert len({r.manifest for r in rows}) == 1, "judged on different windows"
    for trial in {r.trial for r in rows} if trials.exists() else ():
        read_result(trials / trial)  # whole, and as it was written


def computed_again(name: str, at: Path) -> Workspace:
    """The study `name`, copied, with nothing that can be computed but what is computed again; its tables are as they
    were."""
    shutil.copytree(RESULTS / name, at / name)
    workspace = Workspace(at / name)
    tables = [*workspace.root.glob("*.csv"), *workspace.root.glob("*.parquet")] if workspace.trials.exists() else []
    shutil.rmtree(workspace.figures)
    for path in tables:
        path.unlink()
    draw_again(workspace.root)
    for path in tables:
        before = RESULTS / name / path.name
        same = path.read_bytes() == before.read_bytes()
        assert same or path.suffix == ".parquet" and pq.read_table(path).equals(pq.read_table(before)), path.name
    return workspace


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.slow] * (n == LARGEST)) for n in STUDIES])
def test_what_is_kept_is_drawn_again(name, tmp_path):
    """Figures from a table; where trials are kept, tables too, byte for byte, and the page's checks of them hold."""
    workspace = computed_again(name, tmp_path)
    assert {p.name for p in workspace.figures.iterdir()} >= {
        p.name for p in Workspace(RESULTS / name).figures.iterdir()
    }
    text = workspace.report.read_text()
    assert not workspace.trials.exists() or "<li class=bad><span class=mark>\u2717</span><div><b>Every" not in text, (
        "see it"
    )


def test_no_two_pages_have_one_title():
    """Studies of the suite's first version had those of today's, with other numbers and no word of it."""
    pages = {path.parent.name: path.read_text() for path in RESULTS.glob("*/report.html")}
    names = {study: re.search("<title>HMA-JAX study: (.*?)</title>", page)[1] for study, page in pages.items()}
    assert len(pages) > 1 and len(set(names.values())) == len(pages), names
    for study, name in names.items():
        assert f"<h1>HMA study <em>{name}</em></h1>" in pages[study]


def test_the_model_that_two_cores_train_was_trained_as_its_preset_says():
    run = load_run(RESULTS / "simulator_weighed", "auto")
    assert run.weights == "ema" and (run.model, run.train) == (PRESETS["play"].model, PRESETS["play"].train)


def test_the_model_that_is_driven_was_trained_as_docs_say():
    run, preset = load_run(RESULTS.parents[1] / DRIVEN, "auto"), PRESETS["play-gpu"]
    masking = replace(preset.train.masking, own_past=1.0, own_past_rounds=3)
    optimizer = replace(preset.train.optimizer, learning_rate=2e-3, decay_fraction=0.5)
    assert run.model == preset.model
    assert run.train == replace(preset.train, steps=1157, masking=masking, optimizer=optimizer)
