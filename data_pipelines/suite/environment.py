"""A robot of the suite that can be stepped: the true environment with which a learned simulator is compared."""

from __future__ import annotations

import numpy as np

from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.embodiments import select
from data_pipelines.suite.render import positions_of, render_frames
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.world import State, World
from hma_jax.config import require


class Environment:
    """One episode at a time, at the robot's native rate, its actions in the robot's raw units.

    `reset` with the seed of a recorded episode (`episode_metadata/seed`) and stepping through its
    actions gives back its frames. A state from `get_state` can be set again, any number of times and also in another
    environment of the same robot: the same actions then have the same effects.
    """

    def __init__(self, robot: str | EmbodimentSpec):
        """Raises ConfigError for a name that the suite does not have."""
        self.spec = robot if isinstance(robot, EmbodimentSpec) else select([robot])[0]
        self._world = World(self.spec, [0])

    def reset(self, seed: int) -> None:
        """The start of the episode with this seed: places, goal, light and colours."""
        self._world = World(self.spec, [seed])

    def step(self, action: np.ndarray) -> None:
        """One native step, 1 / spec.hz seconds. Raises ConfigError unless `action` is [A] and finite."""
        action = np.asarray(action, np.float32)
        wanted = (self.spec.action_dim,)
        require(action.shape == wanted, f"{self.spec.name}: an action must have shape {wanted}, got {action.shape}")
        require(bool(np.isfinite(action).all()), f"{self.spec.name}: the action is not finite: {action.tolist()}")
        self._world.step(action[None].astype(np.float64))

    def render(self) -> np.ndarray:
        """The present frame, uint8 [H, W, 3]."""
        world = self._world
        looks = draw_appearance(self.spec, world.state.seeds)
        return render_frames(self.spec, looks, world.goals, world.q, world.objects, np.zeros(1, int))[0]

    def positions(self) -> np.ndarray:
        """float32 [P, 2]: positions in the frame of the points that the spec names, in pixels (column, row)."""
        return positions_of(self.spec, self._world.q, self._world.objects)[0]

    def success(self) -> bool:
        """Whether the task's goal is reached now."""
        return bool(self._world.success()[0])

    def get_state(self) -> State:
        """A copy of everything that `step` changes and `render` shows."""
        return self._world.state

    def set_state(self, state: State) -> None:
        """Continues from a state of the same robot. Raises ConfigError for a state of another shape."""
        have, given = ({k: np.shape(v) for k, v in vars(s).items()} for s in (self._world.state, state))
        require(have == given, f"{self.spec.name}: the state is from another robot: it has shapes {given}, not {have}")
        self._world.state = state
