"""One optimiser step as a pure function: masks, gradients, accumulation, update."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import MaskingConfig, ModelConfig, TrainConfig, check_micro_batches, check_objective, require
from hma_jax.config.training import ActionLeak
from hma_jax.kernels.random import GENERATOR, key_of
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import HMA
from hma_jax.model.params import Declared, Params, Use, is_spec
from hma_jax.objective.losses import LossSums, TargetCounts, count_targets, loss_metrics, masked_loss, noise_keys
from hma_jax.objective.masking import Masked, mask_batch
from hma_jax.runtime.rows import split_rows
from hma_jax.training import active_robots
from hma_jax.training.average import update_average
from hma_jax.training.optimizer import (
    Presence,
    apply_update,
    check_schedule,
    clip_by_global_norm,
    learning_rate_multiplier,
    make_schedule,
    put_adam,
    take_adam,
)
from hma_jax.training.state import FINITE, TrainState, all_finite
from hma_jax.training.train_only import Everything, OwnOnly

Batch = dict[str, jax.Array]
"""Arrays by name:

    tokens          int32 [B, T, S], or latents float32 [B, T, S, C]
    actions         float32 [B, T, U], raw, zero-padded
    embodiment      int32 [B], index into the table

Optional:

    real            bool [B, T]: False for padding frames at the end of a short window; all batches of a run have it, or
                    none
    seed            uint32 [2]: `jax.random.key_data` of the seed's key (`key_of`); with it, runs of different seeds
                    share one compiled step
"""


TRAINING_ARRAYS = ("tokens", "actions", "embodiment", "real")
"""Arrays that training and validation take from the batches of the host."""


def make_train_step(
    declared: Declared[HMA], table: EmbodimentTable, model: ModelConfig, config: TrainConfig, accumulate: int = 1
) -> Callable[[TrainState, Batch], tuple[TrainState, dict[str, jax.Array]]]:
    """step(state, batch) -> (state, metrics), to be jitted with the state donated.

    The loss is the mean over all masked tokens of the global batch, plus the weighted mean over its hidden actions; it
    does not depend on the number of micro-batches. Randomness is fold_in(seed, step), then the example's row.
    """
    trained_E = np.array([name in (config.only or table.names) for name in table.names])
    check_step(table, trained_E, model, config, accumulate)
    masking, specs = config.masking, declared.specs
    leaking_E = find_leaking(table, model, masking.action_leak)
    trained = OwnOnly(specs, trained_E) if config.only else Everything(specs, trained_E)
    schedule = make_schedule(config.optimizer, config.steps)
    multipliers = jax.tree.map(lambda spec: learning_rate_multiplier(spec, model), trained.specs, is_leaf=is_spec)
    gradient = make_gradient(declared, masking, accumulate)

    def step(state: TrainState, batch: Batch) -> tuple[TrainState, dict[str, jax.Array]]:
        batch = dict(batch)
        seed = batch.pop("seed", None)
        key = key_of(config.seed) if seed is None else jax.random.wrap_key_data(seed, impl=GENERATOR)
        key = jax.random.fold_in(key, state.step)
        real_BT = batch.get("real")
        masked = mask_batch(key, batch["tokens"], batch["embodiment"], model, masking, table, real_BT)
        counts = count_targets(masked, batch["tokens"], masking)
        active = active_robots.choose(batch["embodiment"], table.size)
        own = active_robots.take(state.params, specs, active.places_G)
        rows = batch | {"masked": masked, "key": noise_keys(key, config.batch), "slice": active.robot_row_B}
        grads, total = gradient(own, rows, counts)
        grads, norm = clip_by_global_norm(trained.mask(grads, active), config.optimizer.clip_norm)
        rate = schedule(state.step)
        presence = find_presence(masked, batch["embodiment"], trained_E, model, trained.shared, real_BT, leaking_E)
        here = presence._replace(robots={use: x[active.robots_G] for use, x in presence.robots.items()})
        places_G = trained.moment_places(active)
        new, adam = apply_update(
            trained.pick(grads), take_adam(state.opt_state, trained.specs, active, places_G), trained.pick(own),
            trained.specs, multipliers, here, rate, config.optimizer, declared.min_shard_size,
        )  # fmt: skip
        opt_state = put_adam(state.opt_state, adam, trained.specs, active, places_G)
        new = trained.put(own, new)
        params = active_robots.put(state.params, new, specs, active.places_G)
        ema = update_average(state.ema, params, config.ema_decay, state.step) if config.ema_decay else None
        metrics = loss_metrics(total, counts, masking, discrete=not model.diffusion)
        metrics |= {"grad_norm": norm, "learning_rate": rate}
        metrics |= {FINITE + "gradient": jnp.isfinite(norm), FINITE + "update": all_finite(new)}
        return TrainState(state.step + 1, params, opt_state, ema), metrics

    return step


def make_gradient(
    declared: Declared[HMA], masking: MaskingConfig, accumulate: int
) -> Callable[[Params, Batch, TargetCounts], tuple[Params, LossSums]]:
    """gradient(params, rows, counts) -> (gradient of the loss, loss sums) over `rows`, as `loss_of_rows` takes them, in
    `accumulate` micro-batches. `counts` are the targets of all rows."""

    def sums(params: Params, rows: Batch, counts: TargetCounts) -> tuple[jax.Array, LossSums]:
        result = loss_of_rows(declared.merge(params), rows, masking, training=True)
        loss = result.tokens / counts.tokens + masking.action_loss_weight * result.actions / counts.actions
        return loss, result

    one_pass = jax.grad(sums, has_aux=True)

    def gradient(params: Params, rows: Batch, counts: TargetCounts) -> tuple[Params, LossSums]:
        if accumulate == 1:
            return one_pass(params, rows, counts)
        micro = split_rows(rows, accumulate)
        zero = jax.tree.map(jnp.zeros_like, params)

        def body(carry: tuple[Params, LossSums], one: Batch) -> tuple[tuple[Params, LossSums], None]:
            return jax.tree.map(jnp.add, carry, one_pass(params, one, counts)), None

        (grads, total), _ = jax.lax.scan(body, (zero, LossSums(*[jnp.zeros(())] * 3)), micro)
        return grads, total

    return gradient


def loss_of_rows(model: HMA, rows: Batch, masking: MaskingConfig, *, training: bool) -> LossSums:
    """`masked_loss` of a batch that also has `masked`, `key` (`noise_keys`) and, where the parameters are those of only
    some robots, `slice` (`robot_row_B`)."""
    return masked_loss(
        model, rows["masked"], rows["tokens"], rows["actions"], rows["embodiment"], masking, rows["key"],
        rows.get("slice"), rows.get("real"), training=training,
    )  # fmt: skip


def check_step(
    table: EmbodimentTable, trained_E: np.ndarray, model: ModelConfig, config: TrainConfig, accumulate: int
) -> None:
    """Raises ConfigError for what cannot be trained, or would learn nothing."""
    check_micro_batches(config.batch, accumulate)
    check_schedule(config.optimizer, config.steps)
    check_objective(model, config.masking)
    require(
        not set(config.only) - set(table.names),
        f"train.only names {', '.join(config.only)}, but the robots are {', '.join(table.names)}",
    )
    learning = [entry for entry, trained in zip(table.entries, trained_E, strict=True) if trained]
    check_targets(learning, config.masking)
    if config.only:
        check_own(learning, config.masking)


def check_targets(robots: Sequence[Embodiment], masking: MaskingConfig) -> None:
    """Raises ConfigError if these robots have no targets: every loss would be a mean over nothing, 0."""
    frames = masking.predicts_frames and any(robot.video_targets for robot in robots)
    actions = masking.predicts_actions and any(robot.chunk for robot in robots)
    predicted = "frames" if masking.predicts_frames else "actions"
    require(
        frames or actions,
        f"train.masking.setting {masking.setting!r} predicts {predicted}, but {robots[0].name} and all other robots "
        "that are trained have none; choose another setting or other robots",
    )


def check_own(robots: Sequence[Embodiment], masking: MaskingConfig) -> None:
    """Raises ConfigError if no per-robot parameter of these robots would ever be updated."""
    shown = not masking.ignores_actions
    require(
        shown and any(robot.chunk for robot in robots),
        f"train.only: {', '.join(robot.name for robot in robots)} would have no parameters to train: a robot's own "
        "parameters are all for actions, and "
        f"{'these robots have none' if shown else 'train.masking.setting passive shows none'}; leave out train.only "
        "(in hma adapt: add --everything)",
    )


def find_leaking(table: EmbodimentTable, model: ModelConfig, leak: ActionLeak) -> np.ndarray:
    """bool [E]: the robots whose hidden actions the model is shown through a `leak`."""
    # Blocks without conditioning have nothing to leak into.
    leaks = leak == "all" or (leak == "conditioning" and model.block_conditioning is not None)
    return leaks & (table.chunks > 0)


def find_presence(
    masked: Masked,
    embodiment_B: jax.Array,
    trained_E: jax.Array,
    model: ModelConfig,
    everything: bool = True,
    real_BT: jax.Array | None = None,
    leaking_E: np.ndarray | None = None,
) -> Presence:
    """The parameters that a batch updates. Per-robot parameters are updated only for the robots of `trained_E`, shared
    ones only if `everything` is trained. Padding frames (not `real_BT`) do not count. Hidden actions of `leaking_E`
    (`find_leaking`; None: of no robot) count as shown."""
    action_hidden_BT = masked.action_hidden_T
    shown_BT = ~action_hidden_BT
    if leaking_E is not None and leaking_E.any():
        shown_BT = shown_BT | jnp.asarray(leaking_E)[embodiment_B][:, None]
    real_BT = jnp.ones_like(action_hidden_BT) if real_BT is None else real_BT
    rows: dict[Use, jax.Array] = {
        "always": jnp.ones(len(embodiment_B), bool),
        "actions_shown": (shown_BT & real_BT).any(axis=1),
        # With causal alignment the first frame is never shown an action.
        "actions_hidden": (action_hidden_BT & real_BT).any(axis=1) | (model.action_alignment == "causal"),
        "actions_predicted": masked.action_targets_T.any(axis=1),
        "frames_predicted": masked.targets_TS.any(axis=(1, 2)),
    }
    return Presence(
        {use: here.any() & everything for use, here in rows.items()},
        {use: jnp.zeros(len(trained_E), bool).at[embodiment_B].max(here) & trained_E for use, here in rows.items()},
    )
