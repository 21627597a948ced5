"""How fast a tokenizer encodes and decodes."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hma_jax.tokenizers.shared import BaseTokenizer


@dataclass(frozen=True)
class Speed:
    """Of one direction. Compilation is not in the rate."""

    first_call_seconds: float  # compiling, and the first piece
    images_per_second: float
    images: int  # that were timed


def measure_speed(tokenizer: BaseTokenizer, pieces: int = 4, seed: int = 0) -> dict[str, Speed]:
    """{"encode": ..., "decode": ...} over `pieces` pieces of noise on every device, host copies included."""
    at_once = tokenizer.at_once
    shape = (at_once * pieces, tokenizer.image_size, tokenizer.image_size, 3)
    images = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    first, tokens = _seconds(lambda: tokenizer.encode(images[:at_once]))
    speeds = {"encode": _speed(tokenizer.encode, images, first)}
    first, _ = _seconds(lambda: tokenizer.decode(tokens))
    speeds["decode"] = _speed(tokenizer.decode, np.concatenate([tokens] * pieces), first)
    return speeds


def _speed(function: Callable[[np.ndarray], np.ndarray], rows: np.ndarray, first: float) -> Speed:
    seconds, _ = _seconds(lambda: function(rows))
    return Speed(first, len(rows) / seconds, len(rows))


def _seconds(function: Callable[[], np.ndarray]) -> tuple[float, np.ndarray]:
    start = time.perf_counter()
    result = function()  # an array of the host: nothing is still under way
    return time.perf_counter() - start, result
