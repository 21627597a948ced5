"""The moving average of the weights."""

from __future__ import annotations

from pathlib import Path

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.model.hma import declare_model
from hma_jax.training.average import update_average
from hma_jax.training.loop import LoopOptions
from hma_jax.training.reading import list_steps, load_items
from hma_jax.training.state import TrainState, state_shapes
from hma_jax.training.train import train_model
from tests.tiny import SMALLER, TABLE, batches, model_config, train_config

MODEL = model_config(**SMALLER)
DECAY = 0.2  # of the later updates; that of the first ones is lower
CONFIG = train_config(ema_decay=DECAY, batch=4, steps=4)


def averaged(series: list[np.ndarray]) -> np.ndarray:
    """The average of weights before and after each step."""
    found = series[0]
    for weights, decay in zip(series[1:], (1 / 10, 2 / 11, DECAY, DECAY), strict=True):
        found = decay * found + (1 - decay) * weights
    return found


def run(run_dir: Path, config, steps_of=batches(MODEL, 4), **options):
    return train_model(MODEL, TABLE, config, steps_of, run_dir=run_dir, provenance={}, options=LoopOptions(**options))


def one_robot_at_a_time(start: int):
    """The first robot alone in even steps, the second in odd ones, the third never."""
    for step, batch in enumerate(batches(MODEL, 4)(start), start):
        yield batch | {"embodiment": np.full_like(batch["embodiment"], step % 2)}


@pytest.fixture(scope="module")
def states(tmp_path_factory: pytest.TempPathFactory) -> list[TrainState]:
    """The states before and after each of four steps."""
    run_dir, declared = tmp_path_factory.mktemp("run"), declare_model(MODEL, TABLE)
    run(run_dir, CONFIG, one_robot_at_a_time, checkpoint_every=1, keep_checkpoints=4)
    shapes = state_shapes(declared, TABLE, average=True)
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    params = declared.shapes(jax.tree.map(lambda _: device, shapes.params))
    first = declared.init(CONFIG.seed)
    found = [TrainState(0, first, None, first)]
    for step in list_steps(run_dir / "checkpoints"):
        items = load_items(run_dir / "checkpoints" / str(step), {"params": params, "ema": params})
        found.append(TrainState(step, items["params"], None, items["ema"]))
    return found


def test_the_average_starts_as_the_weights_and_moves_towards_them(states: list[TrainState]):
    tables = [np.asarray(s.params["embed"]["tables"], np.float64) for s in states]
    got = np.asarray(states[-1].ema["embed"]["tables"])
    np.testing.assert_allclose(got, averaged(tables), rtol=1e-6, atol=1e-8)
    assert np.abs(got - tables[-1]).max() > 1e-5
    assert states[-1].weights is states[-1].ema and states[-1]._replace(ema=None).weights is states[-1].params


def test_the_average_of_every_robot_goes_on_in_every_step(states: list[TrainState]):
    """Else that of a robot that is seldom present would be of weights from long before the learning rate fell."""
    stems = [[np.asarray(x["stem"]["into"]["kernel"]) for x in (s.params, s.ema)] for s in states]
    for robot in range(2):
        want = averaged([weights[robot] for weights, _ in stems])  # in every second step these stand still
        np.testing.assert_allclose(stems[-1][1][robot], want, rtol=1e-6, atol=1e-9)
    for weights, average in stems:  # never trained: not even rounded
        np.testing.assert_array_equal(average[2], weights[2])


@pytest.mark.slow
def test_the_average_is_resumed_and_changes_nothing_else(tmp_path: Path):
    def dying(start: int):
        for number, batch in enumerate(batches(MODEL, 4)(start), start + 1):
            if number > 3:
                raise OSError("the disk went away")
            yield batch

    whole = run(tmp_path / "whole", CONFIG)
    with pytest.raises(OSError, match="went away"):
        run(tmp_path / "broken", CONFIG, dying, checkpoint_every=2)
    resumed = run(tmp_path / "broken", CONFIG)
    assert resumed.resumed_from == 2
    for a, b in zip(jax.tree.leaves(resumed.state), jax.tree.leaves(whole.state), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    plain = run(tmp_path / "plain", train_config(batch=4, steps=4))
    assert plain.losses == whole.losses
    assert plain.state.ema is None and not (tmp_path / "plain" / "checkpoints" / "4" / "ema").exists()
    params, bigger = (sum(x.nbytes for x in jax.tree.leaves(t)) for t in (plain.state.params, whole.state))
    assert sum(x.nbytes for x in jax.tree.leaves(plain.state)) == bigger - params


def test_a_short_run_s_average_holds_nothing_of_the_initial_weights():
    """A thousandth of them a step was left out, so that after 1,200 steps 30 % of each weight was its draw."""
    update = jax.jit(update_average)
    average, weights = {"w": np.ones(1)}, {"w": np.zeros(1)}
    for step in range(30):
        average = update(average, weights, 0.999, step)
    assert 0 < average["w"] < 1e-7


def test_a_decay_of_one_never_moves_and_is_refused():
    with pytest.raises(ConfigError, match=r"train.ema_decay must lie in \[0, 1\)"):
        train_config(ema_decay=1.0)
