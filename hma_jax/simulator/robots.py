"""A robot's commands: its action dimensions, their ranges, and how values outside the range are handled."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from hma_jax.config import ConfigError, require
from hma_jax.model.embodiments import DEAD_STD, Embodiment

Outside = Literal["clip", "refuse"]
"""How a value outside a robot's recorded range is handled: it is clipped and reported, or it is an error."""

KEYS = 4
"""The number of keys on the page that move a robot: right, up, D, W."""

SPREAD = 3.0
"""The range of an action value, in standard deviations on both sides of the mean, where no range is known."""


@dataclass(frozen=True)
class Robot:
    """One robot's commands, in its raw units, as recorded.

    `low` and `high` are the smallest and largest values in its training data (`recorded`) or, where only statistics are
    known, quantiles or `SPREAD` standard deviations around the mean.
    """

    name: str
    stride: int  # native actions per frame of the model
    low: tuple[float, ...]  # [A]
    high: tuple[float, ...]
    rest: tuple[float, ...]  # an action to begin with: 0 where the range contains it, otherwise the mean
    dimensions: tuple[str, ...] = ()  # the name of each value
    unit: str = ""  # of the values, for display
    keeps: bool = False  # actions are target positions: keys shift the last one. Otherwise released keys give `rest`
    # What the keys right, up, D and W add to each value, in shares of half its range; left, down, A and S do the
    # opposite.
    keys: tuple[tuple[float, ...], ...] = ()
    hz: float = 0.0  # native actions per second; 0: not known
    recorded: bool = True

    def __post_init__(self):
        for name in ("low", "high", "rest"):
            object.__setattr__(self, name, tuple(np.asarray(getattr(self, name), float).tolist()))
        require(self.stride >= 1, f"robot {self.name!r}: stride must be at least 1, got {self.stride}")
        require(
            len(self.low) == len(self.high) == len(self.rest),
            f"robot {self.name!r}: low, high and rest must have the same length",
        )
        require(
            bool(np.isfinite([*self.low, *self.high, *self.rest]).all())
            and all(a <= b for a, b in zip(self.low, self.high, strict=True)),
            f"robot {self.name!r}: the range low to high of every action dimension must be finite",
        )
        if not self.dimensions:
            object.__setattr__(self, "dimensions", tuple(f"action {i}" for i in range(self.action_dim)))
        if not self.keys:  # up to two values: both pairs of keys move them; more: each key moves one
            moved = [key % 2 if self.action_dim <= 2 else key for key in range(KEYS)]
            rows = tuple(tuple(float(d == at) for d in range(self.action_dim)) for at in moved)
            object.__setattr__(self, "keys", rows)
        require(
            len(self.keys) == KEYS and all(len(row) == self.action_dim for row in self.keys),
            f"robot {self.name!r}: keys must be {KEYS} rows of {self.action_dim} values",
        )
        require(
            len(self.dimensions) == self.action_dim,
            f"robot {self.name!r}: {self.action_dim} action values but {len(self.dimensions)} names of dimensions",
        )

    @property
    def action_dim(self) -> int:
        """A."""
        return len(self.low)

    @classmethod
    def of(cls, entry: Embodiment) -> Robot:
        """The robot of an entry in a model's table."""
        if entry.low:
            low, high = entry.low, entry.high
        else:
            spread = [SPREAD * s for s in entry.std]
            low = tuple(m - s for m, s in zip(entry.mean, spread, strict=True))
            high = tuple(m + s for m, s in zip(entry.mean, spread, strict=True))
        alive = [s > DEAD_STD for s in entry.std]
        low = tuple(a if on else m for a, on, m in zip(low, alive, entry.mean, strict=True))
        high = tuple(b if on else m for b, on, m in zip(high, alive, entry.mean, strict=True))
        return cls(entry.name, entry.stride, low, high, rest_action(low, high, entry.mean), recorded=False)

    def numbers(self, action: ArrayLike) -> np.ndarray:
        """`action` as float32. Raises ConfigError unless it is an array of real numbers."""
        return real_numbers(action, f"{self.name}: an action")

    def chunk(self, action: ArrayLike) -> np.ndarray:
        """float32 [stride, A] of one action [A], held for a whole frame, or of a chunk [stride, A].

        Raises ConfigError for any other shape, for types other than real numbers, and for values that are not finite.
        """
        action = self.numbers(action)
        shapes = (self.action_dim,), (self.stride, self.action_dim)
        require(
            action.shape in shapes,
            f"{self.name}: an action must have shape {shapes[0]}, or a frame's chunk of actions {shapes[1]}; got "
            f"{action.shape}",
        )
        require(bool(np.isfinite(action).all()), f"{self.name}: the action is not finite: {action.tolist()}")
        return np.broadcast_to(action, shapes[1])

    def clip_to_range(self, actions: np.ndarray, outside: Outside) -> tuple[np.ndarray, np.ndarray]:
        """(`actions` [..., A] clipped to the range, bool [A]: dimensions that were outside). Raises ConfigError if
        there are such dimensions and `outside` is "refuse"."""
        low, high = np.asarray(self.low, np.float32), np.asarray(self.high, np.float32)
        beyond = ((actions < low) | (actions > high)).reshape(-1, self.action_dim).any(0)
        if outside == "refuse" and beyond.any():
            raise ConfigError(
                f"{self.name}: {self.describe(beyond, actions)}; give actions in this range, or let the simulator "
                "clip them"
            )
        return np.clip(actions, low, high), beyond

    def describe(self, beyond: np.ndarray, actions: np.ndarray) -> str:
        """A message about the values of `actions` [..., A] that are out of range, in the dimensions that `beyond` [A]
        marks."""
        values = actions.reshape(-1, self.action_dim)
        known = "it was trained on" if self.recorded else "its statistics allow"
        return "; ".join(
            f"{self.dimensions[d]} of {values[:, d].min():g} to {values[:, d].max():g} is outside the range that "
            f"{known}, {self.low[d]:g} to {self.high[d]:g}"
            for d in np.flatnonzero(beyond)
        )


def real_numbers(values: ArrayLike, what: str) -> np.ndarray:
    """`values` as float32. Raises ConfigError, which begins with `what`, unless they are an array of real numbers."""
    try:
        given = np.asarray(values)
        if given.dtype.kind not in "cSU":  # a cast would drop imaginary parts, and parse text
            return given.astype(np.float32)
    except (TypeError, ValueError):  # objects, or lists of different lengths
        pass
    raise ConfigError(f"{what} is an array of real numbers, got {values!r}")


def rest_action(low: Sequence[float], high: Sequence[float], mean: Sequence[float]) -> tuple[float, ...]:
    """The action to begin with: 0 where the range contains it, otherwise the mean, clipped to the range."""
    return tuple(0.0 if a <= 0 <= b else min(max(m, a), b) for a, b, m in zip(low, high, mean, strict=True))


def require_robot(name: str, known: Sequence[str]) -> None:
    """Raises ConfigError, which suggests a similar name, for a name that is not one of the model's robots."""
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]}?" if near else f"it has {', '.join(known)}"
    require(name in known, f"the model has no robot {name!r}; {hint}")
