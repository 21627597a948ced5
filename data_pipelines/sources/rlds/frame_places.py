"""Where the frames of episodes lie in their records: remembered for the episodes asked for last.

Owns a bounded memory. An episode that is asked for again after it gave way is read as a whole again.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence

import numpy as np

REMEMBERED = 64 * 2**20
"""Bytes of places that are remembered, 8 of them a frame: of 64 thousand episodes of 128 frames."""

Key = tuple[int, str]
"""An episode and one of its cameras."""


class FramePlaces:
    """Spans [start, end) of frames by episode and camera. Thread-safe; pickles."""

    def __init__(self, limit: int = REMEMBERED):
        self._limit, self._used = limit, 0
        self._known: OrderedDict[Key, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def __getstate__(self) -> dict:
        with self._lock:
            return {k: v for k, v in self.__dict__.items() if k != "_lock"} | {"_known": self._known.copy()}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._known)

    def get(self, key: Key) -> np.ndarray | None:
        """[N, 2] for an episode of N frames, if it is remembered."""
        with self._lock:
            if key in self._known:
                self._known.move_to_end(key)
            return self._known.get(key)

    def put(self, key: Key, spans: Sequence[tuple[int, int]]) -> None:
        places = np.asarray(spans, np.int64).reshape(-1, 2)
        if places.max(initial=0) < 2**32:
            places = places.astype(np.uint32)
        with self._lock:
            old = self._known.pop(key, None)
            self._used += places.nbytes - (0 if old is None else old.nbytes)
            self._known[key] = places
            while self._used > self._limit:
                self._used -= self._known.popitem(last=False)[1].nbytes
