"""The training loop around a step that compiles in no time: numbers drawn to the mean of each batch."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.training.divergence import Records
from hma_jax.training.loop import FitResult, RunInfo, fit
from hma_jax.training.state import FINITE, TrainState

SIZE = (1000,)
Batches = Callable[[int], Iterator[np.ndarray]]


def toy_step(state: TrainState, batch: jax.Array) -> tuple[TrainState, dict[str, jax.Array]]:
    gradient = state.params["w"] - batch.mean()
    speed = 0.9 * state.opt_state["speed"] + gradient
    w = state.params["w"] - 0.1 * speed
    metrics = {
        "loss": jnp.mean(gradient**2),
        FINITE + "gradient": jnp.isfinite(gradient).all(),
        FINITE + "update": jnp.isfinite(w).all(),
    }
    return TrainState(state.step + 1, {"w": w}, {"speed": speed}), metrics


def toy_batches(start: int) -> Iterator[np.ndarray]:
    while True:
        yield np.random.default_rng(start).normal(size=4).astype(np.float32)
        start += 1


def toy_state() -> TrainState:
    w = jax.random.normal(jax.random.key(0), SIZE)
    return TrainState(jnp.zeros((), jnp.int32), {"w": w}, {"speed": jnp.zeros(SIZE)})


def toy_shapes() -> TrainState:
    device = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    shapes = jax.eval_shape(toy_state)
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=device), shapes)


def fit_toy(
    run_dir: Path,
    steps: int = 6,
    *,
    step: Any = toy_step,
    make: Batches = toy_batches,
    info: dict[str, Any] | None = None,
    records: Records = lambda index: (),
    **options: Any,
) -> FitResult:
    """Trains, or goes on; `step` is jitted here unless it can be lowered as it is."""
    step_fn = step if hasattr(step, "lower") else jax.jit(step, donate_argnums=0)
    start = RunInfo(info or {"toy": 1}, records=records)
    return fit(step_fn, toy_shapes(), toy_state, make, steps=steps, run_dir=run_dir, info=start, **options)
