"""Endless batches in order, made ahead by threads."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import grain

T = TypeVar("T")


def iterate(batches: grain.sources.RandomAccessDataSource[T], start_step: int, threads: int, ahead: int) -> Iterator[T]:
    """`batches` from `start_step` on; `threads` (0: the caller's) keep `ahead` of them ready.

    Batch s is a function of s alone, so a run resumes from its step, without iterator state.
    """
    options = grain.ReadOptions(num_threads=threads, prefetch_buffer_size=ahead)
    iterator = iter(grain.MapDataset.source(batches).to_iter_dataset(options))
    iterator.set_state({"next_index": start_step})
    return iterator
