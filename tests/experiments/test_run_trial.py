"""What a trial holds in memory while it is evaluated."""

from __future__ import annotations

import weakref
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

from experiments.running import run_trial as trials
from hma_jax.model.hma import declare_model
from hma_jax.training.loop import FitResult
from hma_jax.training.state import init_state
from tests.experiments.fakes import STUDY
from tests.tiny import TABLE, model_config, train_config

MODEL = model_config(width=8, heads=2)


def test_nothing_but_the_evaluated_weights_is_left_of_a_training_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Moments and last weights lay beside every evaluation: three times what is evaluated."""
    kept, left = [], []

    def train(*_, **__) -> FitResult:
        state = init_state(declare_model(MODEL, TABLE), TABLE, 0)
        state = state._replace(ema=jax.tree.map(lambda x: x + 0, state.params))
        kept.extend(weakref.ref(x) for x in jax.tree.leaves((state.params, state.opt_state, state.ema)))
        return FitResult(state, [1.0, 2.0], 3.0, 4.0, 0)

    def evaluate(names, params, *_, **__) -> SimpleNamespace:
        mine = {id(x) for x in jax.tree.leaves(params)}
        left.append(sum(x() is not None and id(x()) not in mine for x in kept))
        return SimpleNamespace(summary=SimpleNamespace(to_dict=dict))

    monkeypatch.setattr(trials, "open_prepared_data", lambda workspace: None)
    monkeypatch.setattr(trials, "train_trial", train)
    monkeypatch.setattr(trials, "evaluate_on", evaluate)
    monkeypatch.setattr(trials, "write_evaluation", lambda *_: None)
    trial = replace(
        trials.Trial(TABLE.names, None, TABLE.names, MODEL, train_config(), STUDY.eval), measure_untrained=True
    )
    result = trials.run_trial(trial, SimpleNamespace(), tmp_path, begin=lambda prepared: {"table": TABLE})
    assert left == [0, 0]  # of the trained model, and of the untrained one
    assert result["training_loss"]["mean"] == 2 and result["run"]["train_seconds"] == 3
