"""Small networks behind the trunk: the denoiser of the continuous variant, and action heads.

An action head reads the mean of a frame's action-token outputs: a linear regression in the
discrete variant, a denoiser per robot in the continuous one (reference sections 1.7 and 2.4).
Both predict normalised actions.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from hma_jax.config import ExecutionConfig, ModelConfig
from hma_jax.kernels import remat
from hma_jax.kernels.dense import contract, from_actions, take_by_robot, to_actions
from hma_jax.kernels.pointwise import layer_norm, shifted
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.initial import readout_init
from hma_jax.model.layers import FINE_EPS, EmbodimentLinear, LayerNorm, Linear
from hma_jax.model.params import bias, layouts_of, normal, param, stack, used, xavier_uniform, zeros

TIME_FEATURES = 256


def timestep_embedding(t: jax.Array, size: int = TIME_FEATURES) -> jax.Array:
    """[cos | sin] of t times size/2 frequencies from 1 down to nearly 1/10000: t [...] -> [..., size].

    t is the raw step of the original process.
    """
    half = size // 2
    frequencies = np.exp(-math.log(10_000) * np.arange(half) / half)
    angles = t[..., None].astype(jnp.float32) * jnp.asarray(frequencies, jnp.float32)
    return jnp.concatenate([jnp.cos(angles), jnp.sin(angles)], axis=-1)


class ResBlock(nnx.Module):
    """x + gate * mlp(norm(x) (1 + scale) + shift), where scale, shift and gate come from the condition."""

    def __init__(self, width: int):
        init = xavier_uniform(width, width)
        self.norm = LayerNorm(width, axis=None, eps=FINE_EPS)
        self.into = Linear((width, width), ("W", "F"), init=init, role="vector")
        self.out = Linear((width, width), ("F", "W"), init=init, role="vector")
        self.modulation = Linear((width, 3 * width), ("W", "F"), init=zeros, role="vector")

    def __call__(self, x: jax.Array, condition: jax.Array) -> jax.Array:
        modulation = remat.tag_product(self.modulation(jax.nn.silu(condition)))
        shift, scale, gate = jnp.split(modulation, 3, axis=-1)
        h = remat.tag_costly(self.into(self.norm(x) * (1 + scale) + shift))
        return x + gate * remat.tag_product(self.out(jax.nn.silu(h)))


class Denoiser(nnx.Module):
    """A residual MLP, modulated by time and condition, that predicts noise and a variance fraction (reference section
    2.4).

    Its width does not follow the trunk's: under muP only the condition's input scales, as the input of a read-out does.
    DIFFERS: in every head the modulation and the last layer start at zero, time and condition at N(0, 0.02), and the
    rest at Xavier. The release, because of the order of its constructors, draws all of the frames' head from N(0,
    0.02); it draws the action heads with a Xavier gain of 0.1.
    """

    def __init__(self, config: ModelConfig, channels: int, execution: ExecutionConfig, axis: str = "C"):
        width = config.diffusion.width
        self.dtype, self.remat, self.of_actions = jnp.dtype(execution.dtype), execution.remat, axis == "U"
        small = normal(0.02)
        self.multiplier = config.mup_multiplier("readout")
        self.time_in = Linear((TIME_FEATURES, width), ("W", "F"), init=small, role="vector")
        self.time_out = Linear((width, width), ("F", "W"), init=small, role="vector")
        self.condition = Linear((config.width, width), ("D", "F"), init=small, role="output")
        init = xavier_uniform(channels, width)
        self.into = Linear((channels, width), (axis, "F"), init=init, role="vector")
        self.blocks = nnx.List([ResBlock(width) for _ in range(config.diffusion.depth)])
        self.modulation = Linear((width, 2 * width), ("W", "F"), init=zeros, role="vector")
        self.out = param((width, 2, channels), ("F", None, axis), zeros, role="vector")
        self.out_bias = bias((2, channels), (None, axis), precise=True)

    def __call__(self, x: jax.Array, time: jax.Array, z: jax.Array) -> jax.Array:
        """x [..., C] noised at `time` given z [..., D] -> float32 [..., 2 C], noise first.

        `time` [...] may have axes of size 1: what depends on time alone is then computed once along them.
        """
        y = self.time_out(jax.nn.silu(self.time_in(timestep_embedding(time).astype(self.dtype))))
        y = y + self.condition((z / self.multiplier).astype(self.dtype))
        x = self._into(x.astype(self.dtype))
        for block in self.blocks:
            if self.remat != "none":  # "none" keeps everything, on a mesh too: no block gathers weights of its own
                block = remat.checkpointed(block.__call__, self.remat, scanned=False)
            x = block(x, y)
        shift, scale = jnp.split(self.modulation(jax.nn.silu(y)), 2, axis=-1)
        x = layer_norm(x, FINE_EPS) * (1 + scale) + shift
        return self._out(x).astype(jnp.float32)

    def _into(self, x: jax.Array) -> jax.Array:
        if not self.of_actions:
            return self.into(x)
        return shifted(from_actions(x, self.into.kernel.astype(x.dtype)), self.into.bias.get_value())

    def _out(self, x: jax.Array) -> jax.Array:
        """[..., F] -> [..., 2 C], at least in float32."""
        w = self.out.astype(x.dtype)
        if self.of_actions:
            both = jnp.stack([to_actions(x, w[:, k]) for k in (0, 1)], -2)
        else:
            both = contract(x, w, dtype=jnp.promote_types(x.dtype, jnp.float32))
        y = shifted(both, self.out_bias.get_value())
        return y.reshape(*y.shape[:-2], -1)


class ActionRegression(nnx.Module):
    """One linear read-out per robot."""

    def __init__(self, config: ModelConfig, table: EmbodimentTable):
        sizes = (config.width, table.action_width)
        self.multiplier = config.mup_multiplier("readout")
        init = readout_init(config, table.action_width)
        self.linear = EmbodimentLinear(table.size, sizes, ("D", "U"), init=init, role="output")

    def __call__(self, pooled_BTD: jax.Array, robot_row_B: jax.Array) -> jax.Array:
        """-> normalised actions, float32 [B, T, U]."""
        return self.linear(pooled_BTD / self.multiplier, robot_row_B).astype(jnp.float32)


class ActionDenoiser(nnx.Module):
    """One denoiser per robot, over its chunk padded to U."""

    def __init__(self, config: ModelConfig, table: EmbodimentTable, execution: ExecutionConfig):
        self.dtype = jnp.dtype(execution.dtype)
        self.robots = stack(lambda: Denoiser(config, table.action_width, execution, "U"), table.size, axis="E")

    def __call__(self, x_BTU: jax.Array, time_BT: jax.Array, z_BTD: jax.Array, robot_row_B: jax.Array) -> jax.Array:
        """Normalised, noised chunks -> float32 [B, T, 2 U], noise first. `time_BT` may have axes of size 1."""
        time_BT = jnp.broadcast_to(time_BT, (len(x_BTU), time_BT.shape[1]))
        graphdef, params = nnx.split(self.robots)

        def taken(p: nnx.Param) -> nnx.Param:
            whole = p.get_value() if p.precise else p.astype(self.dtype)
            return p.replace(take_by_robot(whole, robot_row_B, layouts_of(p)))

        own = jax.tree.map(taken, params, is_leaf=lambda leaf: isinstance(leaf, nnx.Variable))
        return jax.vmap(lambda p, *args: nnx.merge(graphdef, p)(*args))(own, x_BTU, time_BT, z_BTD)


def make_action_head(config: ModelConfig, table: EmbodimentTable, execution: ExecutionConfig) -> nnx.Module | None:
    if not config.action_heads:
        return None
    if config.diffusion:
        head = ActionDenoiser(config, table, execution)
    else:
        head = ActionRegression(config, table)
    return used("actions_predicted", head)
