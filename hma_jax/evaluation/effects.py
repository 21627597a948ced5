"""What each action dimension does to a model's frames, and whether it did the same when they were recorded.

The loss of recorded frames is compared under the recorded actions and under changed ones: one dimension is held still,
negated, scaled, or swapped with another. If the model uses a dimension, holding it still makes the recorded frames less
likely; if a dimension's sign, scale or position differs from the training data, changing it back makes them *more*
likely. No simulator and no other recording is needed: the frames show what the action did.

Changes are made to raw values, as a wrong driver of a robot would make them. Differences are paired by window and their
errors clustered by episode.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ndtri, stdtr  # not scipy.stats, which takes most of a second to import

from hma_jax.config import ExecutionConfig, MaskingSetting, ModelConfig, require
from hma_jax.evaluation.likelihood import window_loss
from hma_jax.evaluation.statistics import mean_and_sem
from hma_jax.generation import next_frame_outputs
from hma_jax.kernels.random import key_of
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.model.params import Params
from hma_jax.objective.masking import hidden_at_inference

Kind = Literal["still", "negated", "scaled", "swapped"]

FACTORS = (1 / 50, 1 / 10, 1 / 3, 3.0, 10.0, 50.0)
"""Factors by which a dimension is scaled, to see whether the frames then fit better."""

MAX_SWAPS = 45
"""The most swaps of two dimensions that are tried: all of them for up to ten dimensions; for more, only those between
dimensions that, as recorded, do not make the frames likelier."""

MIN_LOSS_ERRORS, MIN_GAIN_ERRORS = 2.0, 3.0
"""The number of standard errors from which on a difference counts: for the loss from holding a dimension still, and for
the gain from the best of many changes."""


MIN_EPISODES = 4
"""The fewest episodes from which a standard error is computed."""


@dataclass(frozen=True)
class Change:
    """An edit of one action dimension, or of a pair that is swapped, in raw values."""

    dimension: int
    kind: Kind
    factor: float = 1.0  # of `scaled`
    other: int = -1  # of `swapped`

    @property
    def dimensions(self) -> tuple[int, ...]:
        """The dimensions whose values this changes."""
        return (self.dimension, self.other) if self.kind == "swapped" else (self.dimension,)

    def __call__(self, actions: np.ndarray, mean: np.ndarray) -> np.ndarray:
        """Actions [..., A] with this change; a value held still is its mean, from `mean` [A]."""
        changed, d = actions.copy(), self.dimension
        if self.kind == "still":
            changed[..., d] = mean[d]
        elif self.kind == "swapped":
            changed[..., [d, self.other]] = actions[..., [self.other, d]]
        else:
            changed[..., d] *= -1.0 if self.kind == "negated" else self.factor
        return changed


@dataclass(frozen=True)
class Difference:
    """Mean loss under a change minus that of the recorded actions, with its standard error over `episodes` episodes."""

    mean: float
    sem: float
    episodes: int

    @property
    def errors(self) -> float:
        """The difference in standard errors of a normal distribution: the value that is as unlikely there as the
        difference is under Student's t with these few episodes."""
        if self.mean == 0:
            return 0.0
        if not self.sem > 0:
            return float(np.sign(self.mean)) * np.inf
        tail = stdtr(self.episodes - 1, -abs(self.mean) / self.sem)
        return float(-np.sign(self.mean) * ndtri(tail))


@dataclass(frozen=True)
class Effect:
    """What was found for one dimension. `worth` is what holding it still costs, in nats per token (continuous: in units
    of the diffusion loss), after all errors that were found have been changed back."""

    dimension: int
    worth: Difference
    better: Change | None  # a change that makes the recorded frames likelier, and by how much
    gain: Difference | None

    @property
    def ignored(self) -> bool:
        """Whether holding the dimension at its mean costs nothing beyond the error."""
        return self.worth.errors < MIN_LOSS_ERRORS


LossFn = Callable[[np.ndarray], np.ndarray]
"""Losses [n] of recorded windows under actions [n, T, stride, A]."""


def find_effects(loss_of: LossFn, actions: np.ndarray, mean: np.ndarray, episode: Sequence[int]) -> list[Effect]:
    """The effect of each dimension of `actions` [n, T, stride, A]; `episode` [n] is the episode of each window.

    The search is greedy: the change that helps most is applied first, then the others are evaluated again, because one
    wrong dimension makes others look wrong. Raises ConfigError for fewer than MIN_EPISODES episodes, too few for a
    standard error.
    """
    there = len(set(episode))
    require(there >= MIN_EPISODES, f"{there} episodes; measuring the effect of actions needs at least {MIN_EPISODES}")
    count, losses = actions.shape[-1], loss_of(actions)
    found: dict[int, tuple[Change, Difference]] = {}
    while len(found) < count:
        still = [loss_of(Change(d, "still")(actions, mean)) for d in range(count)]
        tried: dict[Change, np.ndarray] = {}
        for change in _changes(count, found, still, losses, episode):
            after = loss_of(change(actions, mean))
            helps = _clustered(after - losses, episode).errors < -MIN_GAIN_ERRORS
            # If holding it still helps as much, the value is only harmful, and was not changed in this way.
            if helps and all(
                _clustered(after - still[d], episode).errors < -MIN_LOSS_ERRORS for d in change.dimensions
            ):
                tried[change] = after
        if not tried:
            break
        best = min(tried, key=lambda change: float(tried[change].mean()))
        gain = _clustered(tried[best] - losses, episode)
        found |= dict.fromkeys(best.dimensions, (best, gain))
        actions, losses = best(actions, mean), tried[best]
    worth = [_clustered(loss_of(Change(d, "still")(actions, mean)) - losses, episode) for d in range(count)]
    return [Effect(d, worth[d], *found.get(d, (None, None))) for d in range(count)]


def _changes(
    count: int, found: Container[int], still: Sequence[np.ndarray], losses: np.ndarray, episode: Sequence[int]
) -> Iterator[Change]:
    """The changes still to be tried, of dimensions for which no error was found yet."""
    left = [d for d in range(count) if d not in found]
    for d in left:
        yield Change(d, "negated")
        yield from (Change(d, "scaled", factor) for factor in FACTORS)
    pairs = list(itertools.combinations(left, 2))
    if len(pairs) > MAX_SWAPS:
        doubtful = [d for d in left if _clustered(still[d] - losses, episode).errors < MIN_LOSS_ERRORS]
        pairs = list(itertools.combinations(doubtful, 2))[:MAX_SWAPS]
    yield from (Change(d, "swapped", other=other) for d, other in pairs)


def _clustered(differences: np.ndarray, episode: Sequence[int]) -> Difference:
    """Mean over windows, its error clustered by episode."""
    stat = mean_and_sem(differences, episode)
    return Difference(stat.mean, stat.sem, stat.episodes)


def make_loss(
    model: ModelConfig, table: EmbodimentTable, setting: MaskingSetting, execution: ExecutionConfig = ExecutionConfig()
) -> Callable[[Params, dict[str, jax.Array], jax.Array], jax.Array]:
    """f(params, batch, actions [B, T, U]) -> loss of each window's frames [B] after their true past, to be jitted. The
    batch is a `protocol.Batch`; `setting` is what the model was trained for."""
    declared = declare_model(model, table, execution)

    def loss(params: Params, batch: dict[str, jax.Array], actions: jax.Array) -> jax.Array:
        hma, tokens, real = declared.merge(params), batch["tokens"][:, : model.frames], batch.get("real")
        real_from_1 = None if real is None else real[:, 1 : model.frames]
        hidden = hidden_at_inference(table, setting, batch["embodiment"], model.frames)
        token_outputs = next_frame_outputs(hma, tokens, actions[:, : model.frames], batch["embodiment"], hidden)
        # The same noise under all changes.
        key_B = jax.vmap(key_of)(jnp.arange(len(tokens))) if model.diffusion else None
        return window_loss(hma, token_outputs, tokens[:, 1:], key_B, real_from_1)

    return loss
