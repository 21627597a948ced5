"""What robots do: experts that err, wandering that is smooth and stays in bounds."""

from __future__ import annotations

import numpy as np

from data_pipelines.simulators import select
from data_pipelines.simulators.behaviour import LEVELS, SECONDS_AFTER_SUCCESS, Behaviour, OrnsteinUhlenbeck

(SPEC,) = select(["robosuite_panda_lift"])
LOW, HIGH, REST = -np.ones(7), np.ones(7), np.zeros(7)
EXPERT = np.full(7, 0.25)


def actions(seed: int, expert: bool, steps: int = 400, reached: bool = False) -> tuple[np.ndarray, float]:
    act = (lambda: EXPERT) if expert else None
    behaviour = Behaviour(SPEC, LOW, HIGH, REST, act, np.random.default_rng(seed))
    return np.stack([behaviour.act(reached) for _ in range(steps)]), behaviour.level


def test_wandering_is_smooth_and_has_the_spread_it_was_given():
    wander = OrnsteinUhlenbeck(3, steps=20, rng=np.random.default_rng(0))
    path = np.stack([wander.step() for _ in range(20_000)])[200:]
    assert abs(path.std() - 1) < 0.1
    assert abs(np.diff(path, axis=0).std() - np.sqrt(2 / 20)) < 0.03


def test_some_experts_are_left_alone_and_others_err():
    by_level = {}
    for seed in range(40):
        done, level = actions(seed, expert=True)
        by_level.setdefault(level, []).append(np.abs(done - EXPERT).mean())
    assert set(by_level) == set(LEVELS)
    means = [np.mean(by_level[level]) for level in LEVELS]
    assert means[0] == 0 and means == sorted(means) and means[-1] > 0.2


def test_after_its_success_an_expert_wanders():
    done, _ = actions(0, expert=True, reached=True)
    settled = round(SECONDS_AFTER_SUCCESS * SPEC.hz)
    assert np.abs(np.diff(done[settled + 1 :], axis=0)).min(axis=0).max() > 0


def test_actions_stay_in_bounds_and_follow_the_seed():
    done, _ = actions(3, expert=False)
    assert done.dtype == np.float32 and np.abs(done).max() <= 1
    np.testing.assert_array_equal(done, actions(3, expert=False)[0])
    assert not np.array_equal(done, actions(4, expert=False)[0])
