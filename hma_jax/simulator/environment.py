"""Simulators as Gymnasium environments (extra `simulator`): one robot, raw actions in, images out.

Importing this module registers `HMA/Robot-v0`, alone and as a vector environment:

    gymnasium.make("hma_jax.simulator.environment:HMA/Robot-v0", run="RUN", robot="pusher_sand")
    gymnasium.make_vec("hma_jax.simulator.environment:HMA/Robot-v0", num_envs=8, run="RUN", robot="pusher_sand")

Instead of `run`, `simulator` takes anything with the interface of `interface.AnySimulator`, true simulators too.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import gymnasium
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike

from hma_jax.config import ConfigError, require
from hma_jax.config.base import require_choice
from hma_jax.simulator.interface import AnySimulator, Judge, each_start, no_judge, require_frame_steps, whole_numbers
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

ID = "HMA/Robot-v0"
MAX_STEPS = 200
"""Frames after which an episode is truncated, unless `max_episode_steps` is passed to `gymnasium.make` or
`gymnasium.make_vec`."""

RENDER_MODES = (None, "rgb_array")


def action_space(robot: Robot) -> gymnasium.spaces.Box:
    """Raw actions [A], between the smallest and largest values that the robot was given in recordings."""
    return gymnasium.spaces.Box(np.array(robot.low, np.float32), np.array(robot.high, np.float32), dtype=np.float32)


def observation_space(simulator: AnySimulator) -> gymnasium.spaces.Box:
    """Frames uint8 [H, W, 3]."""
    return gymnasium.spaces.Box(0, 255, simulator.images.shape[1:], np.uint8)


_driven_by: WeakKeyDictionary[AnySimulator, object] = WeakKeyDictionary()
"""Simulator -> the key of the environment that began its episodes; other environments must not step them."""


class _Task:
    """What both environments need: a simulator, one of its robots, the starts of its episodes and the judge."""

    def __init__(
        self,
        episodes: int,
        run: str | Path | None,
        robot: str | None,
        simulator: AnySimulator | None,
        starts: Sequence[Start] | None,
        judge: Judge,
        options: dict[str, Any],
    ):
        require((run is None) != (simulator is None), "an environment needs either `run` or `simulator`")
        require(
            "max_steps" not in options,
            "max_steps is not an option: set the length of an episode with Gymnasium's max_episode_steps",
        )
        require(
            "episodes" not in options,
            "episodes is not an option: gymnasium.make makes one, gymnasium.make_vec as many as num_envs",
        )
        told = ", ".join(options)
        require(
            run is not None or not options, f"{told}: only for loading a `run`; a given `simulator` is used unchanged"
        )
        _refuse_forked(simulator)
        if simulator is None:
            simulator = Simulator.load(run, episodes=episodes, **options)
        require_frame_steps(simulator, "an environment")
        require(len(simulator) == episodes, f"the simulator must have {episodes} episodes, but has {len(simulator)}")
        starts = each_start(getattr(simulator, "starts", ()) if starts is None else starts, 1)
        names = [name for name in simulator.robots if any(s.robot == name for s in starts)]
        require(
            bool(names),
            "there are no starts, so no episode can begin: give `starts`, a run with starts beside it, or a "
            "`simulator` that has starts. For a run of `hma train`, experiments.simulators."
            f"make_simulator({'RUN' if run is None else str(run)!r}, episodes={episodes}) makes one that starts at held-out "
            "recordings",
        )
        robot = names[0] if robot is None else robot
        self.simulator, self.judge, self._key = simulator, judge, object()
        require(robot in names, f"no start of robot {robot!r}; there are starts of {', '.join(names)}")
        self.robot = simulator.robots[robot]
        self.starts = [start for start in starts if start.robot == robot]

    def at_its_rate(self, metadata: dict[str, Any]) -> dict[str, Any]:
        """`metadata` with the frames per second of the robot's own time, for recorders of videos, where it is known."""
        rate = self.robot.hz / self.robot.stride
        return metadata | ({"render_fps": int(rate) if rate.is_integer() else rate} if rate else {})

    def clipped(self) -> np.ndarray:
        """bool [B, A]: which action values of the last step lay outside the range."""
        return np.array([[name in names for name in self.robot.dimensions] for names in self.simulator.clipped])

    def begin(
        self, rngs: Sequence[np.random.Generator], episodes: Sequence[int], options: dict[str, Any] | None
    ) -> np.ndarray:
        """Begins `episodes`, with a start and a seed drawn from each of `rngs`; `options` may name the start. From then
        on other environments cannot step the simulator."""
        _refuse_forked(self.simulator)
        if len(episodes) < len(self.simulator):
            self._refuse_others_episodes()
        chosen, seeds = [], []
        for rng in rngs:
            drawn = int(rng.integers(len(self.starts)))
            number = (options or {}).get("start", drawn)
            usable = isinstance(number, (int, np.integer)) and 0 <= number < len(self.starts)
            require(usable, f"there are {len(self.starts)} starts, counted from 0; there is no start {number!r}")
            chosen.append(self.starts[number])
            seeds.append(int(rng.integers(2**32)))
        images = self.simulator.reset(chosen, seeds=seeds, episodes=episodes)
        _driven_by[self.simulator] = self._key
        if hasattr(self.judge, "begin"):
            self.judge.begin(self.simulator, episodes)
        return images

    def step(self, actions: Iterable[ArrayLike], ended: Sequence[int] = ()) -> np.ndarray:
        """As the simulator's `step`, in which the episodes `ended` wait. Raises ConfigError if the action of another
        one is None: it would wait too, but the step would count."""
        self._refuse_others_episodes()
        given = [None if b in ended else action for b, action in enumerate(actions)]
        missing = [b for b, action in enumerate(given) if action is None and b not in ended]
        require(not missing, f"an environment needs an action for every step, but that of episode {missing} is None")
        return self.simulator.step(given)

    def judged(self) -> tuple[np.ndarray, np.ndarray]:
        """What the judge says: (rewards [B], bool [B]). Raises ConfigError for anything else."""
        rewards, done = map(np.asarray, self.judge(self.simulator))
        count = len(self.simulator)
        require(
            rewards.shape == done.shape == (count,) and rewards.dtype.kind in "fiub" and done.dtype == bool,
            f"a judge must return rewards, numbers [{count}], and whether the episodes are over, bool [{count}]; it "
            f"returned {rewards.dtype} {list(rewards.shape)} and {done.dtype} {list(done.shape)}",
        )
        if not np.isfinite(rewards).all():
            raise ConfigError(f"the rewards of a judge must be finite, got {rewards}")
        return rewards, done

    def _refuse_others_episodes(self) -> None:
        """Raises ConfigError if another environment began the simulator's episodes: stepping would continue those under
        this environment's actions."""
        require(
            _driven_by.get(self.simulator, self._key) is self._key,
            "another environment has begun its episodes in this one's simulator, where this one's are lost: give each "
            "environment a simulator of its own, or leave out vectorization_mode (make_vec then steps all episodes in "
            "one batch)",
        )


def _refuse_forked(simulator: AnySimulator | None) -> None:
    """Raises ConfigError where a model (None: one to be loaded) would wait for ever: a forked process has JAX's state,
    but not its threads."""
    if simulator is None or isinstance(simulator, Simulator):
        require(
            Simulator.made_in in (None, os.getpid()),
            "this process was forked from one that had made a model's simulator, and JAX does not work in forked "
            "processes: leave out vectorization_mode (make_vec then steps all episodes in one batch), or spawn processes",
        )


class RobotEnv(gymnasium.Env):
    """One episode of one robot. A step is a frame of the model, during which the action is held. Episodes are truncated
    by Gymnasium's `TimeLimit`, in which `gymnasium.make` wraps the environment.

    `reset(options={"start": i})` begins at start i, otherwise at a randomly drawn one. The `judge` gives rewards and
    ends episodes. `info["clipped"]`, bool [A], says which action values lay outside the range; `robot.dimensions` names
    them.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4}

    def __init__(
        self,
        run: str | Path | None = None,
        robot: str | None = None,
        *,
        simulator: AnySimulator | None = None,
        starts: Sequence[Start] | None = None,
        judge: Judge = no_judge,
        render_mode: str | None = None,
        **options: Any,
    ):
        """`options` are passed to `Simulator.load`. Raises ConfigError."""
        require_choice(render_mode, RENDER_MODES, "render_mode")
        self._task = _Task(1, run, robot, simulator, starts, judge, options)
        self.robot = self._task.robot
        self.render_mode, self.metadata = render_mode, self._task.at_its_rate(self.metadata)
        self.action_space = action_space(self.robot)
        self.observation_space = observation_space(self._task.simulator)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        return self._task.begin([self.np_random], [0], options)[0].copy(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        image = self._task.step([action])[0].copy()
        rewards, done = self._task.judged()
        return image, float(rewards[0]), bool(done[0]), False, {"clipped": self._task.clipped()[0]}

    def render(self) -> np.ndarray | None:
        return self._task.simulator.images[0].copy() if self.render_mode == "rgb_array" else None


class RobotVectorEnv(VectorEnv):
    """Many episodes of one robot in one batch. An episode that has ended begins again in the next step, which ignores
    its action (Gymnasium's NEXT_STEP).

    `reset(seed=[...])` seeds each episode separately: it is then as in `RobotEnv` with that seed. None keeps the
    seeding of an episode. `reset(options={"reset_mask": mask})` restarts only the episodes that `mask`, bool
    [num_envs], marks. `info["clipped"]`, bool [num_envs, A], is that of `RobotEnv`; `info["_clipped"]` marks the
    episodes that stepped.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 4, "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(
        self,
        num_envs: int = 1,
        run: str | Path | None = None,
        robot: str | None = None,
        *,
        simulator: AnySimulator | None = None,
        starts: Sequence[Start] | None = None,
        judge: Judge = no_judge,
        max_episode_steps: int | None = None,
        render_mode: str | None = None,
        **options: Any,
    ):
        """As `RobotEnv`; episodes are truncated after `max_episode_steps` (None: MAX_STEPS)."""
        [longest] = whole_numbers("max_episode_steps", [MAX_STEPS if max_episode_steps is None else max_episode_steps])
        require(longest >= 1, f"an episode has at least 1 step, got max_episode_steps={longest}")
        require_choice(render_mode, RENDER_MODES, "render_mode")
        self._task = _Task(num_envs, run, robot, simulator, starts, judge, options)
        self.robot = self._task.robot
        self.num_envs, self.render_mode, self._longest = num_envs, render_mode, longest
        self.metadata = self._task.at_its_rate(self.metadata)
        self.single_action_space = action_space(self.robot)
        self.single_observation_space = observation_space(self._task.simulator)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._steps = np.zeros(num_envs, int)
        self._over = np.zeros(num_envs, bool)
        self._rngs: list[np.random.Generator] = []  # of each episode; one shared generator unless seeded separately

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        which = self._marked(options)
        self._seed(seed, which)
        images = self._task.begin([self._rngs[b] for b in which], which, options).copy()
        self._steps[which], self._over[which] = 0, False
        return images, {}

    def _marked(self, options: dict[str, Any] | None) -> list[int]:
        """The episodes that a reset begins. Raises ConfigError for an unusable mask."""
        if options is None or "reset_mask" not in options:
            return list(range(self.num_envs))
        mask = np.asarray(options["reset_mask"])
        require(
            mask.dtype == bool and mask.shape == (self.num_envs,) and bool(mask.any()),
            f"reset_mask must be {self.num_envs} truth values, at least one true, got {options['reset_mask']!r}",
        )
        return np.flatnonzero(mask).tolist()

    def _seed(self, seed: int | Sequence[int | None] | None, which: Sequence[int]) -> None:
        """Seeds the episodes `which` with their entries of `seed`."""
        if np.ndim(seed) == 0:
            super().reset(seed=seed)
            new = [None if seed is None else self.np_random] * self.num_envs
        else:
            require(len(seed) == self.num_envs, f"{self.num_envs} episodes need as many seeds, got {len(seed)}")
            new = [None if number is None else np_random(number)[0] for number in seed]
        known = self._rngs or [self.np_random] * self.num_envs
        self._rngs = [new[b] if b in which and new[b] is not None else known[b] for b in range(self.num_envs)]

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        again = self._over.copy()
        which = np.flatnonzero(again).tolist()
        self._task.step(actions, which)
        info = {"clipped": self._task.clipped(), "_clipped": ~again}
        rewards, done = self._task.judged()  # before ended episodes restart: starts are not judged
        if which:
            self._task.begin([self._rngs[b] for b in which], which, None)
        self._steps = np.where(again, 0, self._steps + 1)
        terminated = done & ~again
        truncated = ~again & (self._steps >= self._longest)
        self._over = terminated | truncated
        return self._task.simulator.images.copy(), np.where(again, 0.0, rewards), terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        return tuple(self._task.simulator.images.copy()) if self.render_mode == "rgb_array" else None


gymnasium.register(
    ID,
    entry_point="hma_jax.simulator.environment:RobotEnv",
    vector_entry_point="hma_jax.simulator.environment:RobotVectorEnv",
    max_episode_steps=MAX_STEPS,
)
