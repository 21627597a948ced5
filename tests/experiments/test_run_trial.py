"""What a trial draws, what of it is evaluated, and what it holds in memory meanwhile."""

from __future__ import annotations

import weakref
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from data_pipelines.loading.selection import Drawn, LoaderConfig
from experiments.running import run_trial as trials
from experiments.running.initial_model import add_robots
from experiments.running.trial import loader_of
from hma_jax.config import MaskingConfig
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.training.loop import FitResult
from hma_jax.training.state import init_state
from tests.experiments.fakes import PROVENANCE, STUDY
from tests.tiny import TABLE, model_config, train_config

MODEL = model_config(width=8, heads=2)


@dataclass
class Evaluated:
    """A trial that was run without being trained, and what it was evaluated with."""

    result: dict[str, Any] = field(default_factory=dict)
    average: list[np.ndarray] = field(default_factory=list)
    weights: list[list[np.ndarray]] = field(default_factory=list)  # of each evaluation, as `average`
    asked: list[tuple[str, int | None]] = field(default_factory=list)  # (setting, first) of each
    left: list[int] = field(default_factory=list)  # other arrays of the training state that are alive meanwhile


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Evaluated:
    kept, found = [], Evaluated()

    def train(*_, **__) -> FitResult:
        state = init_state(declare_model(MODEL, TABLE), TABLE, 0)
        state = state._replace(ema=jax.tree.map(lambda x: x + 1, state.params))
        found.average = [np.array(x) for x in jax.tree.leaves(state.ema)]
        kept.extend(weakref.ref(x) for x in jax.tree.leaves((state.params, state.opt_state, state.ema)))
        return FitResult(state, [1.0, 2.0], 3.0, 4.0, 0)

    def evaluate(names, params, model, table, prepared, config, setting="forward", *, first=None, **_):
        mine = {id(x) for x in jax.tree.leaves(params)}
        found.left.append(sum(x() is not None and id(x()) not in mine for x in kept))
        found.weights.append([np.array(x) for x in jax.tree.leaves(params)])
        found.asked.append((setting, first))
        return SimpleNamespace(summary=SimpleNamespace(to_dict=dict))

    train_passive = train_config(masking=MaskingConfig(setting="passive"))
    trial = trials.Trial(TABLE.names, None, TABLE.names, MODEL, train_passive, STUDY.eval, measure_untrained=True)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(trials, "open_prepared_data", lambda *_: SimpleNamespace(store=None))
        drawn = SimpleNamespace(drawn=lambda: {"arm": Drawn(3, 12, 1.0)})
        monkeypatch.setattr("data_pipelines.loading.selection.select_windows", lambda *_: drawn)
        monkeypatch.setattr(trials, "train_trial", train)
        monkeypatch.setattr(trials, "evaluate_on", evaluate)
        monkeypatch.setattr(trials, "write_evaluation", lambda *_: None)
        directory = tmp_path_factory.mktemp("trial")
        begin = lambda prepared: {"table": TABLE}
        found.result = trials.run_trial(trial, PROVENANCE, SimpleNamespace(), directory, begin=begin)
    return found


def test_nothing_but_the_evaluated_weights_is_left_of_a_training_state(evaluated: Evaluated):
    """Moments and last weights lay beside every evaluation: three times what is evaluated."""
    assert evaluated.left == [0, 0]  # of the trained model, and of the untrained one
    result = evaluated.result
    assert result["training_loss"]["mean"] == 2 and result["run"]["train_seconds"] == 3
    assert result["trajectories"] == {"arm": 3} and result["mixture"] == {"arm": {"windows": 12, "share": 1.0}}


def test_the_average_of_the_weights_is_evaluated_as_it_was_trained_and_an_untrained_model_beside_it(
    evaluated: Evaluated,
):
    assert evaluated.asked == [("passive", None), ("passive", STUDY.eval.batch)]
    trained, untrained = evaluated.weights
    assert all(map(np.array_equal, trained, evaluated.average))
    assert not any(map(np.array_equal, untrained, evaluated.average))


CHOSEN = trials.Trial(
    ("pusher", "arm"), 3, ("arm",), model_config(frames=5), train_config(batch=7, seed=9, action_scale="quantiles"),
    STUDY.eval, tau=2.0, rate=4.0, weighed="all", shuffle_actions=True, capped=("arm",),
)  # fmt: skip


def test_a_trial_draws_the_windows_that_it_says():
    drawn = loader_of(CHOSEN)
    assert drawn == LoaderConfig(
        frames=5, batch=7, tau=2.0, seed=9, max_trajectories=3, capped=("arm",), datasets=("pusher", "arm"),
        shuffle_actions=True, rate=4.0, weighed="all",
    )  # fmt: skip
    usual = LoaderConfig()
    assert [f.name for f in fields(usual) if getattr(drawn, f.name) == getattr(usual, f.name)] == ["order"]


def test_actions_are_on_the_scale_that_a_trial_asks_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Where it is trained, where it is evaluated, and of robots that are added to a trained model."""
    scales, prepared = [], SimpleNamespace(store=None)

    class Asked(Exception):
        pass

    def table(store, loader, scale="deviation"):
        scales.append(scale)
        raise Asked

    def embodiment(store, name, loader, scale="deviation"):
        table(store, loader, scale)

    monkeypatch.setattr("data_pipelines.loading.selection.training_table", table)
    monkeypatch.setattr("data_pipelines.loading.selection.training_embodiment", embodiment)
    monkeypatch.setattr(trials, "open_prepared_data", lambda *_: prepared)
    for ask in (
        lambda: trials.run_trial(CHOSEN, PROVENANCE, SimpleNamespace(), tmp_path),
        lambda: trials.train_trial(CHOSEN, prepared, tmp_path),
        lambda: add_robots(SimpleNamespace(table=EmbodimentTable(TABLE.entries[:1])), CHOSEN, prepared),
    ):
        with pytest.raises(Asked):
            ask()
    assert scales == ["quantiles"] * 3
