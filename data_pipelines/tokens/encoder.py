"""Encodes the frames of many episodes with the tokenizer, in order and in batches of equal size."""

from __future__ import annotations

import math
from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from hma_jax.tokenizers.base import Tokenizer


class Encoder:
    """Takes frames and returns their tokens in the same order. Devices encode while the next batch is collected: at
    least `batch` frames, so that every call of the tokenizer is full."""

    def __init__(self, tokenizer: Tokenizer, batch: int):
        self._tokenizer = tokenizer
        self._batch = math.ceil(batch / tokenizer.at_once) * tokenizer.at_once
        self._frames: list[np.ndarray] = []
        self._tokens: deque[np.ndarray] = deque()
        self._under_way: Future | None = None
        self._pool = ThreadPoolExecutor(1, "encode")
        self.ready = 0
        """Number of frames whose tokens can be taken."""

    def __enter__(self) -> Encoder:
        return self

    def __exit__(self, *exc: object) -> None:
        self._pool.shutdown(cancel_futures=True)

    def put(self, frame: np.ndarray) -> None:
        self._frames.append(frame)
        if len(self._frames) == self._batch:
            self._start()

    def flush(self) -> None:
        """Encodes the remaining frames; afterwards the tokens of all frames are ready."""
        if self._frames:
            self._start()
        self._collect()

    def take(self, count: int) -> np.ndarray:
        """The tokens of the next `count` frames (at least one), which must be ready."""
        taken, missing = [], count
        while missing:
            piece = self._tokens.popleft()
            taken.append(piece[:missing])
            if len(piece) > missing:
                self._tokens.appendleft(piece[missing:])
            missing -= len(taken[-1])
        self.ready -= count
        return np.concatenate(taken)

    def _start(self) -> None:
        images = np.stack(self._frames)
        self._frames.clear()
        self._collect()
        self._under_way = self._pool.submit(self._tokenizer.encode, images)

    def _collect(self) -> None:
        if self._under_way is not None:
            tokens = np.asarray(self._under_way.result())
            self._tokens.append(tokens)
            self.ready += len(tokens)
            self._under_way = None
