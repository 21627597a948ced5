"""HMA: frame embedding -> stems -> trunk -> heads.

One forward pass that joins the parts, with the options that training, evaluation and generation need. Masking and
losses are in `objective`, decoding in `generation`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import nnx

from hma_jax.config import ExecutionConfig, ModelConfig
from hma_jax.config.training import ActionLeak
from hma_jax.kernels.pointwise import over_tokens, replaced, shifted
from hma_jax.model.conditioning import ActionFeature
from hma_jax.model.embodiments import ActionUnits, EmbodimentTable
from hma_jax.model.frames import Recall, factorise, make_embed, make_frame_head
from hma_jax.model.heads import Denoiser, make_action_head
from hma_jax.model.layers import FINE_EPS, LayerNorm
from hma_jax.model.params import Declared, declare, param, used, zeros
from hma_jax.model.stems import Stem
from hma_jax.model.trunk import TemporalCache, Trunk
from hma_jax.runtime.sharding import constrain


def causal_mask(frames: int) -> jax.Array:
    """bool [T, T]: a frame attends to itself and to those before it."""
    return jnp.tril(jnp.ones((frames, frames), bool))


class Outputs(NamedTuple):
    """What a pass returns, for the frames that it was given or for those from `predict_from` on."""

    # The frame head's output for each token, float32: logits [B, T, S, Q, V]; with chained factors the features from
    # which logits are computed, with latents the denoiser's conditions, both [B, T, S, D].
    token_outputs: jax.Array
    action_features_BTD: jax.Array | None  # mean output of each frame's action tokens; None without such tokens
    cache: TemporalCache | None  # keys and values of the first `cache_frames` frames


class HMA(nnx.Module):
    """The world model, of ids or of latents, with every kind of conditioning on actions."""

    def __init__(self, config: ModelConfig, table: EmbodimentTable, execution: ExecutionConfig):
        self.config, self.table, self.dtype = config, table, jnp.dtype(execution.dtype)
        self._units: ActionUnits | None = None  # the table's
        self.embed = make_embed(config)
        self.embed.mask.set_metadata(use="frames_predicted")  # a token is masked only to be predicted
        self.recall = used("frames_predicted", Recall(config)) if config.recall else None
        shape = (config.frames, config.position_slots, config.width)
        self.positions = param(shape, ("T", "P", "D"), zeros, role="vector")
        self.norm = LayerNorm(config.width, eps=FINE_EPS) if config.diffusion else None
        self.stem = used("actions_shown", Stem(config, table))
        # One vector per frame for actions that are hidden.
        self.action_mask = param((config.frames, config.width), ("T", "D"), zeros, role="vector")
        self.action_mask.set_metadata(use="actions_hidden")
        self.trunk = Trunk(config, table.size, execution)
        self.frame_head = make_frame_head(config)
        self.denoiser = (
            used("frames_predicted", Denoiser(config, config.diffusion.token_channels, execution))
            if config.diffusion
            else None
        )
        self.action_head = make_action_head(config, table, execution)

    def __call__(
        self,
        frames: jax.Array,
        masked: jax.Array | None,
        actions_BTU: jax.Array | None,
        embodiment_B: jax.Array,
        *,
        action_hidden_BT: jax.Array | None = None,
        leak: ActionLeak = "none",
        visible: jax.Array | None = None,
        positions: jax.Array | None = None,
        past: TemporalCache | None = None,
        before: jax.Array | None = None,
        cache_frames: int = 0,
        predict_from: int = 0,
        robot_row_B: jax.Array | None = None,
    ) -> Outputs:
        """One pass over ids [B, T, S] or latents [B, T, S, C], masked where `masked` (bool) is True.

        `actions_BTU` are raw chunks as `align` arranges them: as released, frame t carries the
        chunk executed after it was seen (reference section 1.3). Where `action_hidden_BT` is True the model is not
        shown them (`leak` allows the release's exceptions, see `MaskingConfig.action_leak`). With None instead of
        actions, the pass runs without action tokens and conditioning. The frames stand at window positions `positions`
        (int [T]; default: from 0 on). `visible` [T, T_past + T], or with a leading B, is causal by default: no real
        frame then sees the padding at a window's end. `before`, of the shape of `frames`, holds the frame that precedes
        each of them, which `config.recall` reads; by default it is the previous frame in `frames`. The cache of the
        first `cache_frames` frames is returned; frames before `predict_from` get no predictions. If the parameters hold
        the slices of only some robots, `robot_row_B` [B] is each example's index into them.
        """
        config = self.config
        count = frames.shape[1]
        if positions is None:
            positions = jnp.arange(count)
        if visible is None:
            visible = causal_mask(count)
        robot_row_B = embodiment_B if robot_row_B is None else robot_row_B
        x = self.embed(frames, masked, self.dtype)
        if self.recall is not None and masked is not None:
            unknown = masked.any(axis=-1) if masked.ndim == x.ndim else masked
            x = self.recall(x, unknown, self._a_frame_earlier(frames, unknown, before))
        action = None
        if actions_BTU is not None:
            feature = self.stem(self.normalise(actions_BTU, embodiment_B).astype(self.dtype), robot_row_B)
            from_tokens = from_blocks = action_hidden_BT
            if leak != "none":
                from_blocks = self._hidden_through_leaks(action_hidden_BT, embodiment_B, positions)
            if leak == "all":
                from_tokens = from_blocks
            action = ActionFeature(feature, None if from_blocks is None else ~from_blocks)
            if config.concat:
                x = jnp.concatenate([x, self._action_tokens(feature, from_tokens, positions)], axis=2)
        x = shifted(x, jnp.take(self.positions.get_value(), positions, axis=0)[:, : x.shape[2]])
        if self.norm is not None:
            x = self.norm(x)
        x = constrain(x, ("B", None, None, "D_act"))
        x, cache = self.trunk(x, action, robot_row_B, visible, past, cache_frames)
        action_features_BTD = x[:, :, config.tokens :].mean(axis=2) if x.shape[2] > config.tokens else None
        x = x[:, predict_from:, : config.tokens]
        token_outputs = self.frame_head(x, positions[predict_from:]) if config.diffusion else self.frame_head(x)
        return Outputs(token_outputs, action_features_BTD, cache)

    def _a_frame_earlier(self, frames: jax.Array, unknown_BTS: jax.Array, before: jax.Array | None) -> jax.Array:
        """[B, T, S, D]: the embedding at each token's position one frame earlier, 0 where that token is unknown too."""
        if before is not None:
            return self.embed(before, None, self.dtype)
        x = jnp.where(unknown_BTS[..., None], 0, self.embed(frames, None, self.dtype))
        return jnp.concatenate([jnp.zeros_like(x[:, :1]), x[:, :-1]], axis=1)

    def _hidden_through_leaks(
        self, action_hidden_BT: jax.Array | None, embodiment_B: jax.Array, positions: jax.Array
    ) -> jax.Array | None:
        """bool [B, T]: the frames whose action is hidden despite the leak; None: there are none. They are those of
        robots without recorded actions, and with `causal` alignment the first, to which no action led
        (`align_hidden`)."""
        causal = self.config.action_alignment == "causal"
        if action_hidden_BT is None or (all(self.table.chunks) and not causal):
            return None
        nothing_BT = jnp.asarray(self.table.chunks == 0)[embodiment_B][:, None]
        if causal:
            nothing_BT = nothing_BT | (positions == 0)
        return action_hidden_BT & nothing_BT

    def _action_tokens(
        self, feature_BTD: jax.Array, action_hidden_BT: jax.Array | None, positions: jax.Array
    ) -> jax.Array:
        """K copies of each frame's feature, or of its learned vector where it is hidden."""
        if action_hidden_BT is not None:
            vectors_TD = jnp.take(self.action_mask.get_value(), positions, axis=0)
            feature_BTD = replaced(feature_BTD, action_hidden_BT, vectors_TD)
        return over_tokens(feature_BTD, self.config.action_tokens)

    def with_action_units(self, units: ActionUnits) -> HMA:
        """This model, changed in place, with `units` instead of its table's scale of actions. Inside a traced function
        `units` can thus be an input of the program instead of a constant. Evaluation uses this; training does not, and
        `train_model` says why."""
        self._units = nnx.data(units)
        return self

    def normalise(self, actions: jax.Array, embodiment_B: jax.Array) -> jax.Array:
        """Raw chunks [B, ..., U] as the model computes with them: see `ActionUnits.normalise`."""
        return (self._units or self.table.scale()).normalise(actions, embodiment_B)

    def unnormalise(self, actions: jax.Array, embodiment_B: jax.Array) -> jax.Array:
        """The inverse of `normalise`."""
        return (self._units or self.table.scale()).unnormalise(actions, embodiment_B)

    def logits(self, token_outputs: jax.Array, ids: jax.Array) -> jax.Array:
        """Logits [..., Q, V] of each factor from the `token_outputs` of tokens [...]. With chained factors, those of a
        factor are conditional on the factors of `ids` [...] before it."""
        digits = factorise(ids, self.config.factors, self.config.factor_vocab)
        return self.frame_head.decode_factors(token_outputs, lambda factor, _: digits[..., factor])[1]

    def align(self, actions: jax.Array) -> jax.Array:
        """Recorded chunks [..., T, U] -> the chunk that conditions each frame: its own chunk as released; with `causal`
        alignment the one before it. (The first frame then has an arbitrary chunk, which `align_hidden` hides.)"""
        if self.config.action_alignment == "released":
            return actions
        return jnp.concatenate([actions[..., :1, :], actions[..., :-1, :]], axis=-2)

    def align_hidden(self, action_hidden_BT: jax.Array | None, shape: tuple[int, int]) -> jax.Array | None:
        """Which recorded chunks are hidden (None: none) -> which frames are shown no action.

        `shape` is (B, T). With `causal` alignment the first frame is never shown one: no action led to it, and its own
        chunk lies in its future.
        """
        if self.config.action_alignment == "released":
            return action_hidden_BT
        if action_hidden_BT is None:
            return jnp.broadcast_to(jnp.arange(shape[1]) == 0, shape)
        return jnp.concatenate([jnp.ones_like(action_hidden_BT[:, :1]), action_hidden_BT[:, :-1]], axis=1)


@lru_cache(maxsize=16)
def declare_model(
    config: ModelConfig, table: EmbodimentTable, execution: ExecutionConfig = ExecutionConfig()
) -> Declared[HMA]:
    """The model's declarations, which do not depend on how it is executed; see `params.Declared`."""
    return declare(lambda: HMA(config, table, execution), execution.mesh.min_shard_size)
