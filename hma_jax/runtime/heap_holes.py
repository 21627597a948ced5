"""Holes that compiling leaves in a heap that all threads share.

Small matrix products take a temporary block each, thousands of times a step. In a process that has compiled for some
seconds, the lists in which glibc keeps free chunks of such sizes (its large bins) have hundreds of members, and it
walks through them under the heap's lock: a training step takes up to a third longer, for as long as the process
lives. After compiling, blocks that nobody uses are therefore allocated in these holes, until the next program is
compiled. On two cores a step of `hma train --preset play-gpu` at batch 8 took 573 to 623 ms before and 487 to 571 ms
since, one of the base model 3.70 to 3.89 s and 3.55 to 3.79 s.
"""

from __future__ import annotations

import ctypes
import threading
from functools import cache
from typing import Any

import jax

from hma_jax.runtime.host_memory import shares_one_heap

SMALLEST, LARGE = 2**14, 2**20
"""Bytes of holes that are filled: from the first up to the second. Lists of smaller ones are short, and larger ones are
room for arrays."""

SPARE = 32
"""Holes of a size that stay open, so that small blocks which are kept need not be placed in the large ones: an array
then finds no room there, and the heap grows."""

LONG_LOWERING, LONG_COMPILATION = 0.1, 0.5
"""Seconds, from which on a program counts as large."""

LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
COMPILED = "/jax/core/compile/backend_compile_duration"
"""Events of JAX: before and after a program is compiled, or read from the compilation cache."""

_CHUNK_HEADER = 16


@cache
def fill_holes_after_compiling(platform: str) -> None:
    """Has holes filled whenever this process has compiled a large program, from now on.

    Does nothing where the `platform` that computes is no CPU, where threads have heaps of their own, or where glibc is
    older than 2.33.
    """
    if platform == "cpu" and shares_one_heap() and hasattr(ctypes.CDLL(None), "mallinfo2"):
        jax.monitoring.register_event_duration_secs_listener(_Listener(HeapHoles()))


class _Listener(threading.local):
    """Opens holes when a large program is about to be compiled, and fills them when it is done. JAX tells of both in
    the thread that compiles."""

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
        """`libc`: the C library of a test."""
        # Calls of a PyDLL keep Python's lock: they are short, and 20,000 times waiting for it would not be.
        libc = libc or ctypes.PyDLL(None)
        self._mallinfo2, self._malloc, self._free, self._sbrk = libc.mallinfo2, libc.malloc, libc.free, libc.sbrk
        self._mallinfo2.restype, self._mallinfo2.argtypes = _Mallinfo2, []
        self._malloc.restype, self._malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
        self._free.restype, self._free.argtypes = None, [ctypes.c_void_p]
        self._sbrk.restype, self._sbrk.argtypes = ctypes.c_void_p, [ctypes.c_ssize_t]
        self._lock = threading.Lock()
        self._blocks: list[int] = []

    def fill(self) -> None:
        """Fills holes, in some hundredths of a second. What other threads allocate meanwhile makes the heap grow."""
        with self._lock:
            rest = self._mallinfo2().keepcost  # bytes behind the last block in use
            if rest < LARGE:  # too few to tell by them that a block found no hole
                return
            self._fill(2 ** (rest.bit_length() - 1), self._sbrk(0) - rest)

    def _fill(self, size: int, end: int) -> None:
        """Fills holes before the address `end`, with blocks of `size` first: large holes have to be occupied before
        smaller blocks are taken, which would else be placed in them."""
        stay: list[int] = []
        behind: set[int] = set()  # addresses behind a block in a large hole: what is found there is the hole's rest
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
        """Blocks of so many bytes, until no hole is left that has room for one: the next is behind `end`."""
        blocks = []
        while (block := self._malloc(size)) and block < end:
            blocks.append(block)
        self._free(block)
        return blocks

    def _give_back(self, blocks: list[int]) -> None:
        while blocks:  # so that none is freed twice, whatever ends this
            self._free(blocks.pop())


class _Mallinfo2(ctypes.Structure):
    """What malloc.h declares."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
    ]
