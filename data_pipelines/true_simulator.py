"""Ground-truth simulators with the interface of the learned simulator (documented in `hma_jax.simulator`).

Owns what all true simulators share; each subclass says which robots it has and opens their worlds.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from typing import Any, Generic, Protocol, TypeVar, get_args

import numpy as np

from data_pipelines.sources.rlds.images import fit_image
from hma_jax.config import require
from hma_jax.config.base import require_choice
from hma_jax.simulator.interface import (
    HISTORY,
    Actions,
    WholeNumbers,
    chosen_episodes,
    each_action,
    each_beginning,
    read_only,
    require_actions_between,
    whole_numbers,
)
from hma_jax.simulator.robots import Outside, Robot
from hma_jax.simulator.starts import Start


class World(Protocol):
    """One robot's world. Its episodes are started from a seed and advance by native actions, float32 [A]."""

    def reset(self, seed: int) -> None: ...

    def step(self, action: np.ndarray) -> None: ...

    def get_state(self) -> Any:
        """A copy of the state from which `set_state` continues."""

    def set_state(self, state: Any) -> None: ...

    def render(self) -> np.ndarray:
        """uint8 [H, W, 3]."""
        ...

    def success(self) -> bool:
        """Whether the task's goal is reached now."""
        ...


W = TypeVar("W", bound=World)


class TrueSimulator(ABC, Generic[W]):
    """B episodes of true robots; nothing is random after the start."""

    def __init__(self, robots: Sequence[Robot], *, episodes: int = 1, image_size: int = 64, outside: Outside = "clip"):
        """Raises ConfigError for robots that do not exist here or have other actions."""
        [episodes] = whole_numbers("episodes", [episodes])
        require(episodes >= 1, f"a simulator needs at least 1 episode, got {episodes}")
        require_choice(outside, get_args(Outside), "outside")
        for robot in robots:
            dim = self.dims().get(robot.name)
            require(dim is not None, f"robot {robot.name!r} has no true simulator here")
            require(
                robot.action_dim == dim,
                f"{robot.name} has {dim} action values in the true simulator, not {robot.action_dim}",
            )
        self.robots = {robot.name: robot for robot in robots}
        self.starts: tuple[Start, ...] = ()
        self.outside, self.image_size = outside, image_size
        self.clipped: list[tuple[str, ...]] = [()] * episodes
        self._worlds: list[tuple[W, Robot] | None] = [None] * episodes
        self._before: list[list[Any]] = [[] for _ in range(episodes)]
        self._images = np.zeros((episodes, image_size, image_size, 3), np.uint8)

    @staticmethod
    @abstractmethod
    def dims() -> dict[str, int]:
        """{name: A} of every robot that exists."""

    @abstractmethod
    def open_world(self, name: str) -> W:
        """A world of this robot; it is reset before anything else."""

    def close_world(self, world: W) -> None:
        """Closes a world that is not used again."""

    def __deepcopy__(self, memo: dict[int, Any]) -> TrueSimulator:
        """Returns itself, as a learned simulator does."""
        return self

    def __len__(self) -> int:
        return len(self._worlds)

    @property
    def images(self) -> np.ndarray:
        return read_only(self._images)

    def reset(
        self,
        starts: Start | Sequence[Start],
        *,
        seeds: int | WholeNumbers = 0,
        episodes: WholeNumbers | None = None,
    ) -> np.ndarray:
        """Begins at the last frames of `starts`, which must have the seeds of their episodes; `seeds` are checked, but
        have no effect."""
        which = chosen_episodes(episodes, len(self))
        each, _ = each_beginning(starts, seeds, len(which))
        for start in each:
            require(start.robot in self.robots, f"no robot {start.robot!r} here; there are {', '.join(self.robots)}")
            require(start.seed is not None, f"the start of {start.robot} has no seed for the true simulator")
            require_actions_between(start, self.robots[start.robot])
        for b, start in zip(which, each, strict=True):
            now = self._worlds[b]
            again = now is not None and now[1].name == start.robot
            if not again:
                self._leave(b)
            world = now[0] if again else self.open_world(start.robot)
            self._worlds[b], self._before[b] = (world, self.robots[start.robot]), []  # closed if this fails
            world.reset(start.seed)
            for action in start.actions:
                world.step(action)
        self._draw(which)
        return self.images

    def step(self, actions: Actions) -> np.ndarray:
        each = each_action(actions, len(self))
        asked, clipped = {}, [()] * len(self)
        for b, action in enumerate(each):
            if action is None:
                continue
            world, robot = self._begun(b)
            chunk, beyond = robot.clip_to_range(robot.chunk(action), self.outside)
            clipped[b] = tuple(np.array(robot.dimensions)[beyond].tolist())
            asked[b] = world, chunk
        self.clipped = clipped
        for b, (world, chunk) in asked.items():
            self._before[b].append(world.get_state())
            del self._before[b][:-HISTORY]  # the same number as a learned simulator keeps
            for action in chunk:
                world.step(action)
        self._draw(asked)
        return self.images

    def rewind(self, frames: int, episodes: WholeNumbers | None = None) -> np.ndarray:
        [frames] = whole_numbers("frames", [frames])
        which = chosen_episodes(episodes, len(self))
        worlds = {b: self._begun(b)[0] for b in which}
        for b in which:
            max_rewind = self.max_rewind(b)
            require(
                0 <= frames <= max_rewind, f"in episode {b} at most {max_rewind} frames can be rewound, got {frames}"
            )
        for b, world in worlds.items():
            before = self._before[b]
            if frames:
                world.set_state(before[-frames])
                del before[-frames:]
        self._draw(worlds)
        return self.images

    def max_rewind(self, b: int) -> int:
        """Number of frames by which episode b can be rewound."""
        self._begun(b)
        return len(self._before[b])

    def state(self, b: int) -> Any:
        """A copy of the true state of episode b."""
        return self._begun(b)[0].get_state()

    def success(self) -> np.ndarray:
        """bool [B]: the task's goal is reached now."""
        return np.array([world is not None and world[0].success() for world in self._worlds])

    def close(self) -> None:
        """Ends all episodes, and releases their renderers."""
        for b in range(len(self)):
            self._leave(b)

    def _leave(self, b: int) -> None:
        left, self._worlds[b] = self._worlds[b], None
        if left is not None:
            self.close_world(left[0])

    def _begun(self, b: int) -> tuple[W, Robot]:
        [b] = chosen_episodes([b], len(self))
        world = self._worlds[b]
        require(world is not None, f"episode {b} has not begun; reset it first")
        return world

    def _draw(self, which: Iterable[int]) -> None:
        images = self._images.copy()  # callers keep the frames they were given
        for b in which:
            images[b] = fit_image(self._begun(b)[0].render(), self.image_size)
        self._images = images


def judge_by_state(simulator: TrueSimulator) -> tuple[np.ndarray, np.ndarray]:
    """A judge of true episodes: success (1) and the end of the episode when the task's goal is reached."""
    done = simulator.success()
    return done.astype(float), done
