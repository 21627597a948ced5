"""AdamW with muP multipliers, in which robots absent from a step stand still.

Multipliers, decay mask and embodiment axes are read off the parameter declarations. A robot
without an example in the global batch keeps its slices, moments and bias-correction count as
they were; a dense AdamW would go on decaying them (reference, appendix B.1).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from hma_jax.config import ModelConfig, OptimizerConfig
from hma_jax.params import Params, ParamSpec, is_spec


class AdamState(NamedTuple):
    """Moments like the parameters, and how often each was updated.

    Shared parameters are updated every step; a robot's own only when it is present, so each
    robot has its own count for bias correction.
    """

    first: Params
    second: Params
    count: jax.Array  # int32 []
    count_E: jax.Array  # int32 [E]


def make_schedule(config: OptimizerConfig, steps: int) -> optax.Schedule:
    """Learning rate at the muP base width for each step, linear warm-up first.

    `constant` holds, `cosine` falls to final_fraction over the whole run, `wsd` holds and then
    falls linearly to final_fraction during the last decay_fraction of the steps.
    """
    peak, end = config.learning_rate, config.learning_rate * config.final_fraction
    warmup = min(config.warmup_steps, steps)
    rest = max(steps - warmup, 1)
    if config.schedule == "constant":
        after = optax.constant_schedule(peak)
    elif config.schedule == "cosine":
        after = optax.cosine_decay_schedule(peak, rest, alpha=config.final_fraction)
    else:
        decay = max(int(steps * config.decay_fraction), 1)
        after = optax.linear_schedule(peak, end, decay, transition_begin=max(rest - decay, 0))
    # Step 0 already moves: the ramp is (step + 1) / warmup, as in the release.
    ramp = optax.linear_schedule(peak / max(warmup, 1), peak, max(warmup - 1, 1))
    return optax.join_schedules([ramp, after], [warmup])


def learning_rate_multiplier(spec: ParamSpec, config: ModelConfig) -> float:
    """muP for Adam: 1 / m for matrices with two width axes, 1 for everything else."""
    return 1.0 / config.width_multiplier if spec.role == "hidden" else 1.0


def init_adam(params: Params, embodiments: int) -> AdamState:
    return AdamState(
        jax.tree.map(jnp.zeros_like, params),
        jax.tree.map(jnp.zeros_like, params),
        jnp.zeros((), jnp.int32),
        jnp.zeros((embodiments,), jnp.int32),
    )


def apply_adamw(
    grads: Params,
    state: AdamState,
    params: Params,
    specs: Params,
    multipliers: Params,
    present_E: jax.Array,
    learning_rate: jax.Array,
    config: OptimizerConfig,
) -> tuple[Params, AdamState]:
    """New parameters and state after one step.

    p <- p - rate * (multiplier * adam + weight_decay * p), the second term only where the
    declaration says so. Weight decay is not divided by m: muP scales a hidden matrix's decay
    up as much as its rate down (reference section 4.4).
    """
    count = state.count + 1
    count_E = state.count_E + present_E.astype(jnp.int32)
    b1, b2 = config.beta1, config.beta2

    def update(p, g, m, v, spec: ParamSpec, multiplier: float):
        steps, present = count.astype(jnp.float32), None
        if spec.embodiment_axis is not None:
            shape = [1] * p.ndim
            shape[spec.embodiment_axis] = -1
            present = present_E.reshape(shape)
            # An absent robot's count may be 0; its (unused) correction must stay finite.
            steps = jnp.maximum(count_E, 1).astype(jnp.float32).reshape(shape)
        new_m = b1 * m + (1 - b1) * g
        new_v = b2 * v + (1 - b2) * jnp.square(g)
        adam = new_m / (1 - b1**steps) / (jnp.sqrt(new_v / (1 - b2**steps)) + config.epsilon)
        decay = config.weight_decay * p if spec.decay else 0.0
        new_p = p - learning_rate * (multiplier * adam + decay)
        if present is None:
            return new_p, new_m, new_v
        return tuple(jnp.where(present, new, old) for new, old in ((new_p, p), (new_m, m), (new_v, v)))

    leaves, treedef = jax.tree.flatten(params)
    others = [jax.tree.leaves(tree) for tree in (grads, state.first, state.second)]
    declared = [jax.tree.leaves(specs, is_leaf=is_spec), jax.tree.leaves(multipliers)]
    new = [update(*args) for args in zip(leaves, *others, *declared, strict=True)]
    params, first, second = (jax.tree.unflatten(treedef, column) for column in zip(*new, strict=True))
    return params, AdamState(first, second, count, count_E)


def clip_by_global_norm(grads: Params, limit: float) -> tuple[Params, jax.Array]:
    """Gradients scaled to a global norm of at most `limit`, and the norm before."""
    norm = optax.tree.norm(grads)
    scale = jnp.minimum(1.0, limit / jnp.maximum(norm, 1e-12))
    return jax.tree.map(lambda g: g * scale, grads), norm
