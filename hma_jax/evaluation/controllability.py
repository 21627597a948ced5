"""Whether a model's frames follow the actions that it is given, and no others.

* action-nats: how much less likely the recorded frames become when the actions are those of another episode of the same
  robot, in nats per token (continuous: in units of the diffusion loss, with the same noise). The comparison is paired,
  over all tokens, and in distribution; the random actions of delta PSNR are unlike any that the robot was given.
* retrieval: how often, of the true actions and those of the other episodes, the true ones give the recorded frames the
  highest likelihood. Among equally likely sequences each is chosen with equal chance, so a model that ignores actions
  finds the true ones exactly one time in sixteen (with fifteen other sequences).
* counterfactual PSNR: a rollout under another episode's actions, compared with the true frames under those actions,
  where a simulator made them. The counterfactual gain is its difference from the PSNR of the rollout under the recorded
  actions, compared with the same frames: it is above zero only if the model goes where the other actions lead.

Every sequence is evaluated by the same program, one after the other, so that equal likelihoods are equal to the last
bit.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from hma_jax.evaluation.metrics import difference, mean_over_frames, psnr


def for_each_sequence(
    evaluate: Callable[[jax.Array], dict[str, jax.Array]], actions_BTU: jax.Array, others_BOTU: jax.Array
) -> dict[str, jax.Array]:
    """`evaluate`, which maps actions [B, T, U] to metrics of each window [B], applied to the true sequence and then to
    each of the others: [1 + O, B]."""
    sequences = jnp.concatenate([actions_BTU[:, None], others_BOTU], axis=1)
    return jax.lax.map(evaluate, jnp.moveaxis(sequences, 1, 0))


def action_metrics(loss_OB: jax.Array, valid_BO: jax.Array) -> dict[str, jax.Array]:
    """Action-nats and retrieval, [B] each, nan where no other sequence is valid.

    `loss_OB` [1 + O, B]: the loss under the true actions, then under the others. Only the others marked in `valid_BO`
    count.
    """
    truth, others, valid = loss_OB[0], loss_OB[1:], valid_BO.T
    count = jnp.sum(valid, axis=0)
    some = count > 0
    lost = jnp.sum(jnp.where(valid, others - truth, 0), axis=0) / jnp.maximum(count, 1)
    better = jnp.sum(valid & (others < truth), axis=0)
    equal = jnp.sum(valid & (others == truth), axis=0)
    found = {
        "action_nats": lost,
        "retrieval": jnp.where(better == 0, 1 / (1 + equal), 0),
        "retrieval_rank": 1 + better + equal / 2,
        "retrieval_chance": 1 / (1 + count),
    }
    return {name: jnp.where(some, x, jnp.nan) for name, x in found.items()}


def counterfactual(
    shown: jax.Array,
    other: jax.Array,
    truth: jax.Array,
    before: jax.Array,
    seen_B: jax.Array,
    real_BT: jax.Array | None,
) -> dict[str, jax.Array]:
    """Counterfactual PSNR, the PSNR of copying, and the gain, [B] each, nan where `seen_B` is False.

    Images uint8 [B, n, H, W, 3] after the prompt: made under the recorded actions (`shown`) and under the `other`
    actions, and the `truth` under the other actions. `before` [B, 1, H, W, 3] is the last image of the prompt. Means
    are over the frames that are `real_BT`.
    """
    made = jnp.stack([other, shown], axis=1)  # in one array: equal images get equal numbers, to the last bit
    of_frames = jax.lax.optimization_barrier(psnr(made, jnp.broadcast_to(truth[:, None], made.shape)))
    found = {
        "counterfactual_psnr": mean_over_frames(of_frames[:, 0], real_BT),
        "counterfactual_copy": mean_over_frames(psnr(jnp.broadcast_to(before, truth.shape), truth), real_BT),
        "counterfactual_gain": mean_over_frames(difference(of_frames[:, 0], of_frames[:, 1]), real_BT),
    }
    return {name: jnp.where(seen_B, x, jnp.nan) for name, x in found.items()}
