"""HMA, discrete variant: token embedding -> stems -> trunk -> factored logits.

Owns the order of things and the views of a window that training, evaluation and generation
need. Masking and losses are in `objectives`, decoding in `generation`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import ModelConfig
from hma_jax.embodiments import EmbodimentTable
from hma_jax.model.actions import Stem
from hma_jax.model.layers import Linear
from hma_jax.model.trunk import TemporalCache, Trunk
from hma_jax.params import Declared, declare, normal, param, zeros
from hma_jax.sharding import constrain

READOUT_GAIN = 0.01


def factorise(tokens: jax.Array, factors: int, vocab: int) -> jax.Array:
    """ids [...] -> factor ids [..., Q]; factor 0 holds the low digits (reference section 1.2)."""
    return jnp.stack([(tokens // vocab**q) % vocab for q in range(factors)], axis=-1)


def compose(factor_ids: jax.Array, vocab: int) -> jax.Array:
    """Factor ids [..., Q] -> ids [...]."""
    powers = vocab ** jnp.arange(factor_ids.shape[-1], dtype=factor_ids.dtype)
    return jnp.sum(factor_ids * powers, axis=-1)


def causal(frames: int) -> jax.Array:
    """bool [T, T]: a frame sees itself and what came before."""
    return jnp.tril(jnp.ones((frames, frames), bool))


class TokenEmbed(nnx.Module):
    """Sum of one table per factor; masked positions get one learned vector instead."""

    def __init__(self, config: ModelConfig):
        q, v, d = config.factors, config.factor_vocab, config.width
        self.tables = param((q, v, d), ("Q", "V", "D"), normal(1.0), role="vector")
        self.mask = param((d,), ("D",), zeros, role="vector")
        self.mask_id = config.mask_id

    def __call__(self, tokens: jax.Array, dtype: jnp.dtype) -> jax.Array:
        """ids [...] (mask id allowed) -> [..., D]."""
        q, v, _ = self.tables.shape
        ids = factorise(tokens, q, v)
        x = sum(jnp.take(self.tables[i].astype(dtype), ids[..., i], axis=0) for i in range(q))
        return jnp.where((tokens == self.mask_id)[..., None], self.mask.astype(dtype), x)


class HMA(nnx.Module):
    """The discrete model with `concat+modulate` conditioning."""

    def __init__(self, config: ModelConfig, table: EmbodimentTable):
        self.config = config
        self.embed = TokenEmbed(config)
        shape = (config.frames, config.frame_tokens, config.width)
        self.positions = param(shape, ("T", "P", "D"), zeros, role="vector")
        self.stem = Stem(config, table)
        self.trunk = Trunk(config, table.size)
        # muP's read-out: its input is divided by m, its initial weights multiplied by sqrt(m).
        self.readout = Linear(
            (config.width, config.factors * config.factor_vocab),
            ("D", "V"),
            gain=READOUT_GAIN * config.width_multiplier**0.5,
            role="output",
        )

    def __call__(
        self,
        tokens_BTS: jax.Array,
        actions_BTU: jax.Array | None,
        embodiment_B: jax.Array,
        *,
        visible: jax.Array | None = None,
        first: int | jax.Array = 0,
        positions: jax.Array | None = None,
        past: TemporalCache | None = None,
        keep: bool = False,
    ) -> tuple[jax.Array, TemporalCache | None]:
        """Logits [B, T, S, Q, V] (float32) of every frame given, and their cache if `keep`.

        `actions_BTU` are raw chunks as `align` arranges them: as released, frame t carries the
        chunk executed after it was seen (reference section 1.3). None runs without any
        conditioning. The frames stand at window positions `positions` (int [T], default `first`
        onwards); `visible` [T, T_past + T] defaults to causal.
        """
        config = self.config
        frames = tokens_BTS.shape[1]
        dtype = jnp.dtype(config.compute_dtype)
        if positions is None:
            positions = first + jnp.arange(frames)
        if visible is None:
            visible = causal(frames)
        x = self.embed(tokens_BTS, dtype)
        action = None
        if actions_BTU is not None:
            action = self.stem(actions_BTU, embodiment_B, dtype)
            copies = (*action.shape[:2], config.action_tokens, config.width)
            x = jnp.concatenate([x, jnp.broadcast_to(action[:, :, None], copies)], axis=2)
        x = x + jnp.take(self.positions.get_value(), positions, axis=0)[:, : x.shape[2]].astype(dtype)
        x = constrain(x, ("B", None, None, "D_act"))
        x, cache = self.trunk(x, action, embodiment_B, visible, past, keep)
        return self.logits(x[:, :, : config.tokens]), cache

    def align(self, actions: jax.Array) -> jax.Array:
        """Recorded chunks [..., T, U] -> the chunk that conditions each frame.

        With `causal` alignment every frame takes the chunk that led to it; nothing led to the
        first one, which keeps its own.
        """
        if self.config.action_alignment == "released":
            return actions
        return jnp.concatenate([actions[..., :1, :], actions[..., :-1, :]], axis=-2)

    def logits(self, x: jax.Array) -> jax.Array:
        """Trunk outputs [..., D] -> float32 logits [..., Q, V]."""
        y = self.readout(x / self.config.width_multiplier).astype(jnp.float32)
        return y.reshape(*y.shape[:-1], self.config.factors, self.config.factor_vocab)


def declare_model(config: ModelConfig, table: EmbodimentTable) -> Declared:
    """The model's declarations; see `params.Declared` for init, merge and count."""
    return declare(lambda: HMA(config, table))
