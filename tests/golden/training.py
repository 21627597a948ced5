"""Cases of training the discrete model: losses, norms of gradients, and where the parameters end."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import OptimizerConfig
from hma_jax.model.params import is_spec
from hma_jax.training.optimizer import apply_update, clip_by_global_norm, init_adam, learning_rate_multiplier
from hma_jax.training.step import find_presence
from tests.golden.case import Case, norms
from tests.golden.discrete import as_masked, loss_and_accuracy


def check_train_steps(case: Case) -> None:
    """Updates with absent robots, muP learning rates, clipping and decay."""
    settings, config = case.info["optimizer"], case.run.model
    optimizer = OptimizerConfig(
        learning_rate=settings["lr"],
        weight_decay=settings["weight_decay"],
        beta1=settings["beta1"],
        beta2=settings["beta2"],
        epsilon=settings["eps"],
        clip_norm=settings["max_grad_norm"],
    )
    specs = case.declared.specs
    multipliers = jax.tree.map(lambda spec: learning_rate_multiplier(spec, config), specs, is_leaf=is_spec)
    trained = np.ones(case.table.size, bool)

    @jax.jit
    def step(params, state, recorded, labels, actions, robots):
        def mean_loss(p):
            return loss_and_accuracy(case.declared.merge(p), recorded, labels, actions, robots)[0]

        loss, grads = jax.value_and_grad(mean_loss)(params)
        grads, norm = clip_by_global_norm(grads, optimizer.clip_norm)
        presence = find_presence(recorded, robots, trained, config)
        rate = jnp.float32(optimizer.learning_rate)
        return *apply_update(grads, state, params, specs, multipliers, presence, rate, optimizer, 2**14), loss, norm

    params, state = case.params, jax.jit(init_adam, static_argnums=1)(case.params, case.table.size)
    losses, gradient_norms = [], []
    for s, robot in enumerate(case.info["step_domains"]):
        ids = case.inputs["input_ids"][s].astype(np.int32)
        ids = ids.reshape(len(ids), -1, config.tokens)
        masked = ids == config.vocab_size
        labels = case.inputs["labels"][s].astype(np.int32).reshape(ids.shape)
        recorded = as_masked(np.where(masked, 0, ids), masked)
        actions, robots = case.actions(f"step{s}"), case.robot(robot, len(ids))
        params, state, loss, norm = step(params, state, recorded, labels, actions, robots)
        losses.append(loss)
        gradient_norms.append(norm)
    case.check("loss_per_step", np.stack(losses))
    case.check("grad_norm_before_clip_per_step", np.stack(gradient_norms))
    _check_end(case, case.official(case.params), case.official(params))


def _check_end(case: Case, start: dict[str, np.ndarray], final: dict[str, np.ndarray]) -> None:
    """Parameters after the last step: whole, as the change since the start, or the norm of either."""
    change = {name: final[name] - start[name] for name in final}
    case.check_group("final", final)
    case.check_group("final_norm", norms(final))
    case.check_group("final_change", change)
    case.check_group("final_change_norm", norms(change))
