"""Memory that a thread has freed is there for the next call, without the kernel."""

import os
import subprocess
import sys

import pytest

from hma_jax.runtime.host_memory import KEPT_PAGES, is_glibc

BLOCK = 2**28

PROGRAM = f"""
import ctypes, resource, threading
libc = ctypes.CDLL(None)
libc.malloc.restype, libc.malloc.argtypes, libc.free.argtypes = ctypes.c_void_p, [ctypes.c_size_t], [ctypes.c_void_p]
libc.memset.argtypes = [ctypes.c_void_p, ctypes.c_int, ctypes.c_size_t]

def use():
    for _ in range(2):
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        block = libc.malloc({BLOCK})
        libc.memset(block, 1, {BLOCK})
        libc.free(block)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)

thread = threading.Thread(target=use)
thread.start()
thread.join()
"""


@pytest.mark.skipif(not is_glibc(), reason="only glibc is told how to hold memory")
def test_a_large_block_that_a_thread_frees_is_kept():
    environment = os.environ | KEPT_PAGES
    run = subprocess.run([sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True)
    first, second = map(int, run.stdout.split())
    assert first > 20 > second  # page faults
