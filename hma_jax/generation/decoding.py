"""Filling one masked frame, step by step: the part of generation that differs between the two variants.

A frame is a `Frame`: the tokens known so far, and which tokens are still masked. Each unmasking step predicts the frame
once, samples values for masked tokens, and commits some of them; the others are sampled again in a later step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.config import DecodeConfig, ModelConfig, check_decoding
from hma_jax.kernels.random import fold_in_each
from hma_jax.model.frames import compose
from hma_jax.model.hma import HMA
from hma_jax.model.readout import ChainedReadout, Readout, choose_sampled
from hma_jax.objective.diffusion import sample
from hma_jax.objective.process import make_process, sampling_process


class Frame(NamedTuple):
    """One frame per example: ids [B, S] or latents [B, S, C], 0 where `masked` [B, S]."""

    values: jax.Array
    masked: jax.Array


def blank_frame(config: ModelConfig, batch: int) -> Frame:
    """A wholly masked frame."""
    return Frame(jnp.zeros((batch, *config.frame_shape), config.frame_dtype), jnp.ones((batch, config.tokens), bool))


def cosine_schedule(progress: float) -> float:
    """Share of a frame's tokens that is masked after `progress` (0 to 1) of its steps: cos(pi/2 progress)."""
    return math.cos(progress * math.pi / 2)


def masked_counts(config: ModelConfig, steps: int) -> list[int]:
    """Tokens still masked after each step: cos(pi/2 (k+1)/M) S, and none after the last.

    As released, the discrete variant rounds up; the continuous one rounds down, but to at least 1 and at most S - 1
    (reference sections 3.2 and 3.3). Where the share is one half, the last bit decides; so each variant multiplies in
    the release's order.
    """
    size = config.tokens
    if config.diffusion:
        exact = [math.cos(math.pi / 2 * (k + 1) / steps) * size for k in range(steps - 1)]
        return [min(max(math.floor(x), 1), size - 1) for x in exact] + [0]
    return [math.ceil(cosine_schedule((k + 1) / steps) * size) for k in range(steps - 1)] + [0]


def sample_tokens(
    head: Readout | ChainedReadout, predictions_BS: jax.Array, key_B: jax.Array, temperature: float, top_k: int = 0
) -> tuple[jax.Array, jax.Array]:
    """(ids [B, S], confidence [B, S]) from the `token_outputs` of tokens (`Outputs.token_outputs`); confidence is the
    product of the chosen factors' probabilities."""

    def one(token_outputs_S: jax.Array, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        choose = choose_sampled(key, head.shape(token_outputs_S), temperature, top_k)
        digits, logits = head.decode_factors(token_outputs_S, choose)
        chosen = jnp.take_along_axis(jax.nn.softmax(logits, axis=-1), digits[..., None], axis=-1)[..., 0]
        return compose(digits, logits.shape[-1]).astype(jnp.int32), jnp.prod(chosen, axis=-1)

    return jax.vmap(one)(predictions_BS, key_B)


def unmask(frame: Frame, sampled_BS: jax.Array, score_BS: jax.Array, still_masked: int | jax.Array) -> Frame:
    """Fills the masked positions of a discrete frame, except the `still_masked` positions with the lowest scores.

    Known positions keep their values.
    """
    filled = jnp.where(frame.masked, sampled_BS, frame.values)
    still = frame.masked & (_ranks(jnp.where(frame.masked, score_BS, jnp.inf)) < still_masked)
    return Frame(jnp.where(still, 0, filled), still)


def choose_patches(order_BS: jax.Array, before: int, after: int) -> jax.Array:
    """The tokens that a step samples, as ascending indices [B, n]: the masked ones shrink from the first `before`
    tokens of the order to the first `after`."""
    return jnp.sort(order_BS[:, after:before], axis=-1)


def _ranks(score_BS: jax.Array) -> jax.Array:
    return jnp.argsort(jnp.argsort(score_BS, axis=-1), axis=-1)


Predict = Callable[[Frame], jax.Array]
"""The model's predictions for a frame's tokens (`Outputs.token_outputs`): [B, S, Q, V] or [B, S, D]."""


def decode_frame(model: HMA, first: jax.Array, predict: Predict, key_B: jax.Array, decode: DecodeConfig) -> jax.Array:
    """Values of a frame that starts wholly masked; `first` is what `predict` returns for it. Raises as
    `check_decoding`."""
    check_decoding(model.config, decode)
    if model.config.diffusion:
        return _decode_latents(model, first, predict, key_B, decode)
    return _decode_tokens(model, first, predict, key_B, decode)


def _decode_tokens(
    model: HMA, token_outputs: jax.Array, predict: Predict, key_B: jax.Array, decode: DecodeConfig
) -> jax.Array:
    batch, size = token_outputs.shape[:2]

    def fill(frame: Frame, token_outputs: jax.Array, step: int | jax.Array, still_masked: int | jax.Array) -> Frame:
        keys = jax.vmap(lambda k: jax.random.split(jax.random.fold_in(k, step)))(key_B)
        sampled, score = sample_tokens(model.frame_head, token_outputs, keys[:, 0], decode.temperature, decode.top_k)
        if decode.order == "random":
            score = jax.vmap(lambda k: jax.random.uniform(k, (size,), jnp.float32))(keys[:, 1])
        return unmask(frame, sampled, score, still_masked)

    def unmask_step(frame: Frame, at: tuple[jax.Array, jax.Array]) -> tuple[Frame, None]:
        return fill(frame, predict(frame), *at), None

    counts = masked_counts(model.config, decode.unmask_steps)
    frame = fill(blank_frame(model.config, batch), token_outputs, 0, counts[0])
    # A loop, so that one pass is compiled, not M.
    later = jnp.arange(1, len(counts)), jnp.asarray(counts[1:], jnp.int32)
    return jax.lax.scan(unmask_step, frame, later)[0].values


def _decode_latents(model: HMA, z: jax.Array, predict: Predict, key_B: jax.Array, decode: DecodeConfig) -> jax.Array:
    """Samples patches in a random order that is fixed at the start, each once.

    DIFFERS: the release never marks what it has predicted, and samples it again in every step, in the last step the
    whole frame (reference section 3.3). `resample` does the same.
    """
    batch, size = z.shape[:2]
    frame = blank_frame(model.config, batch)
    order = jax.vmap(lambda k: jax.random.permutation(jax.random.fold_in(k, decode.unmask_steps), size))(key_B)
    before = size
    for step, still_masked in enumerate(masked_counts(model.config, decode.unmask_steps)):
        chosen = choose_patches(order, size if decode.resample else before, still_masked)
        if not chosen.size:  # with more steps than tokens, the first steps may leave as many tokens masked as before
            continue
        keys = fold_in_each(key_B, step)
        # The denoiser costs more than the trunk, so it is given only the chosen patches.
        new = denoise(model, jnp.take_along_axis(z, chosen[..., None], axis=1), keys, decode)
        frame = commit(frame, chosen, new)
        before = still_masked
        if still_masked:
            z = predict(frame)
    return frame.values


def denoise(model: HMA, z: jax.Array, key_B: jax.Array, decode: DecodeConfig) -> jax.Array:
    """Latents [B, n, C] under conditions z [B, n, D]."""
    config = model.config.diffusion
    process = sampling_process(make_process(config.steps), decode.sampler)
    shape = (*z.shape[:-1], config.token_channels)

    def network(x: jax.Array, t: jax.Array) -> jax.Array:
        return model.denoiser(x, t, z)

    return sample(network, key_B, shape, process, decode.sampler, config.clip)


def commit(frame: Frame, chosen_Bn: jax.Array, values_BnC: jax.Array) -> Frame:
    """The frame with `values_BnC` written into the chosen tokens, which are known from now on."""
    row = jnp.arange(len(chosen_Bn))[:, None]
    return Frame(frame.values.at[row, chosen_Bn].set(values_BnC), frame.masked.at[row, chosen_Bn].set(False))
