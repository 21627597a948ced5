"""Checks of the arrays that callers pass to a model. Without them JAX would compute something wrong without an
error."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import ModelConfig, require
from hma_jax.config.base import require_shapes
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import HMA

Array = jax.Array | np.ndarray
"""An array on a device, traced, or on the host."""


def require_known(
    config: ModelConfig, table: EmbodimentTable, frames: Array, actions: Array, embodiment_B: Array
) -> None:
    """Raises ConfigError for ids and robots that the model does not know and for actions that are not finite. Values of
    tracers and of arrays in other processes are not checked."""
    require(
        jnp.issubdtype(embodiment_B.dtype, jnp.integer),
        f"robots are integers, positions in the model's table; got {embodiment_B.dtype}",
    )
    counts = {"robots": (embodiment_B, table.size)}
    if not config.diffusion:
        counts["ids"] = frames, config.vocab_size
    for what, (array, count) in counts.items():
        if _has_values(array):
            require_below(count, array, f"got {what}")
    require_finite(actions)


def require_finite(actions: Array) -> None:
    """Raises ConfigError for actions that are not finite, where their values are known, as in `require_known`."""
    require(not _has_values(actions) or bool(np.isfinite(np.asarray(actions)).all()), "the actions are not finite")


def require_below(count: int, array: Array, subject: str) -> None:
    """Raises ConfigError, which begins with `subject`, unless all integers of `array` lie in 0 to `count` - 1."""
    if array.size:
        values = np.asarray(array)  # inside a traced function jnp's minimum of a constant is traced as well
        low, high = int(values.min()), int(values.max())
        require(0 <= low and high < count, f"{subject} from {low} to {high}, but the model allows 0 to {count - 1}")


def _has_values(array: Array) -> bool:
    return isinstance(array, np.ndarray) or not isinstance(array, jax.core.Tracer) and array.is_fully_addressable


def as_frames(config: ModelConfig, frames: Array) -> Array:
    """Ids as int32, latents as float32, as generated frames are. Raises ConfigError for other kinds of numbers."""
    kind = jnp.floating if config.diffusion else jnp.integer
    require(jnp.issubdtype(frames.dtype, kind), f"this model's frames are {config.frame_dtype}, got {frames.dtype}")
    return frames.astype(config.frame_dtype)


def checked_window(
    model: HMA,
    frames: Array,
    actions_BTU: Array,
    embodiment_B: Array,
    action_hidden_BT: Array | None,
    *,
    shortest: int,
    subject: str,
) -> Array:
    """A recorded window's frames in the type that the model takes. Raises ConfigError, which begins with `subject`, for
    fewer than `shortest` frames, for more frames than the model's window, and for shapes that do not fit the model or
    each other. Raises as `require_known` for unknown values."""
    config, table = model.config, model.table
    batch_time, most = frames.shape[:2], config.frames
    wanted = {
        "frames": (*batch_time, *config.frame_shape),
        "chunks": (*batch_time, table.action_width),
        "robots": batch_time[:1],
    }
    if action_hidden_BT is not None:
        wanted["hidden"] = batch_time
    found = {"frames": frames, "chunks": actions_BTU, "robots": embodiment_B, "hidden": action_hidden_BT}
    require_shapes(f"{subject} are predicted of", found, wanted)
    require(
        shortest <= frames.shape[1] <= most,
        f"{subject} are predicted in windows of {shortest} to {most} frames, got {frames.shape[1]}; cut longer episodes",
    )
    require_known(config, table, frames, actions_BTU, embodiment_B)
    return as_frames(config, frames)


def require_keys(key_B: jax.Array, batch: int) -> None:
    """Raises ConfigError unless `key_B` holds `batch` keys, one for each example."""
    typed = jnp.issubdtype(key_B.dtype, jax.dtypes.prng_key)
    require(
        typed and key_B.shape == (batch,),
        f"{batch} keys are needed, as `jax.random.split(jax.random.key(seed), {batch})` makes them; got {key_B.dtype} "
        f"{key_B.shape}" + ("" if typed else "; `jax.random.wrap_key_data` converts those of PRNGKey"),
    )
