"""Several processes as one program, on one host or on many: how they start, collectives of text and numbers, and the
single writer.

A single process does not need this module: it does not call `start`, and every other function returns at once. How a
lost process is noticed, and how the others end, is in `runtime.watchdog`; the page for users is docs/hosts.md.
"""

from __future__ import annotations

import math
import os
import secrets
import socket
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from hma_jax.config import ConfigError, require
from hma_jax.runtime import watchdog
from hma_jax.runtime.exits import Exit, exit_of_interrupt
from hma_jax.runtime.sharding import replicated

T = TypeVar("T")
COORDINATOR, PROCESSES, PROCESS = "HMA_COORDINATOR", "HMA_PROCESSES", "HMA_PROCESS"
"""Environment variables for values that are not given as options."""

MARGIN = 20.0
"""Seconds by which JAX's own heartbeat timeout exceeds twice `lost_after`. At that timeout JAX ends a process without
naming the lost one, so it is only the fallback if this process's watchdog is stuck. The factor is two because JAX sends
its heartbeat only after half its timeout, and counts from the last one."""

FOR_EVER = 10**12
"""Milliseconds: thirty years."""

# How error messages of collectives and of the coordination service begin.
STATUSES = ("ABORTED:", "CANCELLED:", "DEADLINE_EXCEEDED:", "INTERNAL:", "UNAVAILABLE:", "UNKNOWN:")


@dataclass(frozen=True)
class Processes:
    """Which processes make up the program, and how long they wait for each other.

    With `detect`, JAX finds what is not given from Slurm, Kubernetes, a TPU pod or MPI.
    """

    coordinator: str | None = None  # HOST:PORT of process 0, as the others reach it
    processes: int | None = None
    process: int | None = None  # this one's number, from 0
    detect: bool = False
    start_timeout: float = 300.0  # seconds within which all must have joined
    lost_after: float = 90.0  # seconds without a heartbeat after which a process is lost

    def __post_init__(self):
        require(self.start_timeout >= 1, f"--start-timeout must be at least 1 second, got {self.start_timeout}")
        require(self.lost_after >= 5, f"--lost-after must be at least 5 seconds, got {self.lost_after}")
        if self.coordinator is not None:
            port = self.coordinator.rpartition(":")[2]
            require(port.isdigit(), f"--coordinator must be HOST:PORT, got {self.coordinator!r}")
        if self.processes is not None and self.process is not None:
            require(
                0 <= self.process < self.processes,
                f"--process counts from 0 to {self.processes - 1} with --processes {self.processes}, "
                f"got {self.process}",
            )

    def or_from(self, environment: Mapping[str, str]) -> Processes:
        """Missing fields taken from the environment. Raises ConfigError for a value that is no number, and if only some
        of the required fields are known."""

        def number(name: str, given: int | None) -> int | None:
            text = environment.get(name)
            if given is not None or text is None:
                return given
            require(text.isdigit(), f"{name} must be a number, got {text!r}")
            return int(text)

        found = replace(
            self,
            coordinator=self.coordinator or environment.get(COORDINATOR),
            processes=number(PROCESSES, self.processes),
            process=number(PROCESS, self.process),
        )
        given = (found.coordinator, found.processes, found.process)
        require(
            found.detect or None not in given or given == (None, None, None),
            f"several processes need --coordinator HOST:PORT, --processes N and --process I (or {COORDINATOR}, "
            f"{PROCESSES}, {PROCESS}), or --distributed if Slurm, Kubernetes, a TPU pod or MPI started them",
        )
        return found

    @property
    def several(self) -> bool:
        return self.detect or (self.processes or 1) > 1


ALL_DEVICES: list[int] = []
"""The value of JAX's `local_device_ids` that means all devices the process sees."""


def own_devices(environment: Mapping[str, str]) -> list[int] | None:
    """The `local_device_ids` of a process that JAX detects. None leaves the choice to JAX, which takes, under Slurm and
    Open MPI, the one GPU with the process's number on its node, and elsewhere all.

    A process that is alone on its node takes all the GPUs that it sees. So does a process that sees fewer GPUs than
    there are processes on the node, or as many as Slurm was asked for per task (`--gpus-per-task`): the GPUs were
    already assigned, and are numbered from 0 in each process.
    """
    if "JAX_LOCAL_DEVICE_IDS" in environment:  # the user's choice
        return None
    neighbours, visible = _processes_on_node(environment), environment.get("CUDA_VISIBLE_DEVICES")
    seen = math.inf if visible is None else len(visible.split(","))
    each = environment.get("SLURM_GPUS_PER_TASK", "").rpartition(":")[2]  # such as 2 or h100:2
    shared_out = seen < neighbours or each == str(seen)  # with --gpu-bind=none each process sees all
    return ALL_DEVICES if neighbours == 1 or shared_out else None


def _processes_on_node(environment: Mapping[str, str]) -> int:
    """How many processes of this program are on this node; 0 if neither Open MPI nor Slurm says."""
    if "OMPI_COMM_WORLD_LOCAL_SIZE" in environment:
        return int(environment["OMPI_COMM_WORLD_LOCAL_SIZE"])
    counts: list[int] = []
    for part in environment.get("SLURM_STEP_TASKS_PER_NODE", "0").split(","):  # such as 8(x3),4
        count, _, nodes = part.rstrip(")").partition("(x")
        counts += [int(count)] * int(nodes or 1)
    node = int(environment.get("SLURM_NODEID", "0"))
    return counts[node] if node < len(counts) else 0


def start(asked: Processes) -> None:
    """Joins the other processes (`jax.distributed`); must be called before JAX is used. Does nothing for a single
    process. Raises ConfigError if joining fails. If not all processes join in time, or if this one is asked to stop
    while it waits, it prints a message and exits."""
    if not asked.several:
        return
    # JAX's own pre-emption service takes SIGTERM away from Python and does not handle Ctrl-C; `AgreedMaximum` handles
    # both.
    jax.config.update("jax_enable_preemption_service", False)

    def join() -> None:
        jax.distributed.initialize(
            asked.coordinator,
            asked.processes,
            asked.process,
            local_device_ids=own_devices(os.environ) if asked.detect else None,
            cluster_detection_method=None if asked.detect else "deactivate",
            initialization_timeout=int(asked.start_timeout + MARGIN),  # after which JAX aborts the process
            heartbeat_timeout_seconds=int(2 * asked.lost_after + MARGIN),
            shutdown_timeout_seconds=int(asked.lost_after),
        )

    try:
        _interruptible(join, asked.start_timeout)
    except KeyboardInterrupt as request:
        _exit_now("stopped while waiting for the other processes", exit_of_interrupt(request))
    except TimeoutError:
        _exit_now(f"error: {_join_failure(asked, 'not all have started')}", Exit.REFUSED)
    except (RuntimeError, ValueError, TypeError) as error:
        reason = " ".join(str(error).split())[:300]
        raise ConfigError(_join_failure(asked, reason)) from error
    if jax.process_count() > 1:
        _start_watchdog(asked.lost_after)


def _interruptible(call: Callable[[], T], timeout: float | None = None) -> T:
    """What `call` returns or raises. It is called in a thread of its own: JAX waits in calls that no signal interrupts,
    while here signals are handled at once. Raises TimeoutError after `timeout` seconds; the call then goes on in its
    thread."""
    outcome: Future[T] = Future()

    def work() -> None:
        try:
            outcome.set_result(call())
        except Exception as error:
            outcome.set_exception(error)

    threading.Thread(target=work, name="interruptible", daemon=True).start()
    return outcome.result(timeout)


def _join_failure(asked: Processes, reason: str) -> str:
    return (
        f"the processes could not connect within {asked.start_timeout:.0f} s at "
        f"{asked.coordinator or 'the address that was detected'} ({reason}); check that all were started with the "
        "same address and that process 0 can be reached there"
    )


def _exit_now(message: str, code: int) -> None:
    """Ends the process at once: a thread that hangs in a call of JAX would block a normal exit."""
    print(message, file=sys.stderr, flush=True)
    os._exit(code)


def _start_watchdog(lost_after: float) -> None:
    me, hosts = jax.process_index(), all_gather("host", socket.gethostname())
    token, host = secrets.token_hex(8), _state().coordinator_address.rpartition(":")[0]
    if me == 0:
        server = watchdog.HeartbeatServer(token)
        broadcast_from_writer("watchdog", f"{server.port} {token}")
        exchange, port = server.exchange, server.port
    else:
        port_text, token = broadcast_from_writer("watchdog", "").split()
        port = int(port_text)
        exchange = partial(watchdog.send_heartbeat, host.strip("[]"), port, token)
    watchdog.start(watchdog.Heartbeats(me, hosts, f"{host}:{port}", lost_after), exchange)


def end(error: BaseException | None = None, code: int = 0, show: bool = False) -> None:
    """Called at the end of every process. Without an error all end together. A process that failed reports why to the
    others and exits here with `code`, because a thread that hangs in a collective would block a normal exit. `show`:
    prints the traceback.
    """
    if jax.distributed.is_initialized() and jax.process_count() > 1:
        if error is None:
            barrier("end")
            watchdog.stop()
            return
        if show:
            traceback.print_exception(error)
        watchdog.stop(
            " ".join(str(error).split())[:500] or type(error).__name__,
            code,
            perhaps_lost=_may_be_due_to_others(error),
        )
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def _may_be_due_to_others(error: BaseException | None) -> bool:
    """Whether an error may be due to the end of another process: it comes from a collective or from the coordination
    service, whose messages begin with a status, whatever the type of exception."""
    while error is not None:
        if str(error).startswith(STATUSES):
            return True
        error = error.__cause__
    return False


def is_writer() -> bool:
    """Whether this is process 0, the only one that writes logs, results and terminal output."""
    return jax.process_index() == 0


def all_gather(name: str, text: str) -> list[str]:
    """The `text` of every process, by process index. All processes must call this in the same order, with the same
    `name`.

    Waits for the slowest process without a time limit: if one is lost, the watchdog ends the others
    (`runtime.watchdog`).
    """
    if jax.process_count() == 1:
        return [text]
    client = _state().client
    call = _call_counts[name] = _call_counts.get(name, 0) + 1
    key = f"hma/all_gather/{name}/{call}"
    client.key_value_set(f"{key}/{jax.process_index()}", f"={text}")
    # Requested only once: JAX keeps a request that timed out, here and in process 0, until the key is set.
    get = lambda p: client.blocking_key_value_get(f"{key}/{p}", FOR_EVER)[1:]
    return _interruptible(lambda: [get(p) for p in range(jax.process_count())])


def barrier(name: str) -> None:
    """Waits until all processes have called it. Needed before a program first runs: its collectives wait for processes
    that are still compiling it, but on CPUs only for 30 seconds."""
    all_gather(name, "")


def compiled_by_all(name: str, function: Callable[..., T], *arguments: Any) -> Callable[..., T]:
    """The jitted `function`, to be called with arguments like `arguments`. All processes call this, and none returns
    before all have compiled the function (`barrier`)."""
    if jax.process_count() == 1:
        return function
    compiled = function.lower(*arguments).compile()
    barrier(f"compiled/{name}")
    return compiled


def broadcast_from_writer(name: str, text: str) -> str:
    """The `text` of process 0, in every process; the text of the others is ignored. All processes call this, as
    `all_gather`."""
    return all_gather(name, text if is_writer() else "")[0]


@contextmanager
def writer_first(name: str) -> Iterator[None]:
    """Process 0 runs the block before the others do: `with writer_first("data"): prepare()`."""
    if not is_writer():
        barrier(f"first/{name}")
    yield
    if is_writer():
        barrier(f"first/{name}")


class AgreedMaximum:
    """The largest number that any process requests in a step, known to all processes at the same step.

    With several processes the maximum of one step is read after the next step was dispatched, so that no process waits
    for another longer than the steps themselves make it wait.
    """

    def __init__(self):
        self._maximum: Callable[[jax.Array], jax.Array] | None = None
        self._submitted: jax.Array | None = None
        if jax.process_count() > 1:
            mesh = Mesh(np.array(jax.devices()), ("devices",))
            self._per_device = NamedSharding(mesh, PartitionSpec("devices"))
            maximum = jax.jit(lambda requests: requests.max(), out_shardings=replicated(mesh))
            shape = jax.ShapeDtypeStruct((jax.device_count(),), np.int32, sharding=self._per_device)
            self._maximum = maximum.lower(shape).compile()

    def submit(self, request: Callable[[], int]) -> None:
        """Starts the reduction of this step's request; called once a step by all processes."""
        if self._maximum is not None:
            own = np.full(jax.device_count(), request(), np.int32)
            self._submitted = self._maximum(
                jax.make_array_from_callback(own.shape, self._per_device, lambda at: own[at])
            )

    def result(self, request: Callable[[], int]) -> int:
        """The largest of the requests that were submitted last, 0 before the first; a single process gets its own
        current request."""
        if self._maximum is None:
            return request()
        return 0 if self._submitted is None else int(self._submitted)


_call_counts: dict[str, int] = {}


def _state() -> Any:
    """JAX's state of its coordination service. There is no public access to it, and Orbax uses this one too."""
    from jax._src import distributed

    return distributed.global_state
