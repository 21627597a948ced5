"""What is found of action dimensions whose effect is known."""

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.evaluation.effects import Change, Difference, find_effects, make_loss
from hma_jax.evaluation.metrics import factored_cross_entropy
from hma_jax.generation import next_frame_outputs
from tests.tiny import TABLE, lively_params, random_batch, shallow_config

DIM, WINDOWS = 4, 48
WEIGHTS = np.array([1.0, 0.5, -0.8, 0.0])
"""Of the dimensions in what is seen; the last one does nothing."""

OTHER = np.array([0.3, 1.0, 0.6, 0.0])
"""Likewise, in the other direction that is seen."""

UNITS = np.array([1.0, 3.0, 0.2, 1.0])
"""Typical size of each dimension."""


def recorded(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(WINDOWS, 5, 2, DIM)) * UNITS


def find(given: np.ndarray):
    """Of actions `given` for frames that `recorded` ones made, by a model that knows the law exactly, but for noise.

    What is seen is a place in two dimensions, so that exchanged effects can be told apart; a model has nothing to say
    of actions that are far from all it was trained on.
    """
    law = np.stack([WEIGHTS / UNITS, OTHER / UNITS])
    noise = np.random.default_rng(1).normal(size=(WINDOWS, 5, 2)) * 0.3
    seen = np.tanh(recorded().mean(2) @ law.T) + noise

    def judge(actions: np.ndarray) -> np.ndarray:
        return ((np.tanh(actions.mean(2) @ law.T) - seen) ** 2).mean((1, 2))

    return find_effects(judge, given, np.zeros(DIM), np.repeat(np.arange(WINDOWS // 2), 2).tolist())


def test_where_nothing_is_wrong_nothing_is_found():
    effects = find(recorded())
    assert all(effect.better is None for effect in effects)
    assert {e.dimension for e in effects if e.ignored} == {3}
    assert effects[0].worth.mean > 0 and effects[0].worth.errors > 5


@pytest.mark.parametrize(
    "wrong, expected",
    [
        (Change(1, "negated"), {1: Change(1, "negated")}),
        (Change(0, "scaled", 50.0), {0: Change(0, "scaled", 1 / 50)}),
        (Change(2, "scaled", 1 / 50), {2: Change(2, "scaled", 50.0)}),
        (Change(0, "swapped", other=2), {d: Change(0, "swapped", other=2) for d in (0, 2)}),
    ],
    ids=["negated", "too large", "too small", "swapped"],
)
def test_what_is_wrong_is_found_and_nothing_else(wrong: Change, expected: dict[int, Change]):
    effects = find(wrong(recorded(), np.zeros(DIM)))
    assert {e.dimension: e.better for e in effects if e.better is not None} == expected


def test_few_episodes_say_less_and_too_few_nothing():
    """A mean is as many standard errors from zero as Student's t with so few episodes makes of it."""
    few, many = Difference(0.3, 0.1, 4), Difference(0.3, 0.1, 1000)
    assert many.errors == pytest.approx(3.0, abs=0.02) and 1.8 < few.errors < 2.0
    assert Difference(-0.3, 0.1, 4).errors == -few.errors and Difference(0.0, 0.0, 4).errors == 0.0
    assert Difference(-0.3, 0.0, 4).errors == -np.inf  # of every episode alike
    with pytest.raises(ConfigError, match="3 episodes; measuring the effect of actions needs at least 4"):
        find_effects(lambda actions: np.ones(len(actions)), recorded(), np.zeros(DIM), np.arange(WINDOWS) % 3)


def find_by_distance(given: np.ndarray, truth: np.ndarray, mean: np.ndarray):
    """Of actions `given` for `truth`, [WINDOWS, 5, 2, A], by the squared distance, every window an episode."""
    return find_effects(lambda actions: ((actions - truth) ** 2).mean((1, 2)).sum(-1), given, mean, range(WINDOWS))


@pytest.mark.parametrize("dims", [2, 11], ids=["all pairs", "doubtful pairs alone"])
def test_worth_is_that_of_actions_in_which_all_is_changed_back(dims: int):
    sizes, mean = np.array([1.0, 2.0] + [1.0] * (dims - 2)), np.linspace(-0.5, 0.5, dims)
    truth = np.random.default_rng(0).normal(size=(WINDOWS, 5, 2, dims)) * sizes
    effects = find_by_distance(Change(0, "swapped", other=1)(truth, mean), truth, mean)
    assert [e.better for e in effects] == [Change(0, "swapped", other=1)] * 2 + [None] * (dims - 2)
    np.testing.assert_allclose([e.worth.mean for e in effects], ((mean - truth) ** 2).mean((0, 1, 2)))


def test_a_dimension_is_changed_once():
    """Ninety times too large it is divided by 50, and what is left not by 3, which would come nearer still."""
    truth = np.random.default_rng(0).normal(size=(WINDOWS, 5, 2, 2))
    effects = find_by_distance(truth * [90, 1], truth, np.zeros(2))
    assert [e.better for e in effects] == [Change(0, "scaled", 1 / 50), None]


def test_a_value_that_is_merely_harmful_is_not_changed():
    """The less of dimension 1 the better: held still it costs least, and neither a fiftieth nor a smaller dimension in
    its place is what it should have been."""
    given = recorded() * [0.01, 1, 1, 1]
    effects = find_effects(lambda actions: np.abs(actions[..., 1]).mean((1, 2)), given, np.zeros(DIM), range(WINDOWS))
    assert all(e.better is None for e in effects)


@pytest.mark.parametrize(("gain", "found"), [(0.5, None), (0.9, Change(0, "negated"))], ids=["2.4", "3.8"])
def test_what_helps_by_less_than_three_errors_is_chance(gain: float, found: Change | None):
    """Of 26 episodes, whose gains lie one on either side of the mean: an error of a fifth."""
    episodes, gains = 26, gain + np.tile([1.0, -1.0], 13)

    def loss_of(actions: np.ndarray) -> np.ndarray:
        at = actions[:, 0, 0, 0]
        return np.where(at == 1, 0.0, np.where(at == -1, -gains, 10.0))

    (effect,) = find_effects(loss_of, np.ones((episodes, 1, 1, 1)), np.zeros(1), range(episodes))
    assert effect.better == found


def test_a_model_that_is_deaf_ignores_every_dimension():
    effects = find_effects(lambda actions: np.ones(len(actions)), recorded(), np.zeros(DIM), range(WINDOWS))
    assert all(effect.ignored for effect in effects)


def test_a_model_that_was_trained_without_actions_listens_to_none():
    config, settings = shallow_config(frames=3), ("passive", "forward")
    (declared, params), batch = lively_params(config), random_batch(0, config, 2)
    losses = [jax.jit(make_loss(config, TABLE, setting)) for setting in settings]
    passive, forward = ([np.asarray(loss(params, batch, x * batch["actions"])) for x in (1, 3)] for loss in losses)
    assert (passive[0] == passive[1]).all() and (forward[0] != forward[1]).all()

    @jax.jit
    def by_hand(params):
        hma, given = declared.merge(params), (batch["actions"], batch["embodiment"])
        followed = batch["tokens"][:, 1:]
        logits = hma.logits(next_frame_outputs(hma, batch["tokens"], *given), followed)
        return factored_cross_entropy(logits, followed).mean((1, 2))

    np.testing.assert_allclose(forward[0], by_hand(params), rtol=1e-5)
    # What stands in the padding of a window is no part of its loss.
    padded = {**batch, "real": np.array([[True, True, False], [True] * 3])}
    other = {**padded, "tokens": np.array(batch["tokens"])}
    other["tokens"][0, 2] = (other["tokens"][0, 2] + 1) % config.factor_vocab
    loss = jax.jit(make_loss(config, TABLE, "forward"))
    np.testing.assert_array_equal(*(loss(params, given, batch["actions"]) for given in (padded, other)))
