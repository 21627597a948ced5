"""The robots whose parameters a step updates.

A batch of B examples has at most B robots, while a model may know hundreds. The slices of the batch's robots are taken
out before gradients are computed, and put back after the update. The parameters of other robots, which do not change in
such a step anyway, then need no gradients, no moments and no transfers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from hma_jax.model.params import Params, ParamSpec, is_spec


class Active(NamedTuple):
    """The robots of one step: G = min(max(B, 2), E) different ones, which include those of the batch."""

    robots_G: jax.Array  # int32: their places on the embodiment axis
    robot_row_B: jax.Array  # int32: each example's robot, as a place in `robots_G`
    everyone: bool = False  # all robots, in their order

    @property
    def places_G(self) -> jax.Array | None:
        """`robots_G`, or None where it is all robots."""
        return None if self.everyone else self.robots_G


def choose(embodiment_B: jax.Array, embodiments: int) -> Active:
    """The robots of a batch, then enough others to make a fixed number."""
    # At least two: XLA turns the write of a single robot into a slice update, delays reading its old moments, and then
    # copies all robots' arrays in each step. The second robot, without an example, is not changed.
    count = min(max(len(embodiment_B), 2), embodiments)
    if count == embodiments:
        return Active(jnp.arange(embodiments), embodiment_B, everyone=True)
    here_E = jnp.zeros(embodiments, bool).at[embodiment_B].set(True)
    order = jnp.argsort(~here_E, stable=True)
    place_E = jnp.zeros(embodiments, jnp.int32).at[order].set(jnp.arange(embodiments, dtype=jnp.int32))
    return Active(order[:count], place_E[embodiment_B])


def take(tree: Params, specs: Params, places_G: jax.Array | None) -> Params:
    """Parameters, or any tree with an array per parameter, reduced to the robots' slices at `places_G` on the
    embodiment axis; None keeps all slices. A slice beyond the end of the axis has arbitrary values, which nothing
    reads."""
    if places_G is None:
        return tree

    def slices(spec: ParamSpec, x: jax.Array) -> jax.Array:
        if spec.embodiment_axis is None:
            return x
        # With as many places as robots, indices are clipped: a selection between slices and values beyond the end would
        # change how updates are rounded.
        mode = "clip" if len(places_G) == spec.shape[spec.embodiment_axis] else None
        return jnp.take(x, places_G, axis=spec.embodiment_axis, mode=mode)

    return jax.tree.map(slices, specs, tree, is_leaf=is_spec)


def put(tree: Params, new: Params, specs: Params, places_G: jax.Array | None) -> Params:
    """`tree` with the robots' slices at `places_G`, and everything that all robots share, taken from `new`; slices
    beyond the end of the axis are dropped."""
    if places_G is None:
        return new

    def written(spec: ParamSpec, x: jax.Array, slices: jax.Array) -> jax.Array:
        if spec.embodiment_axis is None:
            return slices
        index: tuple[Any, ...] = (slice(None),) * spec.embodiment_axis + (places_G,)
        return x.at[index].set(slices, unique_indices=True)

    return jax.tree.map(written, specs, tree, new, is_leaf=is_spec)
