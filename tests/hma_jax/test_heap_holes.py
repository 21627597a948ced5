"""What is compiled leaves no holes in the heap that later blocks are looked for in."""

import ctypes
import os
import subprocess
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from hma_jax.runtime.heap_holes import COMPILED, LARGE, LOWERED, SPARE, HeapHoles
from hma_jax.runtime.host_memory import KEPT_PAGES, is_glibc

PROGRAM = """
import ctypes, random, threading
import jax
from hma_jax.config import MeshConfig
from hma_jax.runtime.heap_holes import COMPILED, LOWERED
from hma_jax.runtime.mesh import make_mesh

make_mesh(MeshConfig())
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
draw = random.Random(0)
blocks = [libc.malloc(draw.randrange(2**15, 2**16)) for _ in range(4000)]
for hole in blocks[1::2]:  # what is between them stays
    libc.free(hole)

def report(what):
    found = [libc.malloc(2**15) for _ in range(1000)]
    for block in found:
        libc.free(block)
    print(what, sum(block < blocks[-2] for block in found))

def tell(event, seconds):
    jax.monitoring.record_event_duration_secs(event, seconds)

report("before")
tell(COMPILED, 1.0)
report("compiled")
tell(LOWERED, 0.5)
report("lowered")
other = threading.Thread(target=tell, args=(COMPILED, 0.01))
other.start()
other.join()
report("other")
tell(COMPILED, 0.01)
report("cached")
tell(LOWERED, 0.01)
tell(COMPILED, 0.1)
report("small")
"""


def run(**environment: str) -> dict[str, int]:
    """What was done -> how many of a thousand blocks of 32 kB find room in holes then."""
    given = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, env=given | environment, capture_output=True, text=True, check=True)
    return {what: int(found) for what, found in map(str.split, done.stdout.splitlines())}


@pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="only glibc from 2.33 on tells where its heap ends"
)
def test_holes_are_filled_when_a_large_program_is_compiled_or_read_until_the_next():
    found = run(**KEPT_PAGES)
    assert {what for what, count in found.items() if count == 1000} == {"before", "lowered", "other"}
    assert {what for what, count in found.items() if count < 300} == {"compiled", "cached", "small"}  # some stay open


@pytest.mark.skipif(not is_glibc(), reason="the heaps are glibc's")
def test_heaps_that_threads_have_for_themselves_are_left_alone():
    heaps = "glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold=68719476736:glibc.malloc.top_pad=268435456"
    assert set(run(GLIBC_TUNABLES=heaps).values()) == {1000}


class Heap:
    """A C library whose heap has holes of the sizes given at their addresses, and any number of bytes from `END` on.

    Blocks are placed as glibc places them: in the smallest hole that has room for one and its header.
    """

    END, HEADER = 2**40, 16

    def __init__(self, holes: dict[int, int]):
        self.holes, self.used = holes, dict[int, int]()
        self.mallinfo2, self.sbrk = lambda: SimpleNamespace(keepcost=2**30), lambda _: self.END + 2**30

        def malloc(size: int) -> int:
            size += self.HEADER
            at = min((at for at, room in holes.items() if room >= size), key=holes.__getitem__, default=self.END)
            rest = holes.pop(at, size) - size
            if rest:
                holes[at + size] = rest
            self.used[at] = size
            return at

        def free(at: int) -> None:
            size = self.used.pop(at)
            if at < self.END:
                holes[at] = size

        self.malloc, self.free = malloc, free


def test_a_large_hole_stays_open_to_its_end():
    start, size = 2**39, 8 * LARGE + 700_000
    heap = Heap({start: size} | {2**20 * i: 600_000 for i in range(1, 101)})
    holes = HeapHoles(heap)
    holes.fill()
    assert not [at for at in heap.used if start <= at < start + size]
    assert sum(used == LARGE // 2 + heap.HEADER for used in heap.used.values()) == 100 - SPARE
    holes.open()
    assert not heap.used and sum(heap.holes.values()) == size + 100 * 600_000


def test_jax_tells_of_lowering_and_compiling():
    events: list[str] = []

    def listen(event: str, _: float, **more: object) -> None:
        events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        jax.jit(lambda x: x - 1)(np.float32(1))
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert events.index(LOWERED) < events.index(COMPILED)
