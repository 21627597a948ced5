"""How frames enter the trunk and leave it, for both variants.

Discrete: ids are embedded by one table per vocabulary factor, and read out as logits of each factor (`readout`).
Continuous: latent patches are embedded linearly, and read out as the vectors that condition the diffusion head
(`heads.Denoiser`). In both, masked tokens enter as one learned vector.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import DiffusionConfig, ModelConfig
from hma_jax.kernels.dense import look_up
from hma_jax.kernels.pointwise import replaced, scaled
from hma_jax.model.initial import input_fan_out, trunk_init
from hma_jax.model.layers import FINE_EPS, LayerNorm, Linear
from hma_jax.model.params import normal, ones, param, used, xavier_uniform, zeros
from hma_jax.model.readout import ChainedReadout, Readout


def factorise(tokens: jax.Array, factors: int, vocab: int) -> jax.Array:
    """ids [...] -> factor ids [..., Q]; factor 0 holds the low digits (reference section 1.2)."""
    return jnp.stack([(tokens // vocab**q) % vocab for q in range(factors)], axis=-1)


def compose(factor_ids: jax.Array, vocab: int) -> jax.Array:
    """Factor ids [..., Q] -> ids [...]."""
    powers = vocab ** jnp.arange(factor_ids.shape[-1], dtype=factor_ids.dtype)
    return jnp.sum(factor_ids * powers, axis=-1)


def patchify(latents: jax.Array, patch: int) -> jax.Array:
    """Latent cells [..., h, w, c] -> tokens [..., S, patch^2 c], row by row (reference section 2.1)."""
    *batch, h, w, c = latents.shape
    x = latents.reshape(*batch, h // patch, patch, w // patch, patch, c)
    return jnp.moveaxis(x, -4, -3).reshape(*batch, (h // patch) * (w // patch), patch * patch * c)


def unpatchify(tokens: jax.Array, patch: int, columns: int) -> jax.Array:
    """The inverse of `patchify` for a grid of `columns` tokens per row."""
    *batch, s, c = tokens.shape
    x = tokens.reshape(*batch, s // columns, columns, patch, patch, c // patch**2)
    x = jnp.moveaxis(x, -3, -4)
    return x.reshape(*batch, s // columns * patch, columns * patch, c // patch**2)


def mask_cells(tokens: jax.Array, masked: jax.Array, vector: jax.Array, config: DiffusionConfig) -> jax.Array:
    """Tokens [..., S, C] with the learned `vector` [channels] in place of masked cells.

    `masked` is bool [..., S] for whole tokens or [..., S, cells].
    """
    if masked.ndim == tokens.ndim - 1:
        return jnp.where(masked[..., None], jnp.tile(vector, config.cells), tokens)
    cells = tokens.reshape(*tokens.shape[:-1], config.cells, config.channels)
    return jnp.where(masked[..., None], vector, cells).reshape(tokens.shape)


class TokenEmbed(nnx.Module):
    """Sum of one table per factor; masked positions get one learned vector instead."""

    def __init__(self, config: ModelConfig):
        q, v, d = config.factors, config.factor_vocab, config.width
        self.tables = param((q, v, d), ("Q", "V", "D"), normal(1.0), role="vector", precise=True)
        self.mask = param((d,), ("D",), zeros, role="vector")

    def __call__(self, ids: jax.Array, masked: jax.Array | None, dtype: jnp.dtype) -> jax.Array:
        """ids [...] and bool [...] -> [..., D]."""
        q, v, _ = self.tables.shape
        digits = factorise(ids, q, v)
        x = sum(look_up(self.tables[i], digits[..., i]) for i in range(q)).astype(dtype)
        return x if masked is None else replaced(x, masked, self.mask.get_value())


class LatentEmbed(nnx.Module):
    """A linear map of a patch's values; masked cells hold one learned vector instead. DIFFERS: it starts at Xavier; the
    release draws it from N(0, 0.02)."""

    def __init__(self, config: ModelConfig):
        self.diffusion = config.diffusion
        c, d = config.diffusion.token_channels, config.width
        self.kernel = param((c, d), ("C", "D"), xavier_uniform(c, input_fan_out(config)), role="input")
        self.mask = param((config.diffusion.channels,), (None,), zeros, role="vector")

    def __call__(self, tokens: jax.Array, masked: jax.Array | None, dtype: jnp.dtype) -> jax.Array:
        """Tokens [..., S, C] and bool [..., S] or [..., S, cells] -> [..., S, D]."""
        if masked is not None:
            tokens = mask_cells(tokens, masked, self.mask.get_value(), self.diffusion)
        return tokens.astype(dtype) @ self.kernel.astype(dtype)


class Condition(nnx.Module):
    """Trunk outputs -> the diffusion head's condition for each token (reference section 2.2)."""

    def __init__(self, config: ModelConfig):
        width, shape = config.width, (config.frames, config.tokens, config.width)
        init = trunk_init(config, width, width)
        self.linear = Linear((width, width), ("D", "D_out"), init=init, role="hidden")
        self.norm = LayerNorm(width, eps=FINE_EPS)
        self.positions = param(shape, ("T", "S", "D"), normal(0.02), role="vector", precise=True)

    def __call__(self, x_BTSD: jax.Array, positions_T: jax.Array) -> jax.Array:
        """[B, T, S, D] of frames at window positions `positions_T` -> float32 of that shape."""
        z = self.norm(self.linear(x_BTSD)).astype(jnp.float32)
        return z + jnp.take(self.positions.get_value(), positions_T, axis=0)


class Recall(nnx.Module):
    """Adds to masked tokens the embedding of the token at the same position one frame earlier
    (`ModelConfig.recall`)."""

    def __init__(self, config: ModelConfig):
        self.gain = param((config.width,), ("D",), ones, role="vector")

    def __call__(self, x: jax.Array, unknown: jax.Array, earlier: jax.Array) -> jax.Array:
        """x [..., S, D] with `earlier`, of the same shape, added where `unknown`, bool [..., S], is True."""
        return x + jnp.where(unknown[..., None], scaled(earlier, self.gain.get_value()), 0)


def make_embed(config: ModelConfig) -> nnx.Module:
    return LatentEmbed(config) if config.diffusion else TokenEmbed(config)


def make_frame_head(config: ModelConfig) -> nnx.Module:
    head = Condition if config.diffusion else ChainedReadout if config.chain_factors else Readout
    return used("frames_predicted", head(config))
