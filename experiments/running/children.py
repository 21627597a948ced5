"""Child processes: their share of the machine, and their end with the parent.

The parent passes them in environment variables; the child calls `enter_child` before it imports JAX, whose thread
pools take their size from the cores that a process may use.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import socket
from pathlib import Path

from experiments.running.slots import Slot
from experiments.terminal.program import prepare_output
from hma_jax.config import ConfigError
from hma_jax.runtime.cores import usable_cores
from hma_jax.runtime.host_memory import KEPT_PAGES, collect_rarely, keep_freed_memory
from hma_jax.runtime.parent import die_with

_PARENT, _CORES, _ACCELERATOR = "HMA_PARENT_PID", "HMA_CORES", "HMA_ACCELERATOR"

CHOSEN = {"XLA_PYTHON_CLIENT_MEM_FRACTION"}
"""Variables of a slot that the user's environment overrides. The accelerators of a slot are not among them: they are
chosen from those that the user allows."""


class NoAccelerator(ConfigError):
    """JAX does not use the accelerators of this machine."""


def child_environment(compile_cache: Path, slot: Slot = Slot(), accelerator: str = "") -> dict[str, str]:
    """The environment of a child that has `slot` for itself, on a machine with that kind of `accelerator`, "gpu" or
    "tpu". Variables that the user has set stay as they are."""
    environment = {**KEPT_PAGES, **os.environ}
    environment[_PARENT] = str(os.getpid())
    environment[_ACCELERATOR] = accelerator
    environment.pop(_CORES, None)
    if slot.cores:
        environment[_CORES] = ",".join(map(str, slot.cores))
    share = slot.environment()
    for name in CHOSEN & set(share) & set(environment):
        del share[name]
    environment |= share
    environment.setdefault("JAX_COMPILATION_CACHE_DIR", str(compile_cache))
    environment.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")
    return environment


def enter_child(parent: int = 0) -> None:
    """Called first in a child: limits it to its cores, makes it end with its `parent` (0: the one that the environment
    names) and end in good order when it is asked to."""
    prepare_output()  # a child has no use for what its parent opened
    faulthandler.enable()  # if a library ends the process by a signal, the threads' stacks show which one
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also if a background shell job had it ignored
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})  # Ray's workers have them blocked
    for number in (signal.SIGUSR1, signal.SIGUSR2):  # Slurm's, for the process above
        signal.signal(number, signal.SIG_IGN)
    cores = os.environ.get(_CORES)
    if cores:
        os.sched_setaffinity(0, {int(c) for c in cores.split(",")})
    if usable_cores() == 1:
        keep_freed_memory()
    collect_rarely()
    parent = parent or int(os.environ.get(_PARENT, "0"))
    if parent:
        die_with(parent)


def require_accelerator(kind: str | None = None) -> None:
    """Raises NoAccelerator if JAX computes on the CPU although an accelerator of this `kind` is expected (default: the
    kind that this process's parent named). None is expected for "", or with JAX_PLATFORMS=cpu. JAX itself would
    continue silently."""
    kind = os.environ.get(_ACCELERATOR, "") if kind is None else kind
    if not kind or os.environ.get("JAX_PLATFORMS") == "cpu":
        return
    import jax

    try:
        found, why = jax.default_backend(), ""
    except RuntimeError as error:  # JAX_PLATFORMS names one that does not start
        found, why = "nothing", f" ({error})"
    if found in ("cpu", "nothing") and found != kind:
        extra = "'hma-jax[tpu]'" if kind == "tpu" else "'hma-jax[cuda]', or [cuda12] for an older driver"
        raise NoAccelerator(
            f"{socket.gethostname()}: a {kind.upper()} is expected, but JAX computes on {found}{why}; check its driver, and "
            f"that JAX is installed for it (pip install {extra}), or set JAX_PLATFORMS=cpu to do without"
        )
