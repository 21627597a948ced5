"""A cache of the byte spans of frames in their records, for the episodes read last.

Owns its bound in bytes. An episode that was evicted is read as a whole when it is asked for again.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

CACHE_BYTES = 64 * 2**20
"""Size of the cache. A frame takes 8 bytes, so this is 64 thousand episodes of 128 frames."""

Key = tuple[int, str]
"""An episode and one of its cameras."""


class FrameSpanCache:
    """Spans [start, end) of frames by episode and camera. Thread-safe; pickles."""

    def __init__(self, limit: int = CACHE_BYTES):
        self._limit, self._bytes = limit, 0
        self._spans: OrderedDict[Key, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict:
        with self._lock:
            return {k: v for k, v in self.__dict__.items() if k != "_lock"} | {"_spans": self._spans.copy()}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._spans)

    def get(self, key: Key) -> np.ndarray | None:
        """[N, 2] for an episode of N frames; None if it is not cached."""
        with self._lock:
            if key in self._spans:
                self._spans.move_to_end(key)
            return self._spans.get(key)

    def put(self, key: Key, spans: Sequence[tuple[int, int]]) -> None:
        array = np.asarray(spans, np.int64).reshape(-1, 2)
        if array.max(initial=0) < 2**32:
            array = array.astype(np.uint32)
        with self._lock:
            old = self._spans.pop(key, None)
            self._bytes += array.nbytes - (0 if old is None else old.nbytes)
            self._spans[key] = array
            while self._bytes > self._limit:
                self._bytes -= self._spans.popitem(last=False)[1].nbytes
