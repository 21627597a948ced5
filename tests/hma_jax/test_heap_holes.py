"""What is compiled leaves no holes in the heap that later blocks are looked for in."""

import ctypes
import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from hma_jax.runtime.heap_holes import COMPILED, LOWERED
from hma_jax.runtime.host_memory import KEPT_PAGES, is_glibc

PROGRAM = """
import ctypes, random
import jax
from hma_jax.config import MeshConfig
from hma_jax.runtime.heap_holes import COMPILED, LOWERED
from hma_jax.runtime.mesh import make_mesh

libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
sizes = [random.Random(0).randrange(2**15, 2**16) for _ in range(4000)]
large, *blocks = [libc.malloc(size) for size in (2**23, *sizes)]
for hole in (large, *blocks[1::2]):  # what is between them stays
    libc.free(hole)

def places(count, size):
    found = [libc.malloc(size) for _ in range(count)]
    for block in found:
        libc.free(block)
    return ["large" if large <= b < large + 2**23 else "end" if b > blocks[-2] else "small" for b in found]

def report(what):
    print(what, places(1000, 2**15).count("small"), *places(1, 2**22))

make_mesh(MeshConfig())
report("before")
jax.monitoring.record_event_duration_secs(LOWERED, 0.5)
report("lowered")
jax.monitoring.record_event_duration_secs(COMPILED, 0.01)  # read from the compilation cache
report("compiled")
jax.monitoring.record_event_duration_secs(LOWERED, 0.01)  # a small program
jax.monitoring.record_event_duration_secs(COMPILED, 0.1)
report("small")
jax.monitoring.record_event_duration_secs(LOWERED, 0.5)
report("next")
"""


def run(**environment: str) -> dict[str, tuple[int, str]]:
    """What was done -> how many of a thousand blocks of 32 kB find room in small holes then, and where 4 MB do."""
    given = {name: value for name, value in os.environ.items() if name != "GLIBC_TUNABLES"}
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, env=given | environment, capture_output=True, text=True, check=True)
    lines = [line.split() for line in done.stdout.splitlines()]
    return {what: (int(small), large) for what, small, large in lines}


@pytest.mark.skipif(
    not hasattr(ctypes.CDLL(None), "mallinfo2"), reason="only glibc from 2.33 on tells where its heap ends"
)
def test_between_compilations_most_small_holes_are_filled():
    found = run(**KEPT_PAGES)
    assert {large for _, large in found.values()} == {"large"}
    small = {what: count for what, (count, _) in found.items()}
    assert small.pop("compiled") == small.pop("small") < 200  # some of each size stay
    assert small == {"before": 1000, "lowered": 1000, "next": 1000}


@pytest.mark.skipif(not is_glibc(), reason="the heaps are glibc's")
def test_heaps_that_threads_have_for_themselves_are_left_alone():
    heaps = "glibc.malloc.mmap_max=0:glibc.malloc.trim_threshold=68719476736:glibc.malloc.top_pad=268435456"
    assert set(run(GLIBC_TUNABLES=heaps).values()) == {(1000, "large")}


def test_jax_tells_of_lowering_and_compiling():
    events: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(lambda event, seconds, **_: events.append(event))
    jax.jit(lambda x: x - len(events))(np.float32(1))
    assert events.index(LOWERED) < events.index(COMPILED)
