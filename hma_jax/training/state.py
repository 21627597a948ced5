"""What training carries from step to step."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax

from hma_jax.model.params import Params


class TrainState(NamedTuple):
    """`step` counts finished optimiser steps (int32 scalar); it is the only clock."""

    step: jax.Array
    params: Params
    opt_state: Any
