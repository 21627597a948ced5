"""Holes that compiling leaves in a heap that all threads share.

Small matrix products take a temporary block each, thousands of times a step. In the heap of a process that has compiled
for some seconds glibc looks for it through hundreds of free blocks of almost its size, for one thread at a time, and a
training step takes up to a quarter longer, for as long as the process lives. After compiling, blocks that nobody uses
are therefore allocated in these holes, until the next program is compiled. docs/performance.md has the figures.
"""

from __future__ import annotations

import ctypes
import threading
from functools import cache

import jax

from hma_jax.runtime.host_memory import shares_one_heap

SMALLEST, LARGE = 14, 20
"""Powers of two: bytes from which on holes are filled, and from which on they stay. Lists of smaller ones are short,
and larger ones are room for arrays."""

SPARE = 32
"""Holes of a size that stay all the same, so that small blocks which are kept need not be placed in the large ones: an
array then finds no room there, and the heap grows."""

LONG_LOWERING, LONG_COMPILATION = 0.1, 0.5
"""Seconds, from which on a program counts as large."""

LOWERED = "/jax/core/compile/jaxpr_to_mlir_module_duration"
COMPILED = "/jax/core/compile/backend_compile_duration"
"""Events of JAX: before and after a program is compiled, or read from the compilation cache."""


@cache
def fill_holes_after_compiling() -> None:
    """From now on. Does nothing where threads have heaps of their own, or where glibc is older than 2.33."""
    if shares_one_heap() and hasattr(ctypes.CDLL(None), "mallinfo2"):
        jax.monitoring.register_event_duration_secs_listener(_Listener(HeapHoles()))


class _Listener:
    """Opens holes when a large program is about to be compiled, and fills them when it is done."""

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

    def __init__(self) -> None:
        libc = ctypes.CDLL(None)
        self._mallinfo2, self._malloc, self._free, self._sbrk = libc.mallinfo2, libc.malloc, libc.free, libc.sbrk
        self._mallinfo2.restype = _Mallinfo2
        self._malloc.restype, self._malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
        self._free.argtypes = [ctypes.c_void_p]
        self._sbrk.restype, self._sbrk.argtypes = ctypes.c_void_p, [ctypes.c_ssize_t]
        self._lock = threading.Lock()
        self._blocks: list[int] = []

    def fill(self) -> None:
        """Takes some hundredths of a second."""
        with self._lock:
            rest = self._mallinfo2().keepcost  # bytes behind the last block in use
            if rest < 2**LARGE:  # blocks for which there is no hole would not find room here either
                return
            end = self._sbrk(0) - rest
            stay = []
            for power in range(rest.bit_length() - 1, SMALLEST - 1, -1):
                blocks = self._take(2**power, end)
                spare = SPARE if power < LARGE else len(blocks)
                stay += blocks[:spare]
                self._blocks += blocks[spare:]
            self._give_back(stay)

    def open(self) -> None:
        """They can be used again."""
        with self._lock:
            self._give_back(self._blocks)

    def _take(self, size: int, end: int) -> list[int]:
        """Blocks of so many bytes, as many as there is room for before the address `end`."""
        blocks = []
        while (block := self._malloc(size)) and block < end:
            blocks.append(block)
        self._free(block)
        return blocks

    def _give_back(self, blocks: list[int]) -> None:
        for block in blocks:
            self._free(block)
        blocks.clear()


class _Mallinfo2(ctypes.Structure):
    """What malloc.h declares."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in "arena ordblks smblks hblks hblkhd usmblks fsmblks uordblks fordblks keepcost".split()
    ]
