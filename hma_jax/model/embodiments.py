"""The embodiment table: each robot's action space and statistics.

It is data, not configuration: made from a token store, saved inside every checkpoint, and
the only place where the order of the embodiment axis E is decided.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import ConfigError, require
from hma_jax.config.base import check_fields

Array = TypeVar("Array", jax.Array, np.ndarray)

DEAD_STD = 1e-6
"""A dimension whose standard deviation is below this (in raw units) carries no signal."""


@dataclass(frozen=True)
class Embodiment:
    """One robot and its action space; `action_dim` 0 is a video without recorded actions.

    `mean` and `std` are over single native actions, length `action_dim`, in raw units. The
    action chunk of a frame is `stride` native actions, flattened sub-step-major.

    A model is given actions in standard deviations from the mean. If there are `low` and `high` (the 1 % and 99 %
    quantiles, say), it is given actions on the scale where `low` is -1 and `high` is 1; values beyond are not clipped.
    """

    name: str
    action_dim: int
    stride: int
    mean: tuple[float, ...]
    std: tuple[float, ...]
    # False: its video is of no use as a target (a policy dataset with blank cameras, say).
    video_targets: bool = True
    low: tuple[float, ...] = ()
    high: tuple[float, ...] = ()
    layout: str = ""  # a hash of the names and order of its action values; "": unknown

    def __post_init__(self):
        for name in ("mean", "std", "low", "high"):
            values = getattr(self, name)
            if not isinstance(values, tuple):  # lists, arrays and single numbers are accepted
                object.__setattr__(self, name, tuple(np.atleast_1d(values).tolist()))
        check_fields(self)
        require(
            len(self.mean) == len(self.std) == self.action_dim,
            f"embodiment {self.name!r}: mean and std must have {self.action_dim} entries, "
            f"got {len(self.mean)} and {len(self.std)}",
        )
        require(self.stride >= 1, f"embodiment {self.name!r}: stride must be at least 1")
        require(
            bool(np.isfinite(self.mean).all() and np.isfinite(self.std).all()),
            f"embodiment {self.name!r}: action statistics are not finite; check its actions for NaN",
        )
        require(min(self.std, default=0.0) >= 0, f"embodiment {self.name!r}: std must not be negative, got {self.std}")
        require(
            (len(self.low), len(self.high)) in ((0, 0), (self.action_dim, self.action_dim)),
            f"embodiment {self.name!r}: low and high must both have {self.action_dim} entries, or both none",
        )
        require(
            bool(np.isfinite((*self.low, *self.high)).all())
            and all(b > a or std <= DEAD_STD for a, b, std in zip(self.low, self.high, self.std, strict=False)),
            f"embodiment {self.name!r}: low must be below high for every action value that varies, got {self.low} and "
            f"{self.high}",
        )

    @property
    def centre(self) -> tuple[float, ...]:
        """The raw values that are normalised to 0, length `action_dim`."""
        return tuple((a + b) / 2 for a, b in zip(self.low, self.high, strict=True)) or self.mean

    @property
    def unit(self) -> tuple[float, ...]:
        """The raw differences that are normalised to 1, length `action_dim`."""
        return tuple((b - a) / 2 for a, b in zip(self.low, self.high, strict=True)) or self.std

    @property
    def chunk(self) -> int:
        """Values in one frame's action chunk: stride x action_dim."""
        return self.stride * self.action_dim


class ActionUnits(NamedTuple):
    """The scale on which actions are normalised: that of a table (`EmbodimentTable.scale`), or inputs of a compiled
    program that tables with different statistics share."""

    centre_EU: jax.Array | np.ndarray  # the raw values that are normalised to 0
    unit_EU: jax.Array | np.ndarray  # the raw differences that are normalised to 1; 0: no signal

    def normalise(self, actions: jax.Array, embodiment_B: jax.Array) -> jax.Array:
        """Raw chunks [B, ..., U] on each robot's own scale: see `Embodiment`.

        DIFFERS: padding and dead dimensions become exactly 0; the release divides by std + 1e-10,
        which turns rounding noise on a constant dimension into values of order 100 (reference
        section 5.6).
        """
        return normalise(actions, *self._of(embodiment_B, actions.ndim))

    def unnormalise(self, actions: jax.Array, embodiment_B: jax.Array) -> jax.Array:
        """The inverse of `normalise`: raw units; dead dimensions take their centre."""
        centre, unit = self._of(embodiment_B, actions.ndim)
        return actions * unit + centre

    def _of(self, embodiment_B: jax.Array, ndim: int) -> tuple[jax.Array, ...]:
        """(centre, unit) of each example's robot, shaped to broadcast against [B, ..., U]."""
        shape = (-1, *(1,) * (ndim - 2), self.centre_EU.shape[1])
        return tuple(jnp.take(x, embodiment_B, 0).reshape(shape) for x in self)


@dataclass(frozen=True)
class EmbodimentTable:
    """Embodiments in the order of the E axis."""

    entries: tuple[Embodiment, ...]

    def __post_init__(self):
        object.__setattr__(self, "entries", tuple(self.entries))
        names = [e.name for e in self.entries]
        require(len(names) >= 1, "the embodiment table is empty")
        require(len(set(names)) == len(names), f"embodiment names repeat: {sorted(names)}")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(e.name for e in self.entries)

    @property
    def size(self) -> int:
        """E."""
        return len(self.entries)

    @property
    def action_width(self) -> int:
        """U: the widest chunk, at least 1; narrower ones are padded with zeros."""
        return max(1, *(e.chunk for e in self.entries))

    @property
    def chunks(self) -> np.ndarray:
        """int [E]: values in each robot's own chunk; 0 for videos without actions."""
        return np.array([e.chunk for e in self.entries])

    def index(self, name: str) -> int:
        for i, entry in enumerate(self.entries):
            if entry.name == name:
                return i
        raise ConfigError(f"unknown embodiment {name!r}; the table has {', '.join(self.names)}")

    def statistics(self) -> tuple[np.ndarray, np.ndarray]:
        """(mean_EU, std_EU), float32; both are 0 in the padding, std also in dead dimensions."""
        return self._tiled([(e.mean, e.std) for e in self.entries])

    def scale(self) -> ActionUnits:
        """What normalises actions, float32, with zeros where `statistics` has them."""
        return ActionUnits(*self._tiled([(e.centre, e.unit) for e in self.entries]))

    def _tiled(self, values: Sequence[tuple[Sequence[float], Sequence[float]]]) -> tuple[np.ndarray, np.ndarray]:
        """Repeats each robot's two vectors, given for a single action, over its chunk: float32 [E, U] each. The second
        is 0 in dead dimensions."""
        zero = np.zeros((self.size, self.action_width), np.float32)
        one = np.zeros((self.size, self.action_width), np.float32)
        for i, (e, (centre, unit)) in enumerate(zip(self.entries, values, strict=True)):
            alive = [u if s > DEAD_STD else 0.0 for u, s in zip(unit, e.std, strict=True)]
            zero[i, : e.chunk] = np.tile(centre, e.stride)
            one[i, : e.chunk] = np.tile(alive, e.stride)
        return zero, one

    def alive(self) -> np.ndarray:
        """bool [E, U]: values that carry a signal, neither padding nor a dead dimension."""
        return self.statistics()[1] > 0

    def standardised(self) -> EmbodimentTable:
        """The table of the same robots for actions that are already normalised: its scale leaves them as they are.
        Tables that differ only in their statistics become equal."""
        return EmbodimentTable(
            tuple(
                replace(e, mean=(0.0,) * e.action_dim, std=tuple(float(s > DEAD_STD) for s in e.std), low=(), high=())
                for e in self.entries
            )
        )


def normalise(actions: Array, centre: Array, unit: Array, xp: Any = jnp) -> Array:
    """Raw values in units of `unit` from `centre`, which broadcast; 0 where `unit` is 0. With `xp=numpy` it computes on
    NumPy arrays; on a CPU the result is equal to the last bit."""
    return (actions - centre) * xp.where(unit > 0, 1 / xp.where(unit > 0, unit, 1), 0)
