"""A user's success detector: `success(images, first)` of a Python file, in place of a head that is trained here."""

from __future__ import annotations

import types
from collections.abc import Callable

import numpy as np

from experiments.applications.judging.head import PIECE, Head, HeadConfig
from experiments.user_input.user_file import function_of
from hma_jax.config import ConfigError, require

PAGE, NAME = "docs/judging.md", "success"
SIGNATURE = f"{NAME}(images, first)"


class UserSuccess(Head):
    """A user's function. `measured` is its accuracy on recordings, once that is known."""

    threshold = HeadConfig.threshold

    def __init__(self, function: Callable[[np.ndarray, np.ndarray], np.ndarray], where: str):
        """`where`: the file, for messages."""
        self._function, self._where = function, where
        self.measured: dict[str, float] = {}

    def probabilities(self, images: np.ndarray, first: np.ndarray) -> np.ndarray:
        """See `Head`. Raises ConfigError unless it returns a number between 0 and 1, or a truth value, for each
        image."""
        shape = images.shape[-3:]
        present, starts = (x.reshape(-1, *shape) for x in (images, np.broadcast_to(first, images.shape)))
        pieces = [slice(at, at + PIECE) for at in range(0, len(present), PIECE)]
        return np.concatenate([self._call(present[piece], starts[piece]) for piece in pieces]).reshape(
            images.shape[:-3]
        )

    def _call(self, images: np.ndarray, first: np.ndarray) -> np.ndarray:
        given = self._function(images.copy(), first.copy())
        wanted = (
            f"{self._where}: {SIGNATURE} must return an array [{len(images)}]: for each image the probability that "
            "the goal is reached, or true or false"
        )
        try:
            returned = np.asarray(given)
        except ValueError as error:  # lists of different lengths
            raise ConfigError(f"{wanted}; it returned something that is not an array ({error})") from error
        kind = np.issubdtype(returned.dtype, np.floating) or returned.dtype == bool
        require(
            returned.shape == (len(images),) and kind, f"{wanted}; it returned {returned.dtype} {list(returned.shape)}"
        )
        values = returned.astype(np.float32)
        inside = (values >= 0) & (values <= 1)  # also for values that are not numbers
        require(bool(inside.all()), f"{wanted}, in [0, 1]; it returned {values[~inside][:1]}")
        return values


def success_of(file: types.ModuleType) -> UserSuccess | None:
    """The success function of a user's file, or None if it has none. Raises ConfigError if it is not a function."""
    if not hasattr(file, NAME):
        return None
    return UserSuccess(function_of(file, SIGNATURE, PAGE), str(file.__file__))
