"""Lookup-free quantisation: a token is the signs of its latent channels.

This module has the arithmetic between latents, bits and token ids, and the regularisers of the latents. It has no
parameters and does not deal with images.

The conventions are those of the official tokenizer: bit k of an id is channel k (channel 0 is the lowest bit), a bit is
1 where the channel is positive, and the code value of a bit is 2 bit - 1. Factor 0 of an id is its low bits / factors
bits.

Reference: Yu et al. 2023, "Language Model Beats Diffusion: Tokenizer is Key to Visual
Generation", section 3.1.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def latents_to_ids(z: jax.Array) -> jax.Array:
    """Token ids, int32 [...], of latents [..., C]."""
    weights = 2 ** jnp.arange(z.shape[-1], dtype=jnp.int32)
    return jnp.sum(jnp.where(z > 0, weights, 0), axis=-1, dtype=jnp.int32)


def ids_to_codes(ids: jax.Array, bits: int) -> jax.Array:
    """Code values in {-1, +1}, float32 [..., bits], of token ids [...]."""
    bit = ids[..., None] >> jnp.arange(bits, dtype=ids.dtype) & 1
    return 2.0 * bit.astype(jnp.float32) - 1.0


def nearest_code(z: jax.Array) -> jax.Array:
    """Code values in {-1, +1} of latents, without a gradient; 0 counts as negative."""
    return jax.lax.stop_gradient(jnp.where(z > 0, 1.0, -1.0).astype(z.dtype))


def quantize(z: jax.Array) -> jax.Array:
    """`nearest_code` with the gradient of the identity (straight-through)."""
    return z + jax.lax.stop_gradient(nearest_code(z) - z)


def commitment(z: jax.Array) -> jax.Array:
    """Mean squared distance of latents from their own code; as a loss it keeps them near +-1."""
    return jnp.mean((z - nearest_code(z)) ** 2)


def entropies(z: jax.Array, factors: int, temperature: float) -> tuple[jax.Array, jax.Array]:
    """(uncertainty, diversity) in nats per bit, each in [0, log 2], of latents [..., C].

    A code c of a factor is assigned softly, p(c | z) ~ exp(-|z - c|^2 / temperature). Because
    codes are all sign patterns, p is a product over the channels. `uncertainty` is the
    mean entropy of p(. | z): low when every latent is close to its code. `diversity` is the entropy of p(.) averaged
    over all positions of the batch, jointly over the codes of a factor: high when all codes are used equally. The loss
    term to be minimised is uncertainty - diversity.
    """
    z = z.reshape(-1, factors, z.shape[-1] // factors)  # [n, Q, bits per factor]
    # |z + 1|^2 - |z - 1|^2 = 4 z is the log odds of the bit.
    log_on = jax.nn.log_sigmoid(4.0 * z / temperature)
    log_off = jax.nn.log_sigmoid(-4.0 * z / temperature)
    uncertainty = -jnp.mean(jnp.exp(log_on) * log_on + jnp.exp(log_off) * log_off)

    joint = jnp.ones((*z.shape[:2], 1))
    for k in range(z.shape[-1]):  # V = 2^k grows by one bit each time
        pair = jnp.exp(jnp.stack([log_off[..., k], log_on[..., k]], axis=-1))
        joint = (pair[..., :, None] * joint[..., None, :]).reshape(*z.shape[:2], -1)
    marginal = jnp.mean(joint, axis=0)  # [Q, V]
    diversity = -jnp.sum(marginal * jnp.log(marginal + 1e-9), axis=-1).mean() / z.shape[-1]
    return uncertainty, diversity
