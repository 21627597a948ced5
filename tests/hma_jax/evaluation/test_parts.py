"""An evaluation that was stopped goes on after the batches that it had measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hma_jax.evaluation import evaluate as evaluation
from hma_jax.evaluation.evaluate import Evaluation, evaluate
from hma_jax.evaluation.parts import Parts
from tests.hma_jax.evaluation.fakes import make_batches
from tests.hma_jax.evaluation.test_evaluate import CONFIG, EVAL, TOKENIZER
from tests.tiny import TABLE, lively_params


@pytest.fixture(scope="module")
def params():
    return lively_params(CONFIG)[1]


@pytest.fixture
def measured(monkeypatch) -> list[int]:
    """Sizes of the batches that are sent to the devices."""
    sent, put = [], evaluation._put
    monkeypatch.setattr(evaluation, "_put", lambda batch, *how: sent.append(len(batch["tokens"])) or put(batch, *how))
    return sent


def run(params, parts: Parts | None, stop_after: int = 100) -> Evaluation:
    def progress(done: int) -> None:
        if done >= stop_after:
            raise KeyboardInterrupt

    return evaluate(
        params, CONFIG, TABLE, TOKENIZER, make_batches(CONFIG, each=6), EVAL, progress=progress, parts=parts
    )


def equal(one: Evaluation, other: Evaluation) -> bool:
    assert one.windows.names == other.windows.names and one.summary == other.summary
    for name, values in one.windows.metrics.items():
        np.testing.assert_array_equal(values, other.windows.metrics[name])
    for name, clips in one.samples.items():
        for kind, clip in clips.items():
            np.testing.assert_array_equal(clip, other.samples[name][kind])
    return one.samples.keys() == other.samples.keys()


def test_what_was_measured_before_a_stop_is_not_measured_again(params, measured, tmp_path: Path):
    whole, directory = run(params, None), tmp_path / "evaluating"
    with pytest.raises(KeyboardInterrupt):
        run(params, Parts(directory, lambda: "a", every=0), stop_after=8)
    measured.clear()
    parts = Parts(directory, lambda: "a", every=0)
    assert equal(run(params, parts), whole) and measured == [4], "the last of three batches"
    measured.clear()
    assert equal(run(params, Parts(directory, lambda: "another model", every=0)), whole) and measured == [4, 4, 4]
    parts.remove()
    assert not directory.exists()


def test_a_part_that_is_damaged_is_measured_again_and_said(params, measured, tmp_path: Path, caplog):
    whole = run(params, Parts(tmp_path, lambda: "a", every=0))
    (tmp_path / "1.npz").write_bytes((tmp_path / "1.npz").read_bytes()[:100])
    measured.clear()
    assert equal(run(params, Parts(tmp_path, lambda: "a", every=0)), whole) and measured == [4]
    assert "1.npz cannot be read" in caplog.text and "measured again" in caplog.text


def test_a_short_evaluation_writes_no_parts(params, tmp_path: Path):
    run(params, Parts(tmp_path / "evaluating", lambda: "a"))
    assert not (tmp_path / "evaluating").exists()
