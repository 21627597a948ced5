"""AdamW, and Muon for matrices, with muP multipliers; parameters without an example in a step are not updated.

Multipliers, decay mask, embodiment axes and uses come from the parameter declarations. A robot without an example in
the global batch keeps its slices, moments and bias-correction count, and so does a head without a target; a dense AdamW
would continue to decay them (reference appendix B.1).
"""

from __future__ import annotations

import math
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
import optax
import optax.contrib
from jax.sharding import PartitionSpec

from hma_jax.config import ModelConfig, OptimizerConfig, require
from hma_jax.model.params import MatrixAxes, Params, ParamSpec, Use, is_spec
from hma_jax.runtime.sharding import STORAGE, is_split, mesh_axes, partition
from hma_jax.training import active_robots
from hma_jax.training.active_robots import Active


class Presence(NamedTuple):
    """The parameters that a step updates: for each `Use`, whether the batch has an example of it, and for which
    robots."""

    shared: dict[Use, jax.Array]  # bool []
    robots: dict[Use, jax.Array]  # bool [E]

    def of(self, spec: ParamSpec) -> jax.Array:
        """Whether the step updates a parameter: one bool, or, for per-robot parameters, one for each robot's slice."""
        return _entry_of(spec, self.shared, self.robots)


class AdamState(NamedTuple):
    """Moments of the parameters that are trained, and how often each parameter was updated, for bias correction."""

    first: Params
    second: Params
    count: dict[Use, jax.Array]  # int32 []: for parameters that all robots share
    count_E: dict[Use, jax.Array]  # int32 [E]: for each robot's own parameters


def make_schedule(config: OptimizerConfig, steps: int) -> optax.Schedule:
    """Learning rate at the muP base width for each step. It begins with a linear warm-up, which takes at most all
    steps.

    `constant` holds, `cosine` falls towards final_fraction over the whole run, `wsd` holds and then falls towards it
    linearly during the last decay_fraction of the steps. Both would reach final_fraction one step after the last: in
    the last of n decay steps of wsd, 1 / n of the fall remains.
    """
    peak, end = config.learning_rate, config.learning_rate * config.final_fraction
    warmup = min(config.warmup_steps, steps)
    rest = max(steps - warmup, 1)
    if config.schedule == "constant":
        after = optax.constant_schedule(peak)
    elif config.schedule == "cosine":
        after = optax.cosine_decay_schedule(peak, rest, alpha=config.final_fraction)
    else:
        decay = decay_steps(config, steps)
        after = optax.linear_schedule(peak, end, decay, transition_begin=max(rest - decay, 0))
    # Step 0 already moves: the ramp is (step + 1) / warmup. DIFFERS: so it is in the release's cosine schedule, but its
    # default, the constant one, has step / warmup, so that the first update does nothing (reference section 4.1).
    ramp = optax.linear_schedule(peak / max(warmup, 1), peak, max(warmup - 1, 1))
    return optax.join_schedules([ramp, after], [warmup])


def decay_steps(config: OptimizerConfig, steps: int) -> int:
    """Steps of the decay phase of wsd."""
    return max(int(steps * config.decay_fraction), 1)


def decay_fits(config: OptimizerConfig, steps: int) -> bool:
    """Whether the schedule's decay, if it has one, begins after the warm-up and ends within `steps`."""
    if config.schedule == "constant":
        return True
    return config.warmup_steps + (decay_steps(config, steps) if config.schedule == "wsd" else 1) <= steps


def check_schedule(config: OptimizerConfig, steps: int) -> None:
    """Raises ConfigError for a decay that would begin during the warm-up and end above final_fraction, or never
    begin."""
    few = f"train.steps={steps} are too few for the warm-up (train.optimizer.warmup_steps={config.warmup_steps})"
    if config.schedule == "cosine":
        why = f"{few}, so with schedule cosine the learning rate would not fall; change one of these two"
    else:
        decay, share = decay_steps(config, steps), config.decay_fraction
        why = (
            f"{few} and the decay of schedule wsd ({decay}: train.optimizer.decay_fraction={share:g} of all steps): the "
            "learning rate would not fall to final_fraction; change one of these three"
        )
    require(decay_fits(config, steps), f"{why}, or set train.optimizer.schedule=constant")


def steps_in_common(config: OptimizerConfig, steps: int, others: int) -> float:
    """The last step up to which a run of `steps` steps and one of `others` have the same learning rates: infinite for
    a constant rate, the step before the earlier decay for wsd, 0 for cosine, and 0 if one of the runs is shorter than
    the warm-up."""
    if config.schedule == "cosine" or min(steps, others) < config.warmup_steps:  # the ramp is over by the last step
        return 0
    if config.schedule == "constant":
        return math.inf
    return min(n - decay_steps(config, n) for n in (steps, others))


def learning_rate_multiplier(spec: ParamSpec, config: ModelConfig) -> float:
    """muP for Adam: 1 / m for matrices with two width axes, 1 for everything else."""
    return 1.0 / config.mup_multiplier("learning_rate") if spec.role == "hidden" else 1.0


def init_adam(params: Params, embodiments: int) -> AdamState:
    return AdamState(
        jax.tree.map(jnp.zeros_like, params),
        jax.tree.map(jnp.zeros_like, params),
        {use: jnp.zeros((), jnp.int32) for use in get_args(Use)},
        {use: jnp.zeros((embodiments,), jnp.int32) for use in get_args(Use)},
    )


MUON_MOMENTUM = 0.95  # Nesterov momentum
MUON_GAIN = 0.2
"""Root mean square of a square matrix's update, in units of the learning rate. It is about that of Adam (Liu et al.
2025), so that both use the same rate."""


ORTHOGONALISE = "orthogonalise_matrices"
"""Scope of Muon's communication in compiled programs."""


def muon_direction(momentum: jax.Array, spec: ParamSpec, multiplier: float, min_shard_size: int) -> jax.Array:
    """The direction in which a `hidden` parameter is moved, in units of the rate at the base width: each of its
    matrices is made orthogonal, so that all its singular values are about 1. `momentum` may have fewer robots than the
    declaration.

    muP requires the spectral norm of an update to stay as it is at the base width (Yang et al. 2023). With orthogonal
    matrices the root mean square already falls as 1 / sqrt(m), so only the square root of `multiplier`, 1 / m, is still
    applied. On a mesh the matrices of a parameter of `min_shard_size` numbers or more are distributed over the devices.
    """
    rows, columns = (tuple(len(spec.shape) + axis for axis in side) for side in spec.matrix)
    axes = rows, columns
    if is_split() and spec.size >= min_shard_size:
        storage = partition(spec.axes, momentum.shape, jax.sharding.get_abstract_mesh(), STORAGE)
        orthogonal = _shared_out(momentum, axes, storage)
    else:
        orthogonal = _orthogonalised(momentum, axes)
    longest = max(math.prod(spec.shape[axis] for axis in side) for side in axes)
    return MUON_GAIN * math.sqrt(longest * multiplier) * orthogonal


def _orthogonalised(x: jax.Array, axes: MatrixAxes) -> jax.Array:
    """x with each matrix along `axes`, counted from the first, made orthogonal."""
    numbers = optax.contrib.MuonDimensionNumbers(*axes)
    muon = optax.contrib.scale_by_muon(beta=0.0, nesterov=False, weight_dimension_numbers=numbers)
    return muon.update(x, muon.init(x))[0]


def _shared_out(x: jax.Array, axes: MatrixAxes, storage: PartitionSpec) -> jax.Array:
    """`_orthogonalised` on a mesh, for x stored as `storage` says: each device makes some whole matrices orthogonal.

    Matrices that are stored in parts are each sent to one device, and back. Otherwise each of the fifteen products
    would gather all matrices on every device, and matrices that several devices store would be computed by each of
    them.
    """
    sizes = jax.sharding.get_abstract_mesh().shape
    batch = tuple(axis for axis in range(x.ndim) if axis not in axes[0] + axes[1])
    order = (*batch, *axes[0], *axes[1])
    split = {name: axis for axis, part in enumerate(storage) for name in mesh_axes(part)}
    # The mesh axes over which the matrices are still to be distributed, and which side of a matrix each splits in
    # storage.
    sides = {
        name: next((side for side in (1, 2) if split.get(name) in axes[side - 1]), None)
        for name, size in sizes.items()
        if size > 1 and split.get(name) not in batch
    }

    def on_each(own: jax.Array) -> jax.Array:
        turned = own.transpose(order)
        m = turned.reshape([math.prod(own.shape[axis] for axis in group) for group in (batch, *axes)])
        count = len(m)
        m = jnp.pad(m, ((0, -count % math.prod(sizes[name] for name in sides)), (0, 0), (0, 0)))
        # Rows and columns may be joined in any order, because they are split again in the reverse order.
        for name, side in sides.items():
            if side is None:
                part = len(m) // sizes[name]
                m = jax.lax.dynamic_slice_in_dim(m, part * jax.lax.axis_index(name), part)
            else:
                m = jax.lax.all_to_all(m, name, split_axis=0, concat_axis=side, tiled=True)
        m = _orthogonalised(m, ((1,), (2,)))
        for name, side in reversed(sides.items()):
            if side is None:
                m = jax.lax.all_gather(m, name, tiled=True)
            else:
                m = jax.lax.all_to_all(m, name, split_axis=side, concat_axis=0, tiled=True)
        return m[:count].reshape(turned.shape).transpose([order.index(axis) for axis in range(own.ndim)])

    with jax.named_scope(ORTHOGONALISE):
        return jax.shard_map(on_each, in_specs=storage, out_specs=storage, check_vma=False)(x)


def apply_update(
    grads: Params,
    state: AdamState,
    params: Params,
    specs: Params,
    multipliers: Params,
    presence: Presence,
    learning_rate: jax.Array,
    config: OptimizerConfig,
    min_shard_size: int,
) -> tuple[Params, AdamState]:
    """New parameters and state after one step. On a mesh, parameters of fewer than `min_shard_size` numbers are whole.

    p <- p - rate * (multiplier * adam + weight_decay * p), with the second term only where the declaration says so.
    With `config.matrices` muon, matrices between two widths use `muon_direction` instead of the first term and have no
    second moment. Weight decay is not divided by m: muP scales a hidden matrix's decay up by as much as it scales its
    rate down (reference section 4.4).
    """
    count = {use: n + presence.shared[use].astype(n.dtype) for use, n in state.count.items()}
    count_E = {use: n + presence.robots[use].astype(n.dtype) for use, n in state.count_E.items()}
    b1, b2 = config.beta1, config.beta2

    # Each: (gradient, first and second moment) -> (new moments, direction of the update).
    def adamw(g, m, v, spec: ParamSpec, multiplier: float):
        # The count may be 0 before a first example; its (unused) correction must stay finite.
        steps = jnp.maximum(_entry_of(spec, count, count_E), 1).astype(jnp.float32)
        new_m = b1 * m + (1 - b1) * g
        new_v = b2 * v + (1 - b2) * jnp.square(g)
        adam = new_m / (1 - b1**steps) / (jnp.sqrt(new_v / (1 - b2**steps)) + config.epsilon)
        return new_m, new_v, multiplier * adam

    def muon(g, m, v, spec: ParamSpec, multiplier: float):
        mu = MUON_MOMENTUM
        new_m = mu * m + (1 - mu) * g
        return new_m, v, muon_direction(mu * new_m + (1 - mu) * g, spec, multiplier, min_shard_size)

    of_matrices = {"adamw": adamw, "muon": muon}[config.matrices]

    def update(p, g, m, v, spec: ParamSpec, multiplier: float):
        rule = of_matrices if spec.role == "hidden" else adamw
        new_m, new_v, move = rule(g, m, v, spec, multiplier)
        decay = config.weight_decay * p if spec.decay else 0.0
        new_p = p - learning_rate * (move + decay)
        return tuple(jnp.where(presence.of(spec), new, old) for new, old in ((new_p, p), (new_m, m), (new_v, v)))

    leaves, treedef = jax.tree.flatten(params)
    others = [jax.tree.leaves(tree) for tree in (grads, state.first, state.second)]
    declared = [jax.tree.leaves(specs, is_leaf=is_spec), jax.tree.leaves(multipliers)]
    new = [update(*args) for args in zip(leaves, *others, *declared, strict=True)]
    params, first, second = (jax.tree.unflatten(treedef, column) for column in zip(*new, strict=True))
    return params, AdamState(first, second, count, count_E)


def take_adam(state: AdamState, specs: Params, active: Active, places_G: jax.Array | None) -> AdamState:
    """The moments and counts of a step's robots, and of the shared parameters. The robots' moments are at
    `places_G`."""
    first, second = (active_robots.take(moment, specs, places_G) for moment in (state.first, state.second))
    return AdamState(first, second, state.count, {use: n[active.robots_G] for use, n in state.count_E.items()})


def put_adam(state: AdamState, new: AdamState, specs: Params, active: Active, places_G: jax.Array | None) -> AdamState:
    """`state` with the moments and counts of `new` in their places."""
    first = active_robots.put(state.first, new.first, specs, places_G)
    second = active_robots.put(state.second, new.second, specs, places_G)
    count_E = {use: n.at[active.robots_G].set(new.count_E[use]) for use, n in state.count_E.items()}
    return AdamState(first, second, new.count, count_E)


def _entry_of(spec: ParamSpec, shared: dict[Use, jax.Array], robots_E: dict[Use, jax.Array]) -> jax.Array:
    """A parameter's entry in one of two tables by use: that of shared parameters, or that of each robot's own."""
    return shared[spec.use] if spec.embodiment_axis is None else spec.along_robots(robots_E[spec.use])


def clip_by_global_norm(grads: Params, limit: float) -> tuple[Params, jax.Array]:
    """Gradients scaled to a global norm of at most `limit`, and their norm before."""
    norm = optax.tree.norm(grads)
    scale = jnp.minimum(1.0, limit / jnp.maximum(norm, 1e-12))
    return jax.tree.map(lambda g: g * scale, grads), norm
