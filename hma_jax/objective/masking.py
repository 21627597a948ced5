"""Masking in training: which tokens and actions are hidden from the model, for both variants and every setting.

Random numbers are drawn (`draw`) before they are used, so that masking can be checked against recorded numbers. The
settings of paper section 3.1 differ only in which frames' tokens are masked and which actions are hidden:

    setting   tokens          actions hidden            predicted
    forward   masked          none                      tokens
    passive   masked          all                       tokens
    full      masked          some, by a random rate    tokens and hidden actions
    policy    none            from a random frame on    hidden actions
    inverse   none            all                       hidden actions but the last; attention is not causal

With causal alignment no frame is shown the chunk that follows it, so all chunks can be predicted, not only the hidden
ones. For inverse dynamics the chunk of a window's last frame is not a target: no frame shows where it led. A robot
without recorded actions has all of them hidden and none predicted; a robot whose video is not a target has no token
masked. Each robot trains the parts for which it has data.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import MaskingConfig, MaskingSetting, ModelConfig
from hma_jax.kernels.random import Tag
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.frames import compose, factorise


class MaskingDraws(NamedTuple):
    """The random numbers of one discrete example; u_* are uniform in [0, 1)."""

    u_corrupt: jax.Array  # []
    u_replace_TSQ: jax.Array
    noise_TSQ: jax.Array  # int32 in [0, V)
    first_masked: jax.Array  # int32 []: 1, or later when the prompt stays clean
    u_clean: jax.Array  # []
    u_decay_T: jax.Array
    u_degrade_TSQ: jax.Array
    u_rate_T: jax.Array
    u_mask_TS: jax.Array


class LatentDraws(NamedTuple):
    """The random numbers of one continuous example. The last axis of `u_mask` is the mask unit's:
    one for whole patches, else the cells of a patch."""

    first_masked: jax.Array
    u_rate_T: jax.Array
    u_mask_TSc: jax.Array


class Masked(NamedTuple):
    """Windows [T, ...] as the model sees them in training, or a batch of them."""

    inputs: jax.Array  # ids, corrupted, or latents
    masked: jax.Array  # bool [T, S] or [T, S, cells]: not shown
    targets_TS: jax.Array  # bool: tokens that the loss counts
    action_hidden_T: jax.Array  # bool: recorded chunks that are not shown
    action_targets_T: jax.Array  # bool: recorded chunks that the loss counts

    def without_padding(self, real_T: jax.Array) -> Masked:
        """The same without targets in frames where `real_T`, bool [T] or [B, T] for a batch, is False."""
        return self._replace(
            targets_TS=self.targets_TS & real_T[..., None], action_targets_T=self.action_targets_T & real_T
        )


def draw(key: jax.Array, config: ModelConfig, masking: MaskingConfig) -> MaskingDraws | LatentDraws:
    """One example's random numbers.

    DIFFERS: the release draws the corruption rate and the masking mode once per batch (its
    batches hold one dataset); here each example draws its own.
    """
    t, s, q = config.frames, config.tokens, config.factors
    if config.diffusion:
        unit = config.diffusion.cells if masking.mask_unit == "cell" else 1
        shapes = LatentDraws((2,), (t,), (t, s, unit))
    else:
        shapes = MaskingDraws((), (t, s, q), (t, s, q), (2,), (), (t,), (t, s, q), (t,), (t, s))
    # One call for all numbers: random generators are slow to compile.
    sizes = [math.prod(shape) for shape in shapes]
    flat = jax.random.uniform(key, (sum(sizes),), jnp.float32)
    pieces = jnp.split(flat, list(itertools.accumulate(sizes))[:-1])
    u = type(shapes)(*[piece.reshape(shape) for piece, shape in zip(pieces, shapes, strict=True)])

    earliest = min(masking.prompt_frames, t - 1)
    late = earliest + jnp.floor(u.first_masked[0] * (t - earliest)).astype(jnp.int32)
    u = u._replace(first_masked=jnp.where(u.first_masked[1] < masking.non_mlm_ratio, late, 1))
    if config.diffusion:
        return u
    return u._replace(noise_TSQ=jnp.floor(u.noise_TSQ * config.factor_vocab).astype(jnp.int32))


def corrupt(tokens_TS: jax.Array, draws: MaskingDraws, config: ModelConfig, masking: MaskingConfig) -> jax.Array:
    """Random-token corruption, and degradation of late frames in prompt mode (reference section 1.9).

    In prompt mode (first_masked > 1) frames from first_masked on are degraded, later ones more. DIFFERS: with a prompt
    of one frame (`prompt_frames` 1) a first_masked of 1 that was drawn in prompt mode is not told apart, and degrades
    nothing; the release's would.
    """
    ids = factorise(tokens_TS, config.factors, config.factor_vocab)
    replace = draws.u_replace_TSQ < masking.max_corrupt_rate * draws.u_corrupt
    start_rate = masking.clean_rate_min + (1 - masking.clean_rate_min) * draws.u_clean
    late_T = jnp.arange(tokens_TS.shape[0]) >= draws.first_masked
    clean_T = start_rate * jnp.cumprod(jnp.where(late_T, 0.9 + 0.1 * draws.u_decay_T, 1.0))
    degrade_T = late_T & (draws.first_masked > 1)
    replace |= degrade_T[:, None, None] & (draws.u_degrade_TSQ > clean_T[:, None, None])
    return compose(jnp.where(replace, draws.noise_TSQ, ids), config.factor_vocab)


def min_mask_ratio(frames: int, masking: MaskingConfig) -> np.ndarray:
    """[T]: the lowest mask rate of each frame, 0 as released (paper section 3.5).

    The paper says that there is a minimum ratio and that a cosine schedule masks more tokens at later steps of
    the training horizon. The formula is ours: the minimum starts at `min_ratio` and rises along 1 - cos(pi/2 t / (T -
    1)), by the share `horizon_gain` of the distance to 1.
    """
    rise = 1.0 - np.cos(np.pi / 2 * np.arange(frames) / max(frames - 1, 1))
    return masking.min_ratio + (1.0 - masking.min_ratio) * masking.horizon_gain * rise


def mask_tokens(u_rate_T: jax.Array, u_mask: jax.Array, first_masked: jax.Array, masking: MaskingConfig) -> jax.Array:
    """bool like `u_mask` [T, ...]: a frame's mask rate is cos(pi/2 u), which is 2 / pi on average over u in [0, 1).

    Frames before `first_masked`, at least frame 0, are never masked (reference sections 1.9 and 2.3). A minimum m that
    is not 0 makes the rate m + (1 - m) cos(pi/2 u) (`min_mask_ratio`). DIFFERS: the release draws again if nothing in a
    batch was masked; here such a batch, which only happens with tiny batches, has a loss of 0.
    """
    angle = masking.mask_angle_min + (1 - masking.mask_angle_min) * u_rate_T
    rate = jnp.cos(jnp.pi / 2 * angle)
    least = min_mask_ratio(len(u_rate_T), masking).astype(np.float32)
    if least.any():
        rate = least + (1 - least) * rate
    late_T = jnp.arange(len(u_rate_T)) >= first_masked
    shape = (-1, *(1,) * (u_mask.ndim - 1))
    return late_T.reshape(shape) & (u_mask < rate.reshape(shape))


def hide_actions(key: jax.Array, frames: int, masking: MaskingConfig) -> jax.Array:
    """bool [T]: the chunks of one example that are hidden from the model.

    With `full` each chunk is hidden independently, at a rate drawn for the example, as in the release's discrete
    variant. DIFFERS: the release's continuous variant hides all chunks from a random frame on (reference section 2.4).
    """
    if masking.shows_all_actions:  # asked first: where it is True, `masked_loss` does not look at what is hidden
        return jnp.zeros(frames, bool)
    if masking.hides_all_actions:
        return jnp.ones(frames, bool)
    if masking.setting == "full":
        u = jax.random.uniform(key, (frames + 1,), jnp.float32)
        return u[1:] < u[0]
    if masking.setting == "policy":
        return jnp.arange(frames) >= jax.random.randint(key, (), 0, frames, jnp.int32)
    raise ValueError(f"hide_actions does not say which chunks {masking.setting!r} hides; add it there")


def followed(real_T: jax.Array) -> jax.Array:
    """bool [..., T], the frames that are not padding -> those that are followed by another such frame."""
    return jnp.concatenate([real_T[..., 1:], jnp.zeros_like(real_T[..., :1])], axis=-1)


def hidden_at_inference(
    table: EmbodimentTable, setting: MaskingSetting, embodiment_B: jax.Array, frames: int
) -> jax.Array | None:
    """bool [B, T]: the chunks to hide from a model trained for `setting`, because its training showed none of them;
    None: none."""
    shape = (len(embodiment_B), frames)
    if MaskingConfig(setting=setting).ignores_actions:
        return jnp.ones(shape, bool)
    if all(table.chunks):
        return None
    return jnp.broadcast_to(jnp.asarray(table.chunks == 0)[embodiment_B][:, None], shape)


def mask_example(
    key: jax.Array,
    tokens: jax.Array,
    config: ModelConfig,
    masking: MaskingConfig,
    has_actions: jax.Array,
    has_video: jax.Array,
) -> Masked:
    """One window, [T, S] ids or [T, S, C] latents, under `masking.setting`."""
    frames = tokens.shape[0]
    hidden = hide_actions(jax.random.fold_in(key, Tag.HIDDEN_ACTIONS), frames, masking) | ~has_actions
    inputs = tokens
    if masking.predicts_frames:
        draws = draw(key, config, masking)
        u_mask = draws.u_mask_TSc if config.diffusion else draws.u_mask_TS
        masked = mask_tokens(draws.u_rate_T, u_mask, draws.first_masked, masking) & has_video
        if config.diffusion:
            targets = masked.any(axis=-1)
            masked = masked if masking.mask_unit == "cell" else targets
        else:
            inputs, targets = corrupt(tokens, draws, config, masking), masked
    else:
        masked = targets = jnp.zeros((frames, config.tokens), bool)
    unseen = hidden | (config.action_alignment == "causal")
    action_targets = unseen & has_actions & masking.predicts_actions
    return Masked(inputs, masked, targets, hidden, action_targets)


def mask_batch(
    key: jax.Array,
    tokens: jax.Array,
    embodiment_B: jax.Array,
    config: ModelConfig,
    masking: MaskingConfig,
    table: EmbodimentTable,
    real_BT: jax.Array | None = None,
) -> Masked:
    """Masks every example with its own key, fold_in(key, row), so that the layout of the batch over devices, processes
    and micro-batches does not change an example's masks. Frames where `real_BT` is False (None: all are real) have no
    targets."""
    has_actions = jnp.asarray(table.chunks > 0)[embodiment_B]
    has_video = jnp.array([e.video_targets for e in table.entries])[embodiment_B]

    def one(row: jax.Array, *example: jax.Array) -> Masked:
        window, actions, video = example
        return mask_example(jax.random.fold_in(key, row), window, config, masking, actions, video)

    masked = jax.vmap(one)(jnp.arange(len(tokens)), tokens, has_actions, has_video)
    if masking.setting == "inverse":
        outcome_seen = followed(jnp.ones_like(masked.action_hidden_T) if real_BT is None else real_BT)
        masked = masked._replace(action_targets_T=masked.action_targets_T & outcome_seen)
    return masked if real_BT is None else masked.without_padding(real_BT)
