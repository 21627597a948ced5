"""Trains in the run directory given. From step 3 on it cannot be written in: with `full` no file may grow past a few
kilobytes, the nearest to a full disk that every user may ask for; with `read-only` nothing new may be made there.
An error is said as the program `hma` says it."""

import ctypes
import resource
import sys
import time
from pathlib import Path

import jax

from hma_jax.training.hashes import NAME
from hma_jax.training.loop import LoopOptions
from tests.toy import fit_toy

CAPABILITIES_OF_NOBODY = (0x20080522, 0), (0, 0, 0, 0, 0, 0)
"""A header of version 3 for this thread, and three empty sets of two words each."""


def fill(step: int, steps: int, metrics: dict) -> None:
    if step != 3:
        return
    checkpoints = Path(sys.argv[1]) / "checkpoints"
    while not (checkpoints / "2" / NAME).exists():  # it is saved in the background
        time.sleep(0.01)
    # Nor can compiled programs be kept: one that is cut off stays so, in the cache that other tests use.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 1e9)
    if sys.argv[2] == "full":
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))
    else:
        checkpoints.chmod(0o555)


def become_nobody() -> None:
    """Permissions hold for root too; for threads that start later."""
    header, sets = CAPABILITIES_OF_NOBODY
    if ctypes.CDLL(None).capset((ctypes.c_uint32 * 2)(*header), (ctypes.c_uint32 * 6)(*sets)):
        raise OSError("the rights of root cannot be given up here")


if __name__ == "__main__":
    sys.unraisablehook = lambda _: None  # as `hma` does: writers in the background complain once more at the end
    become_nobody()
    try:
        fit_toy(Path(sys.argv[1]), options=LoopOptions(checkpoint_every=2), progress=fill)
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
