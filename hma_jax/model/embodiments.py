"""The embodiment table: what a model must know of each robot's actions.

It is data, not configuration: made from a token store, saved inside every checkpoint, and
the only place where the order of the embodiment axis E is decided.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import ConfigError, require

DEAD_STD = 1e-6
"""A dimension whose standard deviation is below this (in raw units) carries no signal."""


@dataclass(frozen=True)
class Embodiment:
    """One robot and its action space; `action_dim` 0 is a video without recorded actions.

    `mean` and `std` are over single native actions, length `action_dim`, in raw units. The
    action chunk of a frame is `stride` native actions, flattened sub-step-major.
    """

    name: str
    action_dim: int
    stride: int
    mean: tuple[float, ...]
    std: tuple[float, ...]
    # False: its video is of no use as a target (a policy dataset with blank cameras, say).
    video_targets: bool = True
    layout: str = ""  # a hash of which values its actions are, in what order; "": not known

    def __post_init__(self):
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

    @property
    def chunk(self) -> int:
        """Values in one frame's action chunk: stride x action_dim."""
        return self.stride * self.action_dim


@dataclass(frozen=True)
class EmbodimentTable:
    """Embodiments in the order of the E axis."""

    entries: tuple[Embodiment, ...]

    def __post_init__(self):
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
        mean = np.zeros((self.size, self.action_width), np.float32)
        std = np.zeros((self.size, self.action_width), np.float32)
        for i, e in enumerate(self.entries):
            alive = [s if s > DEAD_STD else 0.0 for s in e.std]
            mean[i, : e.chunk] = np.tile(e.mean, e.stride)
            std[i, : e.chunk] = np.tile(alive, e.stride)
        return mean, std

    def alive(self) -> np.ndarray:
        """bool [E, U]: values that carry a signal, neither padding nor a dead dimension."""
        return self.statistics()[1] > 0

    def normalise(self, actions: jax.Array, embodiment_B: jax.Array) -> jax.Array:
        """Raw chunks [B, ..., U] in units of each robot's standard deviation, from its mean.

        DIFFERS: padding and dead dimensions become exactly 0; the release divides by std + 1e-10,
        which turns rounding noise on a constant dimension into values of order 100 (reference
        section 5.6).
        """
        return normalise(actions, *self._of(embodiment_B, actions.ndim))

    def unnormalise(self, actions: jax.Array, embodiment_B: jax.Array) -> jax.Array:
        """The inverse of `normalise`: raw units; dead dimensions take their mean."""
        mean, std = self._of(embodiment_B, actions.ndim)
        return actions * std + mean

    def _of(self, embodiment_B: jax.Array, ndim: int) -> tuple[jax.Array, jax.Array]:
        """(mean, std) of each example's robot, shaped to meet [B, ..., U]."""
        shape = (-1, *(1,) * (ndim - 2), self.action_width)
        return tuple(jnp.take(x, embodiment_B, 0).reshape(shape) for x in self.statistics())


def normalise(actions: jax.Array, mean: jax.Array, std: jax.Array) -> jax.Array:
    """Raw values in units of `std` from `mean`, which broadcast; 0 where `std` is 0."""
    return (actions - mean) * jnp.where(std > 0, 1 / jnp.where(std > 0, std, 1), 0)
