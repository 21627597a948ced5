"""Holes that compiling leaves in a heap that all threads share.

Each small matrix product takes a temporary block, thousands of times a step. In a process that has compiled for some
seconds, the lists in which glibc keeps free chunks of such sizes (its large bins) have hundreds of members, and glibc
walks through them under the heap's lock: a training step takes up to a third longer, for as long as the process lives.
After compiling, this module therefore allocates unused blocks in these holes, until the next program is compiled. On
two cores a step of `hma train --preset play-gpu` at batch 8 took 573 to 623 ms before and 487 to 571 ms since; a step
of the base model 3.70 to 3.89 s and 3.55 to 3.79 s.
"""

from __future__ import annotations

import ctypes
import threading
from functools import cache
from typing import Any

import jax

from hma_jax.runtime.host_memory import shares_one_heap

SMALLEST, LARGE = 2**14, 2**20
"""Holes from the first up to the second size, in bytes, are filled. Lists of smaller holes are short, and larger holes
are room for arrays."""

SPARE = 32
"""Holes of each size that stay open. Without them, small blocks that are kept would be placed in large holes; an array
would then find no room there, and the heap would grow."""

LONG_LOWERING, LONG_COMPILATION = 0.1, 0.5
"""Seconds of lowering or of compilation from which on a program counts as large."""

LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
COMPILED = "/jax/core/compile/backend_compile_duration"
"""JAX's events before and after a program is compiled or read from the compilation cache."""

_CHUNK_HEADER = 16


@cache
def fill_holes_after_compiling(platform: str) -> None:
    """From now on, fills holes whenever this process has compiled a large program.

    Does nothing where `platform` is not the CPU, where threads have heaps of their own, or where glibc is older than
    2.33.
    """
    if platform == "cpu" and shares_one_heap() and hasattr(ctypes.CDLL(None), "mallinfo2"):
        jax.monitoring.register_event_duration_secs_listener(_Listener(HeapHoles()))


class _Listener(threading.local):
    """Opens holes when a large program is about to be compiled, and fills them when it is done. JAX reports both events
    in the thread that compiles."""

    def __init__(self, holes: HeapHoles):
        self._holes = holes
        self._open = False

    def __call__(self, event: str, seconds: float, **_: object) -> None:
        if event == LOWERED and seconds > LONG_LOWERING:
            self._holes.open()
            self._open = True
        elif event == COMPILED and (self._open or seconds > LONG_COMPILATION):
            self._holes.fill()
            self._open = False


class HeapHoles:
    """The holes of this process's heap, and the blocks that fill them. Threads may share it."""

    def __init__(self, libc: Any = None):
        """`libc`: the C library to use, given by tests."""
        # Calls of a PyDLL keep Python's lock: they are short, while waiting 20,000 times for the lock would take long.
        libc = libc or ctypes.PyDLL(None)
        self._mallinfo2, self._malloc, self._free, self._sbrk = libc.mallinfo2, libc.malloc, libc.free, libc.sbrk
        self._mallinfo2.restype, self._mallinfo2.argtypes = _Mallinfo2, []
        self._malloc.restype, self._malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
        self._free.restype, self._free.argtypes = None, [ctypes.c_void_p]
        self._sbrk.restype, self._sbrk.argtypes = ctypes.c_void_p, [ctypes.c_ssize_t]
        self._lock = threading.Lock()
        self._blocks: list[int] = []

    def fill(self) -> None:
        """Fills holes, in a few hundredths of a second. What other threads allocate in the meantime makes the heap
        grow."""
        with self._lock:
            rest = self._mallinfo2().keepcost  # bytes behind the last block in use
            if rest < LARGE:  # too few: a block that finds no hole would not be recognised
                return
            self._fill(2 ** (rest.bit_length() - 1), self._sbrk(0) - rest)

    def _fill(self, size: int, end: int) -> None:
        """Fills holes before the address `end`, with blocks of `size` first: large holes must be occupied before
        smaller blocks are allocated, which would otherwise be placed in them."""
        stay: list[int] = []
        behind: set[int] = set()  # addresses behind a block in a large hole: a block there is in the same hole
        try:
            while size >= SMALLEST:
                blocks = self._take(size, end)
                large = {block for block in blocks if size >= LARGE or block in behind}
                small = [block for block in blocks if block not in large]
                behind |= {block + size + _CHUNK_HEADER for block in large}
                stay += [*large, *small[:SPARE]]
                self._blocks += small[SPARE:]
                size //= 2
        finally:
            self._give_back(stay)

    def open(self) -> None:
        """Gives the blocks back: compiling may use the holes again."""
        with self._lock:
            self._give_back(self._blocks)

    def _take(self, size: int, end: int) -> list[int]:
        """Blocks of `size` bytes, taken until no hole has room for another: the next one would be behind `end`."""
        blocks = []
        while (block := self._malloc(size)) and block < end:
            blocks.append(block)
        self._free(block)
        return blocks

    def _give_back(self, blocks: list[int]) -> None:
        while blocks:  # popped first, so that no block is freed twice, whatever interrupts this
            self._free(blocks.pop())


class _Mallinfo2(ctypes.Structure):
    """`struct mallinfo2` as malloc.h declares it."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
    ]
