"""Runs that train some robots' own parameters alone (`train.only`): only of these there are moments.

Of what is frozen, most of a model to which a robot is added, they would be two thirds of a state.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from hma_jax.model.params import Params, ParamSpec, is_spec


def places_among(trained_E: np.ndarray) -> np.ndarray:
    """int32 [E]: each trained robot's place among them; each other robot has a place of its own beyond their end."""
    others = trained_E.sum() + np.cumsum(~trained_E) - 1
    return np.where(trained_E, np.cumsum(trained_E) - 1, others).astype(np.int32)


def pick_own(tree: Params, specs: Params) -> Params:
    """The robots' own parameters, or entries of these, without what all robots share."""
    if is_spec(specs):
        return tree

    def has_own(part: Any) -> bool:
        return any(spec.embodiment_axis is not None for spec in jax.tree.leaves(part, is_leaf=is_spec))

    return {name: pick_own(tree[name], part) for name, part in specs.items() if has_own(part)}


def put_own(tree: Params, own: Params) -> Params:
    """`tree` with what `pick_own` picked from such a tree in its places."""
    if not isinstance(tree, dict):
        return own
    return {name: put_own(part, own[name]) if name in own else part for name, part in tree.items()}


def own_specs(specs: Params, robots: int) -> Params:
    """The specs of the robots' own parameters in a model that has so many."""

    def of(spec: ParamSpec) -> ParamSpec:
        shape = [robots if i == spec.embodiment_axis else size for i, size in enumerate(spec.shape)]
        return replace(spec, shape=tuple(shape))

    return jax.tree.map(of, pick_own(specs, specs), is_leaf=is_spec)
