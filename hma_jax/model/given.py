"""Checks of arrays that callers pass to a model, where JAX would compute something without an error."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import ModelConfig, require
from hma_jax.model.embodiments import EmbodimentTable

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
    """Raises ConfigError for actions that are not finite, if their values are here, as in `require_known`."""
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
    kind, dtype = (jnp.floating, jnp.float32) if config.diffusion else (jnp.integer, jnp.int32)
    require(jnp.issubdtype(frames.dtype, kind), f"this model's frames are {dtype.__name__}, got {frames.dtype}")
    return frames.astype(dtype)


def require_keys(key_B: jax.Array, batch: int) -> None:
    """Raises ConfigError unless there is a key for each of so many examples."""
    typed = jnp.issubdtype(key_B.dtype, jax.dtypes.prng_key)
    require(
        typed and key_B.shape == (batch,),
        f"{batch} keys are needed, as `jax.random.split(jax.random.key(seed), {batch})` makes them; got {key_B.dtype} "
        f"{key_B.shape}" + ("" if typed else "; `jax.random.wrap_key_data` converts those of PRNGKey"),
    )
