"""How actions act inside every block, between spatial and temporal attention.

Reference section 1.6. A hidden action has no effect on any path: where `shown_BT` is False, nothing is added. DIFFERS:
the release masks only the action tokens, and still modulates by the masked actions.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import ModelConfig
from hma_jax.kernels import plain, remat
from hma_jax.kernels.dense import per_robot
from hma_jax.kernels.pointwise import layer_norm, over_tokens, scaled, shifted
from hma_jax.model.attention import attention_scale
from hma_jax.model.initial import trunk_init
from hma_jax.model.layers import FINE_EPS, EmbodimentLinear, robot_vectors
from hma_jax.model.params import bias, layouts_of, ones, param, used


class ActionFeature(NamedTuple):
    """A block's input from actions."""

    feature_BTD: jax.Array
    shown_BT: jax.Array | None  # bool; None: all of them


class BlockConditioning(nnx.Module):
    """What an action adds to the tokens of a block."""

    def __init__(self, config: ModelConfig, embodiments: int):
        """The base class declares no parameters."""

    def __call__(
        self, x_BTPD: jax.Array, action: ActionFeature, robot_row_B: jax.Array, visible: jax.Array, past: Any
    ) -> tuple[jax.Array, Any]:
        """Returns (what is added to `x_BTPD`, what is cached for these frames). `past` is what was cached for earlier
        frames; `visible` [T, T_past + T] is as for temporal attention."""
        raise NotImplementedError

    @staticmethod
    def multiplications(config: ModelConfig, seen: float) -> tuple[float, float]:
        """Multiply-adds of its matrix products, (per token, per frame); `seen` as for `flops.pass_flops`."""
        raise NotImplementedError


class Modulation(BlockConditioning):
    """W_o[LN(x) (1 + scale) + shift] with (shift, scale) from the action feature."""

    def __init__(self, config: ModelConfig, embodiments: int):
        width = config.width
        init, wide = trunk_init(config, width, width), trunk_init(config, width, 2 * width)
        square, double = (width, width), (width, 2 * width)
        axes = ("D", "D_out")
        self.hidden = EmbodimentLinear(embodiments, square, axes, init=init, role="hidden")
        self.shift_scale = EmbodimentLinear(embodiments, double, axes, init=wide, role="hidden")
        self.out = EmbodimentLinear(embodiments, square, axes, init=init, role="hidden")

    def __call__(
        self, x_BTPD: jax.Array, action: ActionFeature, robot_row_B: jax.Array, visible: jax.Array, past: None
    ) -> tuple[jax.Array, None]:
        del visible, past
        both = self.shift_scale(jax.nn.silu(self.hidden(action.feature_BTD, robot_row_B)), robot_row_B)
        shift, scale = (over_tokens(part, x_BTPD.shape[2]) for part in jnp.split(both, 2, axis=-1))
        y = self.out(layer_norm(x_BTPD, FINE_EPS) * (1 + scale) + shift, robot_row_B)
        return _where_shown(action, y), None

    @staticmethod
    def multiplications(config: ModelConfig, seen: float) -> tuple[float, float]:
        return config.width**2, 3 * config.width**2  # shift and scale are computed once per frame


class Addition(BlockConditioning):
    """The feature itself, on every token of its frame; no parameters."""

    def __call__(
        self, x_BTPD: jax.Array, action: ActionFeature, robot_row_B: jax.Array, visible: jax.Array, past: None
    ) -> tuple[jax.Array, None]:
        del robot_row_B, visible, past
        return _where_shown(action, over_tokens(action.feature_BTD, x_BTPD.shape[2])), None

    @staticmethod
    def multiplications(config: ModelConfig, seen: float) -> tuple[float, float]:
        return 0, 0


class CrossAttention(BlockConditioning):
    """Every token attends to the actions of its own and earlier frames, with normalised q and k.

    DIFFERS: in the release, heads attend to each other at one position and the results are scrambled over time
    (reference section 9.1). A checkpoint of the release can therefore be converted, but does not compute here what it
    was trained to compute. The output is 0 for a frame that is shown no action.

    Keys carry no time, so a frame's own action is distinguished from earlier ones by a bonus on its logit: at
    initialisation its weight equals that of all the others together. Even so, models follow actions less than with the
    other kinds of conditioning (the findings of cpu-full).
    """

    def __init__(self, config: ModelConfig, embodiments: int):
        width, heads, head = config.width, config.heads, config.head_width
        init = trunk_init(config, width, width)

        def project() -> nnx.Param:
            return param((embodiments, width, width), ("E", "D", "D_out"), init, role="hidden")

        self.q, self.k, self.v = project(), project(), project()
        self.out = EmbodimentLinear(embodiments, (width, width), ("D_out", "D"), init=init, role="hidden")
        self.gain = param((embodiments, head), ("E", None), ones, role="vector")
        self.bias = bias((embodiments, head), ("E", None))
        self.heads, self.scale = heads, attention_scale(config)

    def __call__(
        self,
        x_BTPD: jax.Array,
        action: ActionFeature,
        robot_row_B: jax.Array,
        visible: jax.Array,
        past: tuple[jax.Array, jax.Array, jax.Array] | None,
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array, jax.Array]]:
        """Keys, values and shown are cached."""
        a = action.feature_BTD
        shown = jnp.ones(a.shape[:2], bool) if action.shown_BT is None else action.shown_BT
        q = self._heads(remat.tag_product(self._map(x_BTPD, self.q, robot_row_B)), robot_row_B)
        k = self._heads(self._map(a, self.k, robot_row_B), robot_row_B)
        v = self._map(a, self.v, robot_row_B).reshape(k.shape)
        new = (k, v, shown)
        if past is not None:
            k, v, shown = (jnp.concatenate([old, own], axis=1) for old, own in zip(past, new, strict=True))
        allowed_BTs = visible & shown[:, None]
        logits = self.scale * jnp.einsum("btphi,bshi->bphts", q, k, preferred_element_type=jnp.float32)
        logits = logits + _own_bonus(allowed_BTs)[:, None, None]
        weights = plain.softmax(logits, allowed_BTs[:, None, None]).astype(v.dtype)
        y = jnp.einsum("bphts,bshi->btphi", weights, v).reshape(x_BTPD.shape)
        some = jnp.any(allowed_BTs, axis=-1)
        return jnp.where(some[:, :, None, None], self.out(y, robot_row_B), 0), new

    @staticmethod
    def multiplications(config: ModelConfig, seen: float) -> tuple[float, float]:
        return 2 * config.width**2 + 2 * seen * config.width, 2 * config.width**2

    def _map(self, x: jax.Array, kernel: nnx.Param, robot_row_B: jax.Array) -> jax.Array:
        return per_robot(x, kernel.astype(x.dtype), robot_row_B, layouts_of(kernel))

    def _heads(self, x: jax.Array, robot_row_B: jax.Array) -> jax.Array:
        """[B, ..., D] -> [B, ..., H, I], a layer norm over each head."""
        x = layer_norm(x.reshape(*x.shape[:-1], self.heads, -1), FINE_EPS)
        return shifted(scaled(x, robot_vectors(self.gain, robot_row_B, x)), robot_vectors(self.bias, robot_row_B, x))


def _own_bonus(allowed_BTs: jax.Array) -> jax.Array:
    """bool [B, T, T_past + T], the actions that a frame may attend to -> what is added to their logits: the logarithm
    of the number of other actions for its own action, 0 for the others."""
    count, keys = allowed_BTs.shape[1:]
    itself = jnp.eye(count, keys, k=keys - count, dtype=bool)
    others = jnp.sum(allowed_BTs & ~itself, axis=-1, keepdims=True)
    return jnp.where(itself, jnp.log(jnp.maximum(others, 1).astype(jnp.float32)), 0)


def _where_shown(action: ActionFeature, y: jax.Array) -> jax.Array:
    return y if action.shown_BT is None else jnp.where(action.shown_BT[:, :, None, None], y, 0)


IN_BLOCKS: dict[str, type[BlockConditioning]] = {
    "modulate": Modulation,
    "add": Addition,
    "cross_attention": CrossAttention,
}
"""The class of each `ModelConfig.block_conditioning`."""


def make_conditioning(config: ModelConfig, embodiments: int) -> BlockConditioning | None:
    """The module of one block; None where actions enter as tokens only."""
    way = config.block_conditioning
    return used("actions_shown", IN_BLOCKS[way](config, embodiments)) if way else None
