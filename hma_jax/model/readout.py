"""From trunk outputs to logits of a token's factors, and how factors are chosen: independently, or one after the
other."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import ModelConfig
from hma_jax.kernels.dense import contract, look_up
from hma_jax.kernels.pointwise import gelu
from hma_jax.kernels.random import draw_flat
from hma_jax.model.initial import readout_init, trunk_init
from hma_jax.model.layers import LayerNorm, Linear
from hma_jax.model.params import normal, param, zeros

Choose = Callable[[int, jax.Array], jax.Array]
"""(q, logits [..., V] of factor q) -> the digits [...] chosen for it."""


class Readout(nnx.Module):
    """Trunk outputs [..., D] -> float32 logits [..., Q, V] of a token's factors, independent of each other."""

    def __init__(self, config: ModelConfig, precise: bool = False):
        self.factors, self.multiplier = config.factors, config.mup_multiplier("readout")
        entries = config.factors * config.factor_vocab
        init = readout_init(config, entries)
        self.linear = Linear((config.width, entries), ("D", "V"), init=init, role="output", precise=precise)

    def __call__(self, x: jax.Array) -> jax.Array:
        y = self.linear(x / self.multiplier, dtype=jnp.float32)
        return y.reshape(*y.shape[:-1], self.factors, y.shape[-1] // self.factors)

    def shape(self, token_outputs: jax.Array) -> tuple[int, ...]:
        """[..., Q, V] of the logits."""
        return token_outputs.shape

    def decode_factors(self, token_outputs: jax.Array, choose: Choose) -> tuple[jax.Array, jax.Array]:
        """(digits [..., Q], logits [..., Q, V]): `choose` is called for factor 0, 1, ... with its logits."""
        digits = [choose(q, token_outputs[..., q, :]) for q in range(self.factors)]
        return jnp.stack(digits, axis=-1), token_outputs


class ChainedReadout(nnx.Module):
    """Logits of each factor given those before it (`ModelConfig.chain_factors`): the logits of `Readout`, plus the
    output of a layer of width D that sees the trunk's output and the digits chosen so far. Everything is in float32.
    """

    def __init__(self, config: ModelConfig):
        q, v, d = config.factors, config.factor_vocab, config.width
        self.alone = Readout(config, precise=True)
        init = trunk_init(config, d, d)
        self.condition = Linear((d, d), ("D", "D_out"), init=init, role="hidden", precise=True)
        self.norm = LayerNorm(d)
        self.tables = param((q - 1, v, d), ("Q", "V", "D"), normal(1.0), role="vector", precise=True)
        self.out = param((q - 1, d, v), ("Q", "D", "V"), zeros, role="output", precise=True)

    def __call__(self, x: jax.Array) -> jax.Array:
        """The trunk's outputs [..., D] in float32: logits follow factor by factor, in `decode_factors`."""
        return x.astype(jnp.float32)

    def shape(self, token_outputs: jax.Array) -> tuple[int, ...]:
        return (*token_outputs.shape[:-1], len(self.out) + 1, self.out.shape[-1])

    def decode_factors(self, token_outputs: jax.Array, choose: Choose) -> tuple[jax.Array, jax.Array]:
        alone = self.alone(token_outputs)
        hidden = self.norm(self.condition(token_outputs))
        logits = [alone[..., 0, :]]
        digits = [choose(0, logits[0])]
        for q in range(len(self.tables)):
            hidden = hidden + look_up(self.tables[q], digits[q])
            further = contract(gelu(hidden) / self.alone.multiplier, self.out[q])
            logits.append(alone[..., q + 1, :] + further)
            digits.append(choose(q + 1, logits[-1]))
        return jnp.stack(digits, axis=-1), jnp.stack(logits, axis=-2)


def choose_sampled(key: jax.Array, shape: tuple[int, ...], temperature: float = 1.0, top_k: int = 0) -> Choose:
    """A `Choose` that samples the factors of one example, whose logits have `shape` [..., Q, V]. Temperature 0 takes
    the likeliest digit; `top_k` restricts the choice to the k likeliest entries (0: all).

    The Gumbel noise is drawn for all factors at once: chained and independent factors see the same noise.
    """
    if temperature == 0:
        return choose_likeliest
    noise = draw_flat(jax.random.gumbel, key, shape)

    def choose(factor: int, logits: jax.Array) -> jax.Array:
        scaled = logits / temperature
        if top_k:
            least = jax.lax.top_k(scaled, top_k)[0][..., -1:]
            scaled = jnp.where(scaled < least, -jnp.inf, scaled)
        return jnp.argmax(noise[..., factor, :] + scaled, axis=-1)

    return choose


def choose_likeliest(factor: int, logits: jax.Array) -> jax.Array:
    """The likeliest digits, as a `Choose`."""
    del factor
    return jnp.argmax(logits, axis=-1)
