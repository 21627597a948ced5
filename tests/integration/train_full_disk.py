"""Trains in the run directory given. From step 3 on no file may grow past a few kilobytes: the nearest to a full
disk that every user may ask for. An error is said as the program `hma` says it."""

import resource
import sys
import time
from pathlib import Path

from hma_jax.training.hashes import NAME
from hma_jax.training.loop import LoopOptions
from tests.toy import fit_toy


def fill(step: int, steps: int, metrics: dict) -> None:
    if step == 3 and "full" in sys.argv:
        while not (Path(sys.argv[1]) / "checkpoints" / "2" / NAME).exists():  # it is saved in the background
            time.sleep(0.01)
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, 3000))


if __name__ == "__main__":
    sys.unraisablehook = lambda _: None  # as `hma` does: writers in the background complain once more at the end
    try:
        print(fit_toy(Path(sys.argv[1]), options=LoopOptions(checkpoint_every=2), progress=fill).resumed_from)
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
