"""Episodes that are run again."""

import numpy as np

from data_pipelines.simulators import select
from data_pipelines.simulators.episode import record_episode, replay_episode
from tests.data_pipelines.simulators.points import Points

(SPEC,) = select(["aloha"])


class Rounded(Points):
    """Its bounds are no float32 numbers: rounded, some are wider."""

    def __init__(self):
        super().__init__(SPEC, size=2)
        arm = np.linspace(-1.1, 1.3, SPEC.action_dim)
        self.low, self.high, self.executed = arm - 0.7, arm + 0.7, []

    def step(self, action):
        self.executed.append(action)
        return super().step(action)

    def vector(self):
        return self.x.astype(np.float32)


def test_recorded_actions_are_executed_again_to_the_last_bit():
    first, again = Rounded(), Rounded()
    recorded = record_episode(first, SPEC, SPEC.envs[0], seed=5)
    replay_episode(again, recorded.start, recorded.actions)
    beyond = (np.array(first.executed) > first.high) | (np.array(first.executed) < first.low)
    assert beyond.any(), "no action was rounded past a bound, so nothing is tested"
    np.testing.assert_array_equal(again.executed, first.executed)


def test_actions_beyond_the_bounds_are_executed_at_them():
    simulator = Rounded()
    start = record_episode(simulator, SPEC, SPEC.envs[0], seed=5).start
    simulator.executed.clear()
    replay_episode(simulator, start, [np.full(SPEC.action_dim, 9.0), np.full(SPEC.action_dim, -9.0)])
    np.testing.assert_array_equal(simulator.executed, np.float32([simulator.high, simulator.low]))
