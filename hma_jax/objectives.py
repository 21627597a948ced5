"""What the discrete model is trained on: corrupted, masked windows and their cross-entropy.

Random numbers (`draw`) are kept apart from what is done with them (`corrupt_and_mask`), so
the masking can be checked against recorded numbers.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.config import MaskingConfig, ModelConfig
from hma_jax.model.hma import HMA, compose, factorise


class MaskingDraws(NamedTuple):
    """The random numbers of one example; u_* are uniform in [0, 1)."""

    u_corrupt: jax.Array  # []
    u_replace_TSQ: jax.Array
    noise_TSQ: jax.Array  # int32 in [0, V)
    first_masked: jax.Array  # int32 []: 1, or later when the prompt stays clean
    u_clean: jax.Array  # []
    u_decay_T: jax.Array
    u_degrade_TSQ: jax.Array
    u_rate_T: jax.Array
    u_mask_TS: jax.Array


class Masked(NamedTuple):
    """A window as the model sees it in training."""

    inputs_TS: jax.Array  # corrupted ids, mask id where masked
    masked_TS: jax.Array  # bool: where the loss is taken


def draw(key: jax.Array, config: ModelConfig, masking: MaskingConfig) -> MaskingDraws:
    """One example's random numbers.

    DIFFERS: the release draws the corruption rate and the masking mode once per batch (its
    batches hold one dataset); here each example draws its own.
    """
    t, s, q = config.frames, config.tokens, config.factors
    shapes = MaskingDraws((), (t, s, q), (t, s, q), (2,), (), (t,), (t, s, q), (t,), (t, s))
    # One call for all numbers: random generators are slow to compile.
    sizes = [math.prod(shape) for shape in shapes]
    flat = jax.random.uniform(key, (sum(sizes),))
    pieces = jnp.split(flat, list(itertools.accumulate(sizes))[:-1])
    u = MaskingDraws(*[piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)])

    earliest = min(masking.prompt_frames, t - 1)
    late = earliest + jnp.floor(u.first_masked[0] * (t - earliest)).astype(jnp.int32)
    return u._replace(
        noise_TSQ=jnp.floor(u.noise_TSQ * config.factor_vocab).astype(jnp.int32),
        first_masked=jnp.where(u.first_masked[1] < masking.non_mlm_ratio, late, 1),
    )


def corrupt_and_mask(
    tokens_TS: jax.Array, draws: MaskingDraws, config: ModelConfig, masking: MaskingConfig
) -> Masked:
    """Random-token corruption, degradation of late frames, then masking (reference 1.9).

    Frame 0 is never masked. In prompt mode (first_masked > 1) frames from there on are also
    degraded, later ones more. A frame's mask rate is cos(pi u / 2), mean 2 / pi.
    """
    frame = jnp.arange(tokens_TS.shape[0])
    ids = factorise(tokens_TS, config.factors, config.factor_vocab)
    replace = draws.u_replace_TSQ < masking.max_corrupt_rate * draws.u_corrupt

    start_rate = masking.clean_rate_min + (1 - masking.clean_rate_min) * draws.u_clean
    late = frame >= draws.first_masked
    clean_T = start_rate * jnp.cumprod(jnp.where(late, 0.9 + 0.1 * draws.u_decay_T, 1.0))
    degrade_T = late & (draws.first_masked > 1)
    replace |= degrade_T[:, None, None] & (draws.u_degrade_TSQ > clean_T[:, None, None])
    corrupted = compose(jnp.where(replace, draws.noise_TSQ, ids), config.factor_vocab)

    rate_T = jnp.cos(jnp.pi / 2 * draws.u_rate_T)
    masked = late[:, None] & (draws.u_mask_TS < rate_T[:, None])
    return Masked(jnp.where(masked, config.mask_id, corrupted), masked)


def mask_batch(
    key: jax.Array, tokens_BTS: jax.Array, rows_B: jax.Array, config: ModelConfig, masking: MaskingConfig
) -> Masked:
    """Masks every example with its own key, fold_in(key, row): the layout of the batch over
    devices, processes and micro-batches does not change an example's masks."""

    def one(tokens_TS: jax.Array, row: jax.Array) -> Masked:
        draws = draw(jax.random.fold_in(key, row), config, masking)
        return corrupt_and_mask(tokens_TS, draws, config, masking)

    return jax.vmap(one)(tokens_BTS, rows_B)


class LossSums(NamedTuple):
    """Sums over masked positions; divide by `count` over the whole batch."""

    loss: jax.Array
    correct: jax.Array
    count: jax.Array


def smoothed_cross_entropy(logits: jax.Array, labels: jax.Array, smoothing: float) -> jax.Array:
    """Per position, summed over factors: logits [..., Q, V], labels [..., Q] -> [...]."""
    log_p = jax.nn.log_softmax(logits, axis=-1)
    picked = jnp.take_along_axis(log_p, labels[..., None], axis=-1)[..., 0]
    return -jnp.sum((1 - smoothing) * picked + smoothing * jnp.mean(log_p, axis=-1), axis=-1)


def masked_loss(
    model: HMA,
    masked: Masked,
    tokens_BTS: jax.Array,
    actions_BTU: jax.Array | None,
    embodiment_B: jax.Array,
    smoothing: float,
) -> LossSums:
    """Forward dynamics: predict masked tokens given the rest and the actions (reference 1.8)."""
    actions = None if actions_BTU is None else model.align(actions_BTU)
    logits, _ = model(masked.inputs_TS, actions, embodiment_B)
    labels = factorise(tokens_BTS, model.config.factors, model.config.factor_vocab)
    loss = smoothed_cross_entropy(logits, labels, smoothing)
    correct = jnp.all(jnp.argmax(logits, axis=-1) == labels, axis=-1)
    weight = masked.masked_TS.astype(jnp.float32)
    return LossSums(jnp.sum(loss * weight), jnp.sum(correct * weight), jnp.sum(weight))
