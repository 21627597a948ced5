"""How a process holds host memory: in huge pages, without returning freed memory to the kernel, and with few searches
for garbage.

XLA's CPU backend takes its temporary buffers anew for every call. glibc gives blocks of that
size back to the kernel and asks for them again, and the page faults are then a third of a
training step. Pages of 2 MiB make them few, and a heap that keeps what is freed needs none.
All threads share one heap: a block that is larger than a thread's own heap may be, 64 MiB, would be
mapped anew in every call, whatever the other settings say, and a virtual machine whose host takes back
pages as soon as they are free has to ask for each of them. On two cores a step of the base model, 3.7 s,
took 0.2 s more with several heaps, and 2 to 3.5 s more after a pause of seven seconds. docs/performance.md
says what huge pages gain.
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
    f"glibc.malloc.trim_threshold={2**36}",  # which does not shrink
    f"glibc.malloc.top_pad={2**28}",  # and grows by so much
    "glibc.malloc.arena_max=1",  # for the blocks of all threads
)

KEPT_PAGES = {"GLIBC_TUNABLES": ":".join(TUNABLES)}
"""Environment that a process starts with to hold memory so; glibc reads it before anything of ours runs."""

NEW_OBJECTS = 10_000
"""Python looks for garbage when so many objects were made since, less those that were freed. At 700, its default, it
took a tenth of the time of importing and tracing, which make millions of objects that stay."""

# Names and numbers of malloc.h.
_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -2, -4, -8

_keeps_freed_memory = False


def restart_keeping_pages() -> None:
    """Starts the program of this process again, in this process, with `KEPT_PAGES`. Call it first of all, and
    only where the process is the program's own.

    Returns where it is so already: the tunables are set, as the user wants them or by an earlier
    call. Does nothing where the C library is not glibc.
    """
    if "GLIBC_TUNABLES" not in os.environ and is_glibc():
        os.execve(sys.executable, [sys.executable, *sys.orig_argv[1:]], os.environ | KEPT_PAGES)


def keep_freed_memory() -> None:
    """For a process of one core; call before the first computation. Does nothing where the C library is
    not glibc."""
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
    """Has Python look for garbage at `NEW_OBJECTS` only. Leaves a higher number alone, and 0, which is never."""
    if 0 < gc.get_threshold()[0] < NEW_OBJECTS:
        gc.set_threshold(NEW_OBJECTS)


def is_glibc() -> bool:
    return platform.libc_ver()[0] == "glibc"
