"""Prefetching: episodes are read and their frames decoded ahead of use, in order and in bounded memory.

Owns the threads: some open records, one extracts encoded frames from them, others decode. The prefetched frames are
bounded in bytes, so that neither long episodes nor large images exhaust the memory.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager
from dataclasses import dataclass

import numpy as np

from data_pipelines.errors import EpisodeError
from data_pipelines.sources.source import OpenEpisode, SourceFrame

PREFETCH_BYTES = 128 * 2**20
"""Bytes of prefetched frames, decoded or waiting to be."""

PREFETCH_RECORDS = 4
"""Records opened in advance. Each holds at most `tfrecord.MAX_WHOLE_READ` bytes."""


@dataclass(frozen=True)
class Begin:
    """An episode begins; its frames follow."""

    index: int
    actions: np.ndarray
    success: bool | None


@dataclass(frozen=True)
class End:
    """All frames of episode `index` were given; or it is unusable, and the frames that were given must be discarded."""

    index: int
    error: EpisodeError | None = None


Item = Begin | np.ndarray | End

Opening = Callable[[int], AbstractContextManager[OpenEpisode]]


def frames_ahead(
    episodes: Sequence[int],
    open_episode: Opening,
    fit: Callable[[np.ndarray], np.ndarray],
    frame_bytes: int,
    frame_step: int = 1,
    threads: int = 2,
) -> Iterator[Item]:
    """The frames of `episodes`, one after the other: Begin, `fit(frame)` of every frame_step-th, End.

    `fit` returns arrays of `frame_bytes`. An EpisodeError in `fit` or in decoding ends only that episode; any other
    error is raised here. Close the iterator to stop the threads.
    """
    reader = _Reader(episodes, open_episode, fit, frame_bytes, frame_step, threads)
    try:
        yield from reader.items()
    finally:
        reader.close()


class _Closed(Exception):
    """The iterator was closed."""


class _Budget:
    """A bounded number of bytes, taken by one thread and given back by another."""

    def __init__(self, limit: int):
        self._limit, self._used, self._closed = limit, 0, False
        self._changed = threading.Condition()

    def take(self, count: int) -> None:
        """Waits until there is room, or nothing is taken at all. Raises _Closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or not self._used or self._used + count <= self._limit)
            if self._closed:
                raise _Closed
            self._used += count

    def give(self, count: int) -> None:
        with self._changed:
            self._used -= count
            self._changed.notify_all()

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class _Reader:
    def __init__(
        self,
        episodes: Sequence[int],
        open_episode: Opening,
        fit: Callable[[np.ndarray], np.ndarray],
        frame_bytes: int,
        frame_step: int,
        threads: int,
    ):
        self._episodes, self._open_episode, self._fit = episodes, open_episode, fit
        self._frame_bytes, self._step = frame_bytes, frame_step
        self._budget = _Budget(PREFETCH_BYTES)
        # Begin, End, a frame as (future, its cost), an error to raise, or None at the end.
        self._out: queue.SimpleQueue = queue.SimpleQueue()
        self._decoders = ThreadPoolExecutor(threads, "decode")
        self._openers = ThreadPoolExecutor(min(PREFETCH_RECORDS, threads), "open")
        self._thread = threading.Thread(target=self._run, name="read", daemon=True)
        self._thread.start()

    def items(self) -> Iterator[Item]:
        failed = None  # the unusable episode whose remaining frames are discarded
        begun = -1
        while (item := self._out.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            if isinstance(item, Begin):
                begun = item.index
                yield item
            elif isinstance(item, End):
                if item.index != failed:
                    yield item
            else:
                future, cost = item
                try:
                    frame = future.result()
                except EpisodeError as error:
                    frame = None
                    if begun != failed:
                        failed = begun
                        yield End(begun, error)
                finally:
                    self._budget.give(cost)
                if frame is not None and begun != failed:
                    yield frame

    def close(self) -> None:
        self._budget.close()
        self._thread.join()
        for pool in (self._decoders, self._openers):
            pool.shutdown(cancel_futures=True)

    def _run(self) -> None:
        opened: deque[Future] = deque()
        try:
            waiting = iter(self._episodes)
            for index in self._episodes:
                while len(opened) < PREFETCH_RECORDS and (following := next(waiting, None)) is not None:
                    opened.append(self._openers.submit(self._enter, following))
                self._cut(index, opened.popleft())
            self._out.put(None)
        except _Closed:
            pass
        except BaseException as error:  # raised again where the items are used
            self._out.put(error)
        finally:
            for future in opened:
                if not future.cancel():
                    self._leave(future)

    def _enter(self, index: int) -> tuple[AbstractContextManager, OpenEpisode]:
        manager = self._open_episode(index)
        return manager, manager.__enter__()

    def _leave(self, future: Future) -> None:
        if future.exception() is None:
            future.result()[0].__exit__(None, None, None)

    def _cut(self, index: int, opening: Future) -> None:
        try:
            episode = opening.result()[1]
            self._out.put(Begin(index, episode.actions, episode.success))
            for step in range(0, episode.steps, self._step):
                fetched = episode.fetch(step)
                size = len(fetched) if isinstance(fetched, bytes) else fetched.nbytes
                cost = max(size, self._frame_bytes)
                self._budget.take(cost)
                decoding = self._decoders.submit(self._decode, episode, step, fetched)
                self._out.put((decoding, cost))
            self._out.put(End(index))
        except EpisodeError as error:
            self._out.put(End(index, error))
        finally:
            self._leave(opening)

    def _decode(self, episode: OpenEpisode, step: int, fetched: SourceFrame) -> np.ndarray:
        return self._fit(episode.decode(step, fetched))
