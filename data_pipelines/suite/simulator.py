"""The suite's true robots under the interface of the learned simulator: `hma_jax.simulator` says what each call means."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_pipelines.registry.spec import stride_of
from data_pipelines.sources.rlds.images import fit_image
from data_pipelines.suite.controls import Control, Drive
from data_pipelines.suite.embodiments import EMBODIMENTS
from data_pipelines.suite.environment import Environment
from data_pipelines.suite.rollout import episode_seeds, simulate
from data_pipelines.suite.spec import IMAGE_SIZE, EmbodimentSpec
from data_pipelines.suite.world import State
from hma_jax.config import require
from hma_jax.simulator.robots import KEYS, Outside, Robot, rest_of
from hma_jax.simulator.starts import Start

UNITS = {"delta": "per step", "velocity": "per second", "absolute": "position"}
SPECS = {spec.name: spec for spec in EMBODIMENTS}


class SuiteSimulator:
    """B episodes of the suite's robots, as they really go; nothing is random after the start."""

    def __init__(
        self, robots: Sequence[Robot], *, episodes: int = 1, image_size: int = IMAGE_SIZE, outside: Outside = "clip"
    ):
        """Raises ConfigError for robots that the suite has not, or has with other actions."""
        for robot in robots:
            require(robot.name in SPECS, f"the suite has no robot {robot.name!r}: it has no true simulator here")
            dim = SPECS[robot.name].action_dim
            require(robot.action_dim == dim, f"{robot.name} has {dim} action values in the suite, not {robot.action_dim}")
        self.robots = {robot.name: robot for robot in robots}
        self.starts: tuple[Start, ...] = ()
        self.outside, self.image_size = outside, image_size
        self.clipped: list[tuple[str, ...]] = [()] * episodes
        self._worlds: list[tuple[Environment, Robot] | None] = [None] * episodes
        self._before: list[list[State]] = [[] for _ in range(episodes)]
        self._images = np.zeros((episodes, image_size, image_size, 3), np.uint8)

    def __len__(self) -> int:
        return len(self._worlds)

    @property
    def images(self) -> np.ndarray:
        return self._images

    def reset(
        self, starts: Start | Sequence[Start], *, seeds: int | Sequence[int] = 0, episodes: Sequence[int] | None = None
    ) -> np.ndarray:
        """Begins at the last frames of `starts`, which must have the seeds of their episodes; `seeds` have no effect."""
        del seeds
        which = range(len(self)) if episodes is None else episodes
        each = [starts] * len(which) if isinstance(starts, Start) else list(starts)
        require(len(each) == len(which), f"{len(which)} episodes need as many starts, got {len(each)}")
        for b, start in zip(which, each, strict=True):
            require(start.robot in self.robots, f"no robot {start.robot!r} here; there are {', '.join(self.robots)}")
            require(start.seed is not None, f"the start of {start.robot} does not say with which seed the suite makes it")
            world = Environment(start.robot)
            world.reset(start.seed)
            for action in start.actions:
                world.step(action)
            self._worlds[b], self._before[b] = (world, self.robots[start.robot]), []
            self._draw(b, world)
        return self.images

    def step(self, actions: Sequence[np.ndarray | None]) -> np.ndarray:
        require(len(actions) == len(self), f"{len(self)} episodes need as many actions, got {len(actions)}")
        asked, clipped = {}, [()] * len(self)
        for b, action in enumerate(actions):
            if action is None:
                continue
            world, robot = self._begun(b)
            chunk, beyond = robot.confine(robot.chunk(action), self.outside)
            clipped[b] = tuple(np.array(robot.dimensions)[beyond].tolist())
            asked[b] = world, chunk
        self.clipped = clipped
        for b, (world, chunk) in asked.items():
            self._before[b].append(world.get_state())
            for action in chunk:
                world.step(action)
            self._draw(b, world)
        return self.images

    def rewind(self, frames: int, episodes: Sequence[int] | None = None) -> np.ndarray:
        for b in range(len(self)) if episodes is None else episodes:
            world, before = self._begun(b)[0], self._before[b]
            require(0 <= frames <= len(before), f"episode {b} can be taken back by {len(before)} frames, not by {frames}")
            if frames:
                world.set_state(before[-frames])
                del before[-frames:]
            self._draw(b, world)
        return self.images

    def reach(self, b: int) -> int:
        """By how many frames episode b can be taken back."""
        return len(self._before[b])

    def state(self, b: int) -> State:
        """A copy of the true state of episode b."""
        return self._begun(b)[0].get_state()

    def success(self) -> np.ndarray:
        """bool [B]: the task's goal is reached now."""
        return np.array([world is not None and world[0].success() for world in self._worlds])

    def _begun(self, b: int) -> tuple[Environment, Robot]:
        world = self._worlds[b]
        require(world is not None, f"episode {b} has not begun; reset it first")
        return world

    def _draw(self, b: int, world: Environment) -> None:
        images = self._images.copy()
        images[b] = fit_image(world.render(), self.image_size)
        self._images = images


def judge_by_state(simulator: SuiteSimulator) -> tuple[np.ndarray, np.ndarray]:
    """A judge of true episodes: 1 and the end where the task's goal is reached."""
    done = simulator.success()
    return done.astype(float), done


def suite_robot(
    name: str, low: Sequence[float], high: Sequence[float], mean: Sequence[float], stride: int, *, recorded: bool = True
) -> Robot:
    """How a robot of the suite is commanded, given the least, greatest and mean of its recorded actions."""
    spec = SPECS[name]
    names = [f"{control.key} {part}" for control in spec.controls for part in _parts(control)]
    return Robot(
        name, stride, tuple(low), tuple(high), rest_of(low, high, mean), tuple(names),
        unit=UNITS[spec.convention], keeps=spec.convention == "absolute", hz=float(spec.hz), keys=_keys(spec),
        recorded=recorded,
    )  # fmt: skip


def _parts(control: Control) -> Sequence[str]:
    if isinstance(control, Drive):
        return ("left", "right") if control.style == "wheels" else ("forward", "sideways", "turn")
    return ("x", "y") if control.key == "xy" else [str(i + 1) for i in range(control.dim)]


def _keys(spec: EmbodimentSpec) -> tuple[tuple[float, ...], ...]:
    """What right, up, D and W do to each action value; a positive angle turns to the left."""
    if isinstance(spec.controls[0], Drive) and spec.controls[0].style == "wheels":
        turn, ahead = (1.0, -1.0), (1.0, 1.0)
        return turn, ahead, turn, ahead
    turning = spec.body.links[0].kind == "turn"
    signs = [-1.0 if turning and c.key == "joints" else 1.0 for c in spec.controls for _ in range(c.dim)]
    dim = spec.action_dim
    moved = [key % 2 if dim <= 2 else min(key, dim - 1) for key in range(KEYS)]
    return tuple(tuple(sign * (d == at) for d, sign in enumerate(signs)) for at in moved)


def suite_starts(
    name: str, count: int, frames: int, *, stride: int | None = None, seed: int = 0, most: int | None = None
) -> list[Start]:
    """The first `frames` frames of those of the first `count` held-out episodes of a suite made with `seed` that are
    long enough, at most of `most` of them (None: of all).

    A frame is seen every `stride` native steps; None: as nearly twice a second as they can be.
    """
    spec = SPECS[name]
    stride, numbers = stride or stride_of(spec.hz), episode_seeds(spec, count, seed, "val")
    rollout, starts = simulate(spec, numbers), []
    for i, number in enumerate(numbers):
        if len(starts) == most:
            break
        if rollout.lengths[i] <= (frames - 1) * stride:
            continue
        world, images = Environment(spec), []
        world.reset(int(number))
        actions = rollout.actions[i, : (frames - 1) * stride].astype(np.float32)
        for t in range(frames):
            images.append(world.render())
            for action in actions[t * stride : (t + 1) * stride]:
                world.step(action)
        starts.append(Start(name, np.stack(images), actions, int(number)))
    return starts
