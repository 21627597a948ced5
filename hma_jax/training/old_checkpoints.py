"""Resumes `train.only` runs from checkpoints of earlier versions, which hold optimiser moments of all parameters."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from hma_jax.model.params import Declared, Params, is_spec
from hma_jax.runtime.sharding import place
from hma_jax.training.reading import load_items, on_host, saved_shapes
from hma_jax.training.train_only import own_specs


def load_trained(checkpoint: Path, shapes: Mapping[str, Any], declared: Declared, trained_E: np.ndarray) -> Any:
    """Loads a state (`load_items`) with moments only for the per-robot parameters of the `trained_E` robots.

    The checkpoint may have moments of all parameters. Then those of all robots' own parameters are read into host
    memory, and those of the trained robots are taken from them.
    """
    wanted = shapes["opt_state"]
    if saved_shapes(checkpoint, "opt_state", "first") == jax.tree.map(lambda x: tuple(x.shape), wanted.first):
        return load_items(checkpoint, shapes)
    specs = own_specs(declared.specs, len(trained_E))
    like = on_host(jax.tree.map(lambda spec: jax.ShapeDtypeStruct(spec.shape, np.float32), specs, is_leaf=is_spec))
    given = {**shapes, "opt_state": wanted._replace(first=like, second=like)}
    found = load_items(checkpoint, given, partial=True)

    def taken(moment: Params, like: Params) -> Params:
        return jax.tree.map(
            lambda spec, x, shape: place(np.compress(trained_E, x, spec.embodiment_axis), shape.sharding),
            specs, moment, like, is_leaf=is_spec,
        )  # fmt: skip

    state = found["opt_state"]
    moments = taken(state.first, wanted.first), taken(state.second, wanted.second)
    return found | {"opt_state": state._replace(first=moments[0], second=moments[1])}
