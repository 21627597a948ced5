"""Trains two steps in the run directory given, then two more; prints a JSON line for each time: the most bytes of live
arrays per byte of one training state. Steps only add: what is held does not depend on what they compute."""

import gc
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp

from hma_jax.model.hma import declare_model
from hma_jax.training import train
from hma_jax.training.state import state_shapes
from tests.tiny import TABLE, batches, model_config, train_config

seen = []


def measure(*_) -> None:
    seen.append(sum(x.nbytes for x in jax.live_arrays()))


def make_adding_step(*_):
    return lambda state, batch: (jax.tree.map(lambda x: x + 1, state), {"loss": jnp.float32(1)})


if __name__ == "__main__":
    train.make_train_step = make_adding_step
    model, run_dir = model_config(width=64, layers=4), Path(sys.argv[1])
    one = sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(state_shapes(declare_model(model, TABLE), TABLE)))

    def make(start: int):
        measure()  # the state is there, nothing has been computed
        yield from batches(model)(start)

    def start(steps: int) -> int:
        config = train_config(steps=steps)
        # Saved at the end only: while a save is under way, its copy on the host counts as live arrays on a CPU.
        result = train.train_model(model, TABLE, config, make, run_dir=run_dir, provenance={}, progress=measure)
        return result.resumed_from

    for steps in (2, 4):
        seen.clear()
        resumed_from = start(steps)
        print(json.dumps({"resumed_from": resumed_from, "states": max(seen) / one, "state_bytes": one}))
        gc.collect()  # what is left of the first state would count beside the second
