"""The training state, and how it is initialised without a second copy in memory.

A checkpoint keeps each field of a state as an item of its own (`training.checkpoints`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import MeshConfig
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.params import Declared, Params, require_params
from hma_jax.runtime.audit import param_shardings
from hma_jax.runtime.sharding import place, replicated
from hma_jax.training.optimizer import init_adam
from hma_jax.training.train_only import own_specs

FINITE = "finite/"
"""Prefix of the names of a step's checks: metrics that are not logged, but stop a run if they are false."""


class TrainState(NamedTuple):
    """`step` counts finished optimiser steps (int32 scalar); it is the only clock."""

    step: jax.Array
    params: Params
    opt_state: Any
    ema: Params | None = None  # moving average of the parameters; None: not kept

    @property
    def weights(self) -> Params:
        """The parameters to evaluate: the average if there is one."""
        return self.params if self.ema is None else self.ema


def init_state(
    declared: Declared,
    table: EmbodimentTable,
    seed: int,
    shapes: TrainState | None = None,
    params: Params | None = None,
) -> TrainState:
    """The state before step 1, around a copy of `params` or freshly drawn ones.

    It is laid out as `shapes` says (`state_shapes`; default: on the default device, without an average). No device ever
    holds more than its part. `params` are copied as float32 and stay the caller's: training donates its state, never
    `params`. Raises ConfigError for `params` of another model.
    """
    shapes = state_shapes(declared, table) if shapes is None else shapes
    layout = _layout(shapes)
    if params is None:
        params = declared.init(seed, layout and layout.params)
    else:
        require_params(declared, params, "the initial parameters do not fit the model")
        params = jax.tree.map(lambda x, like: place(np.array(x, like.dtype), like.sharding), params, shapes.params)
    leaves, treedef = jax.tree.flatten(shapes)
    step, opt_state = _jitted_zeros(treedef, tuple(leaves))()
    ema = None if shapes.ema is None else jax.tree.map(copy, params)
    return TrainState(step, params, opt_state, ema)


def _layout(shapes: TrainState) -> TrainState | None:
    """The shardings of its arrays; None: all are on the default device."""
    return None if shapes.step.sharding is None else jax.tree.map(lambda x: x.sharding, shapes)


@lru_cache(maxsize=4)
def _jitted_zeros(treedef: Any, leaves: tuple[jax.ShapeDtypeStruct, ...]) -> Callable[[], tuple[jax.Array, Any]]:
    """Counter and moments of a state of these shapes before step 1; kept for the next run of the same process."""
    shapes = jax.tree.unflatten(treedef, leaves)
    layout = _layout(shapes)
    return jax.jit(
        lambda: jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), (shapes.step, shapes.opt_state)),
        out_shardings=layout and (layout.step, layout.opt_state),
    )


def all_finite(tree: Any) -> jax.Array:
    """bool []: no NaN and no infinity anywhere."""
    return jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(tree)]).all()


def copy(x: jax.Array) -> jax.Array:
    """A copy in its own buffer, with the same layout."""
    return jax.device_put(x, x.sharding, may_alias=False)


def state_shapes(
    declared: Declared,
    table: EmbodimentTable,
    device_mesh: jax.sharding.Mesh | None = None,
    mesh: MeshConfig = MeshConfig(),
    average: bool = False,
    only: tuple[str, ...] = (),
) -> TrainState:
    """A state's shapes (jax.ShapeDtypeStruct) and, given a mesh, their shardings.

    Moments, and the moving average (if `average`), are laid out like parameters of their shapes; counters are on every
    device. There are moments for what is trained: for everything, or for the per-robot parameters of the robots in
    `only`.
    """

    def laid_out(declared: Declared) -> Params:
        return declared.shapes(None if device_mesh is None else param_shardings(declared, device_mesh, mesh))

    params = moments = laid_out(declared)
    if only:
        moments = laid_out(replace(declared, specs=own_specs(declared.specs, len(set(only)))))
    layout = None if device_mesh is None else replicated(device_mesh)
    adam = jax.eval_shape(lambda: init_adam(moments, table.size))
    return TrainState(
        jax.ShapeDtypeStruct((), jnp.int32, sharding=layout),
        params,
        adam._replace(
            first=moments,
            second=moments,
            count=with_sharding(adam.count, layout),
            count_E=with_sharding(adam.count_E, layout),
        ),
        params if average else None,
    )


def with_sharding(shapes: Any, sharding: jax.sharding.Sharding | None) -> Any:
    """A tree of shapes, each laid out by `sharding`."""
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), shapes)
