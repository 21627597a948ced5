"""Episodes of one simulator: recorded with a behaviour policy, or replayed from a recorded start.

Owns the loop and what is recorded. `Simulator` is the interface of a backend.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Protocol

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.simulators.behaviour import Behaviour, Expert
from data_pipelines.simulators.spec import SimSpec


class Simulator(Protocol):
    """A running environment of one embodiment. Frame t is the state before action t.

    Everything except `start` and `close` requires an earlier `start`.
    """

    low: np.ndarray  # float64 [A], of actions
    high: np.ndarray  # float64 [A]

    def start(self, env: str, seed: int) -> None:
        """A new episode; a function of both arguments, whatever ran before."""

    def rest(self) -> np.ndarray:
        """float64 [A]: the neutral action, the mean of the random walk."""

    def expert(self) -> Expert | None:
        """The expert for the episode just started; None if there is none."""

    def step(self, action: np.ndarray) -> tuple[float, bool]:
        """(reward, whether the goal is reached) after an action, float64 [A]."""

    def physics(self) -> np.ndarray:
        """float64 [P]: the state of the physics, from which it can continue."""

    def set_physics(self, values: np.ndarray) -> None:
        """Inverse of `physics`."""

    def vector(self) -> np.ndarray:
        """float32 [S]: the robot's observed state (proprioception); S is the same in all of its environments."""

    def frame(self) -> np.ndarray:
        """uint8 [size, size, 3], RGB."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class StartState:
    """The start of an episode: the environment and seed to reset with, then the physics state to set."""

    env: str
    seed: int
    physics: tuple[float, ...]

    def to_json(self) -> str:
        """Text from which the same numbers are read again, to the last bit."""
        return json.dumps(asdict(self), separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str | bytes) -> StartState:
        """Raises DataError for text that is no start state."""
        try:
            values = json.loads(text)
            return cls(values["env"], int(values["seed"]), tuple(map(float, values["physics"])))
        except (ValueError, KeyError, TypeError) as error:
            raise DataError(
                f"{text[:80]!r} is not a start state ({error}). Use episode_metadata/start of a dataset that `hma "
                "data sim` wrote."
            ) from error


@dataclass(frozen=True)
class Episode:
    """N native frames and the actions after them."""

    start: StartState
    frames: np.ndarray  # uint8 [N, size, size, 3]
    states: np.ndarray  # float32 [N, S]
    actions: np.ndarray  # float32 [N, A], raw units
    rewards: np.ndarray  # float32 [N], after each action
    success: bool  # reached at any time


@dataclass(frozen=True)
class Replay:
    """What other actions lead to. There is one more frame than actions: the last shows the end."""

    frames: np.ndarray  # uint8 [N + 1, size, size, 3]
    rewards: np.ndarray  # float32 [N]
    success: bool


def record_episode(simulator: Simulator, spec: SimSpec, env: str, seed: int) -> Episode:
    """One episode of `env` under the dataset's behaviour: a function of the arguments."""
    rng = np.random.default_rng([seed, 1])
    steps = int(rng.integers(spec.steps[0], spec.steps[1] + 1))
    simulator.start(env, seed)
    start = StartState(env, seed, tuple(simulator.physics().tolist()))
    behaviour = Behaviour(spec, simulator.low, simulator.high, simulator.rest(), simulator.expert(), rng)
    frames, states, actions, rewards, reached = [], [], [], [], False
    for _ in range(steps):
        frames.append(simulator.frame())
        states.append(simulator.vector())
        actions.append(behaviour.act(reached))
        reward, done = simulator.step(actions[-1].astype(np.float64))
        rewards.append(reward)
        reached = reached or done
    return Episode(
        start, np.stack(frames), np.stack(states), np.stack(actions), np.asarray(rewards, np.float32), reached
    )


def replay_episode(simulator: Simulator, start: StartState, actions: Sequence[np.ndarray]) -> Replay:
    """Runs `actions` [N, A] (raw units) from `start`, in float32 and within the robot's bounds, as recorded actions
    were run. Raises DataError for actions or a start of another robot."""
    actions = np.asarray(actions, np.float32)
    simulator.start(start.env, start.seed)
    size = len(simulator.low)
    if actions.ndim != 2 or actions.shape[1] != size:
        raise DataError(f"actions of shape {actions.shape} cannot be run: this robot needs [N, {size}].")
    expected = len(simulator.physics())
    if len(start.physics) != expected:
        raise DataError(
            f"{start.env}: the start state has {len(start.physics)} numbers, but the simulator needs {expected}. It "
            "was recorded with another robot or another version of the simulator."
        )
    simulator.set_physics(np.asarray(start.physics))
    frames, rewards, reached = [simulator.frame()], [], False
    # Bounds are rounded as actions are: a recorded one may lie beyond the exact bound by that much.
    low, high = np.float32(simulator.low), np.float32(simulator.high)
    for action in np.clip(actions, low, high).astype(np.float64):
        reward, done = simulator.step(action)
        rewards.append(reward)
        reached = reached or done
        frames.append(simulator.frame())
    return Replay(np.stack(frames), np.asarray(rewards, np.float32), reached)
