"""The interface that learned and true simulators share: code that steps one can step the other."""

from __future__ import annotations

import operator
import reprlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Protocol

import jax
import numpy as np
from numpy.typing import ArrayLike

from hma_jax.config import ConfigError, require
from hma_jax.config.base import require_seed
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start

Actions = Sequence[ArrayLike | None] | np.ndarray | jax.Array
"""One entry per episode: an array of numbers, or None for an episode that waits."""

WholeNumbers = Sequence[int] | np.ndarray
"""Numbers or seeds of episodes."""


class AnySimulator(Protocol):
    """B episodes that begin at recorded starts and advance frame by frame; `Simulator` documents the methods."""

    @property
    def robots(self) -> Mapping[str, Robot]: ...

    @property
    def clipped(self) -> Sequence[tuple[str, ...]]: ...

    def __len__(self) -> int: ...

    @property
    def images(self) -> np.ndarray:
        """uint8 [B, H, W, 3]."""
        ...

    def reset(
        self,
        starts: Start | Sequence[Start],
        *,
        seeds: int | WholeNumbers = 0,
        episodes: WholeNumbers | None = None,
    ) -> np.ndarray: ...

    def step(self, actions: Actions) -> np.ndarray: ...

    def rewind(self, frames: int, episodes: WholeNumbers | None = None) -> np.ndarray: ...


HISTORY = 600
"""The number of frames by which an episode can be rewound, by default."""


def read_only(images: np.ndarray) -> np.ndarray:
    """A view that cannot be written to, so that callers of a simulator see its frames but cannot change them."""
    view = images.view()
    view.flags.writeable = False
    return view


def whole_numbers(what: str, values: WholeNumbers) -> list[int]:
    """`values` as ints. Raises ConfigError for anything but integers: 0.5 is not truncated to 0, and a mask is not a
    list of numbers."""
    try:
        given = list(values)
        if not any(isinstance(value, bool) for value in given):
            return [operator.index(value) for value in given]
    except TypeError:
        pass
    raise ConfigError(f"{what} must be whole numbers, got {values!r}")


def chosen_episodes(episodes: WholeNumbers | None, count: int) -> list[int]:
    """The episodes, of `count`, that a call is about; None: all. Raises ConfigError for numbers that repeat or do not
    exist."""
    which = list(range(count)) if episodes is None else whole_numbers("episodes", episodes)
    require(
        all(0 <= b < count for b in which) and len(set(which)) == len(which),
        f"episodes must be different numbers below {count}, got {which}",
    )
    return which


def require_frame_steps(simulator: AnySimulator, what: str) -> None:
    """Raises ConfigError, which begins with `what`, for a simulator whose steps are native actions."""
    require(
        getattr(simulator, "rate", "model") == "model",
        f"{what} needs a simulator of rate='model', whose steps are frames of the model, not native actions",
    )


def each_start(starts: Start | Sequence[Start], count: int) -> list[Start]:
    """A start for each of `count` episodes, where one may be given for all. Raises ConfigError for anything but
    Starts."""
    several = isinstance(starts, (Sequence, np.ndarray)) and not isinstance(starts, str)
    each = list(starts) if several else [starts] * count
    others = [start for start in each if not isinstance(start, Start)]
    require(
        not others, f"an episode begins at a Start (see the simulator's `starts`), not at {reprlib.repr(others[:1])}"
    )
    return each


def each_action(actions: Actions, count: int) -> list[ArrayLike | None]:
    """An entry for each of `count` episodes. Raises ConfigError for another number of them."""
    if not isinstance(actions, Iterable):
        raise ConfigError(f"{count} episodes need as many actions, got {actions!r}")
    each = list(actions)
    require(len(each) == count, f"{count} episodes need as many actions, got {len(each)}")
    return each


def each_beginning(
    starts: Start | Sequence[Start], seeds: int | WholeNumbers, count: int
) -> tuple[list[Start], list[int]]:
    """A start and a seed for each of `count` episodes; if `seeds` is an int, that and those after it. Raises
    ConfigError for another number of them, and for what they cannot be."""
    each = each_start(starts, count)
    if isinstance(seeds, (int, np.integer)):
        [first] = whole_numbers("seeds", [seeds])
        numbers = list(range(first, first + count))
    else:
        numbers = whole_numbers("seeds", seeds)
    require(
        len(each) == len(numbers) == count,
        f"{count} episodes need as many starts and seeds, got {len(each)} and {len(numbers)}",
    )
    for number in numbers:
        require_seed(number, "seeds")
    return each, numbers


def require_actions_between(start: Start, robot: Robot) -> None:
    """Raises ConfigError for a start whose actions do not fit its frames."""
    between = len(start.images) - 1
    require(
        start.actions.shape == (between * robot.stride, robot.action_dim),
        f"a start of {robot.name} with {between + 1} frames needs {between} x {robot.stride} actions of "
        f"{robot.action_dim} values between them, got {start.actions.shape}",
    )


Judge = Callable[[Any], tuple[np.ndarray, np.ndarray]]
"""A function from an `AnySimulator` to rewards and terminations at its present frames: (float [B], bool [B]: the task
is done and the episode over). If a judge has a method `begin(simulator, episodes)`, it is called after `episodes` were
reset."""


def no_judge(simulator: AnySimulator) -> tuple[np.ndarray, np.ndarray]:
    """Reward 0 everywhere, and no episode terminates."""
    return np.zeros(len(simulator)), np.zeros(len(simulator), bool)
