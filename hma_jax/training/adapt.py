"""New robots for a trained model: their slices are appended, and the existing ones stay.

All per-robot parameters have an embodiment axis, and actions are padded to U. A new robot with wider actions adds rows
to the old robots' slices; these are zeros, and so are the padded actions that they multiply.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from hma_jax.config import ModelConfig, require
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.model.params import EMBODIMENT_AXIS, Params, ParamSpec, draw, is_spec


def add_embodiments(
    params: Params, model: ModelConfig, table: EmbodimentTable, new: Sequence[Embodiment], seed: int
) -> tuple[Params, EmbodimentTable]:
    """The parameters, in host memory, and the table, with the `new` robots after those of `table`.

    Predictions for the old robots do not change by a bit. The new slices are drawn with `seed`, as in a model that had
    the robots from the start. Raises ConfigError for a name that is already in the table.
    """
    known = [e.name for e in new if e.name in table.names]
    require(not known, f"the model already knows {', '.join(known)}; do not add them, but train the model further")
    wider = EmbodimentTable((*table.entries, *new))
    declared = declare_model(model, wider)

    def extend(path: tuple[Any, ...], spec: ParamSpec, old: jax.Array | np.ndarray) -> np.ndarray:
        if EMBODIMENT_AXIS not in spec.axes:
            return np.asarray(old)
        # Old slices at the start of every axis; beyond them, along the axis of actions, zeros.
        everywhere = [slice(0, size) for size in old.shape]
        robots = [slice(None)] * old.ndim
        robots[spec.embodiment_axis] = slice(0, table.size)
        fresh = draw(seed, path, spec)
        fresh[tuple(robots)] = 0
        fresh[tuple(everywhere)] = np.asarray(old)
        return fresh

    return jax.tree.map_with_path(extend, declared.specs, params, is_leaf=is_spec), wider
