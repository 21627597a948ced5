"""Runs with `train.only`: they train only the per-robot parameters of some robots.

The optimiser keeps moments only for these parameters. When a robot is added to a model, nearly all parameters are
frozen, and their moments would be two thirds of the state.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.model.params import Params, ParamSpec, is_spec
from hma_jax.training.active_robots import Active


class Everything:
    """A run that trains all parameters, and has moments for all of them."""

    shared = True  # whether parameters that all robots share are trained

    def __init__(self, specs: Params, trained_E: np.ndarray):
        self.specs = specs  # of the parameters that have moments
        self.trained_E = trained_E

    def pick(self, tree: Params) -> Params:
        """The trained entries of the parameters, or of a tree with the same structure."""
        return tree

    def put(self, tree: Params, trained: Params) -> Params:
        """`tree` with the entries that `pick` returns replaced by `trained`."""
        return trained

    def mask(self, grads: Params, active: Active) -> Params:
        """Gradients of a step's robots, with zeros for what is not trained."""
        return grads

    def moment_places(self, active: Active) -> jax.Array | None:
        """The places of the moments of a step's robots; None: all robots, in their order."""
        return active.places_G


class OwnOnly(Everything):
    """A run that trains only the per-robot parameters of the `trained_E` robots."""

    shared = False

    def __init__(self, specs: Params, trained_E: np.ndarray):
        super().__init__(pick_own(specs, specs), trained_E)
        self._all_specs = specs
        self._places_E = places_among(trained_E)

    def pick(self, tree: Params) -> Params:
        return pick_own(tree, self._all_specs)

    def put(self, tree: Params, trained: Params) -> Params:
        return put_own(tree, trained)

    def mask(self, grads: Params, active: Active) -> Params:
        trained_G = jnp.asarray(self.trained_E)[active.robots_G]

        def keep(g: jax.Array, spec: ParamSpec) -> jax.Array:
            own = spec.embodiment_axis is not None
            return g * spec.along_robots(trained_G).astype(g.dtype) if own else jnp.zeros_like(g)

        return jax.tree.map(keep, grads, self._all_specs)

    def moment_places(self, active: Active) -> jax.Array:
        return jnp.asarray(self._places_E)[active.robots_G]


def places_among(trained_E: np.ndarray) -> np.ndarray:
    """int32 [E]: the index of each trained robot among the trained ones. Every other robot has an index of its own
    beyond their end."""
    others = trained_E.sum() + np.cumsum(~trained_E) - 1
    return np.where(trained_E, np.cumsum(trained_E) - 1, others).astype(np.int32)


def pick_own(tree: Params, specs: Params) -> Params:
    """The entries of `tree` that belong to per-robot parameters, without those that all robots share."""
    if is_spec(specs):
        return tree

    def has_own(part: Any) -> bool:
        return any(spec.embodiment_axis is not None for spec in jax.tree.leaves(part, is_leaf=is_spec))

    return {name: pick_own(tree[name], part) for name, part in specs.items() if has_own(part)}


def put_own(tree: Params, own: Params) -> Params:
    """`tree` with the entries that `pick_own` picks replaced by `own`."""
    if not isinstance(tree, dict):
        return own
    return {name: put_own(part, own[name]) if name in own else part for name, part in tree.items()}


def own_specs(specs: Params, robots: int) -> Params:
    """The specs of the per-robot parameters in a model of `robots` robots."""

    def of(spec: ParamSpec) -> ParamSpec:
        shape = [robots if i == spec.embodiment_axis else size for i, size in enumerate(spec.shape)]
        return replace(spec, shape=tuple(shape))

    return jax.tree.map(of, pick_own(specs, specs), is_leaf=is_spec)
