"""How a process holds host memory: in huge pages, without returning freed memory to the kernel, and with infrequent
garbage collection.

XLA's CPU backend allocates its temporary buffers anew in every call. glibc returns blocks of that size to the kernel
and asks for them again, and page faults then take a third of a training step. With pages of 2 MiB there are few, and
with a heap that keeps freed memory there are none. All threads share one heap. Otherwise a block above 64 MiB, the
limit of a thread's own heap, would be mapped anew in every call, whatever the other settings; and a virtual machine
whose host takes back pages as soon as they are free would have to ask for each of them again. On two cores a step of
the base model, 3.7 s, took 0.2 s more with several heaps, and 2 to 3.5 s more after a pause of seven seconds.
docs/performance.md says what huge pages gain.
"""

from __future__ import annotations

import ctypes
import gc
import os
import platform
import sys

TUNABLES = (
    "glibc.malloc.hugetlb=1",  # transparent huge pages
    "glibc.malloc.mmap_max=0",  # large blocks come from the heap too
    f"glibc.malloc.trim_threshold={2**36}",  # the heap does not shrink
    f"glibc.malloc.top_pad={2**28}",  # it grows in steps of this size
    "glibc.malloc.arena_max=1",  # one heap for all threads
)

KEPT_PAGES = {"GLIBC_TUNABLES": ":".join(TUNABLES)}
"""The environment with which a process starts to hold memory in this way; glibc reads it before our code runs."""

NEW_OBJECTS = 10_000
"""Python collects garbage when this many more objects were made than freed since the last time. At the default of 700,
collection took a tenth of the time of importing and tracing, which make millions of objects that stay."""

# Names and numbers of malloc.h.
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -2, -4, -8

_keeps_freed_memory = False


def restart_keeping_pages() -> None:
    """Starts the program of this process again, in this process, with `KEPT_PAGES`. Call it before anything else, and
    only where the program owns the process.

    Does nothing if the tunables are already set, by the user or by an earlier call, or if the C library is not glibc.
    """
    if "GLIBC_TUNABLES" not in os.environ and is_glibc():
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | KEPT_PAGES)


def keep_freed_memory() -> None:
    """Keeps freed memory in this process, without a restart; for a process of one core. Call it before the first
    computation. Does nothing if the C library is not glibc."""
    global _keeps_freed_memory
    if not is_glibc():
        return
    _keeps_freed_memory = True
    mallopt = ctypes.CDLL(None).mallopt
    mallopt(_M_MMAP_MAX, 0)
    mallopt(_M_TRIM_THRESHOLD, 2**31 - 1)
    mallopt(_M_TOP_PAD, 64 * 2**20)
    mallopt(_M_ARENA_MAX, 1)


def shares_one_heap() -> bool:
    """Whether all threads of this process take their memory from one heap that keeps what is freed."""
    return is_glibc() and (_keeps_freed_memory or os.environ.get("GLIBC_TUNABLES") == KEPT_PAGES["GLIBC_TUNABLES"])


def collect_rarely() -> None:
    """Makes Python collect garbage only at `NEW_OBJECTS`. Keeps a higher threshold, and 0, which means never."""
    if 0 < gc.get_threshold()[0] < NEW_OBJECTS:
        gc.set_threshold(NEW_OBJECTS)


def is_glibc() -> bool:
    return platform.libc_ver()[0] == "glibc"
