"""A run directory made from a converted model, which `training.runs.load_run` can read and training can resume."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import jax
import numpy as np

from hma_jax.config import require
from hma_jax.convert.atomic import atomic_directory
from hma_jax.model.hma import declare_model
from hma_jax.runtime.files import write_file
from hma_jax.training.checkpoints import Checkpoints, SaveError
from hma_jax.training.run_lock import CHECKPOINTS
from hma_jax.training.runs import Run, describe_run
from hma_jax.training.state import TrainState, state_shapes


def require_run(run: object) -> None:
    """Raises ConfigError for anything but a Run with the parameters of its checkpoint. A Model is not a Run, and the
    Run in a bfloat16 Model has rounded parameters."""
    give = "give load_run(RUN, 'auto') of hma_jax.training.runs"
    require(isinstance(run, Run), f"what is converted is a Run, not a {type(run).__name__}; {give}")
    rounded = {str(x.dtype) for x in jax.tree.leaves(run.params)} - {"float32"}
    require(not rounded, f"these parameters are {', '.join(sorted(rounded))}, rounded for inference; {give}")


def write_run(run: Run, directory: Path, texts: Mapping[str, str] | None = None) -> None:
    """Writes a checkpoint of step 0 with a fresh optimiser state, and `texts` (file name -> contents), into the run
    directory. If the weights were trained, `converted` in the provenance gives their step, and whether they are the
    last ones or the average.

    Raises ConfigError if `directory` exists, and as `require_run`; SaveError if it cannot be written.
    """
    require_run(run)
    with atomic_directory(directory) as temporary:
        converted = {"converted": {"step": run.step, "weights": run.weights}} if run.step else {}
        meta = describe_run(run.model, run.train, run.table, run.provenance | converted)
        try:
            with Checkpoints(temporary / CHECKPOINTS, meta) as checkpoints:
                checkpoints.save(0, fresh_state(run))
        except SaveError as error:  # its message is about training, and about a directory that is now removed
            raise SaveError(
                f"cannot write {directory}: {error.reason}. Make sure that there is space and permission to write, then "
                "try again",
                error.passing,
            ) from error
        for name, text in (texts or {}).items():
            write_file(temporary / name, text)


def fresh_state(run: Run) -> TrainState:
    """The state with which training starts, in host memory."""
    params = jax.tree.map(np.asarray, run.params)
    shapes = state_shapes(declare_model(run.model, run.table), run.table, only=run.train.only)
    # Untouched zeros cost no memory.
    step, opt_state = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), (shapes.step, shapes.opt_state))
    return TrainState(step, params, opt_state, params if run.train.ema_decay else None)
