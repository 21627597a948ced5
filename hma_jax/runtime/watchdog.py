"""Heartbeats between processes: when one is lost or fails, all of them end, with an error that names it.

A collective waits for ever for a process that is gone, on most platforms without a message. So every process sends a
heartbeat to the coordinator (process 0) once a second, each over a new connection, and receives the latest heartbeats
of the others. A process whose heartbeat has not changed for `lost_after` seconds is lost. So is the coordinator if it
has not answered for as long, or if it refuses connections, which means that it has ended. A process that finds another
one lost prints which one and exits with Exit.LOST: without the lost process nothing computed since the last checkpoint
could be saved. If a process failed in a way in which it would fail again (REPEATED), the others exit with its code.

A network outage that is shorter than `lost_after` has no effect: connections continue when it is over. (JAX's own
heartbeats name no process, and its service closes connections that are silent for 20 seconds in the middle of an
answer. The less is sent over it, the longer an outage may last.)
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import socket
import socketserver
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from hma_jax.runtime.exits import Exit

INTERVAL = 1.0  # seconds between two heartbeats
GRACE = 2.0  # seconds: if all fail in the same way, each has this time to report its own error
EXCHANGE_TIMEOUT = 3.0  # seconds for one exchange of heartbeats
MAX_BYTES = 2**12  # of a heartbeat
DONE, FAILED = "done", "failed"
REPEATED = (Exit.REFUSED, Exit.DIVERGED)  # not to be started again, whichever process's exit code a scheduler reads

Heartbeat = list[Any]
"""[count] while the process runs, then [DONE] or [FAILED, message, exit code]."""


@dataclass
class Heartbeats:
    """The latest heartbeat of every process, as one process knows them. Times are by its own clock: clocks are not
    compared."""

    process: int
    hosts: list[str]
    address: str  # of the coordinator
    lost_after: float  # seconds
    clock: Callable[[], float] = time.monotonic
    last: dict[int, tuple[Heartbeat, float]] = field(default_factory=dict)  # of each process, and when it last changed
    answered: float = 0.0  # when the coordinator answered last
    refused: bool = False  # whether the coordinator refuses connections

    def __post_init__(self):
        self.answered = self.clock()
        self.last = {p: ([], self.answered) for p in range(len(self.hosts))}

    def receive(self, heartbeats: dict[int, Heartbeat]) -> None:
        """Records an answer of the coordinator: the latest heartbeats of all."""
        now = self.answered = self.clock()
        self.refused = False
        for p, heartbeat in heartbeats.items():
            if self.last[p][0] != heartbeat:
                self.last[p] = (heartbeat, now)

    def extend_deadlines(self, seconds: float) -> None:
        """Discounts `seconds` in which this process itself was suspended and could not receive any heartbeat."""
        self.answered += seconds
        self.last = {p: (heartbeat, when + seconds) for p, (heartbeat, when) in self.last.items()}

    def failure(self) -> tuple[str, int] | None:
        """Why this process must end, and with which exit code; None if it need not."""
        for p, (heartbeat, when) in self.last.items():
            if p != self.process and heartbeat[:1] == [FAILED] and self.clock() - when > GRACE:
                _, message, code = heartbeat
                return f"{self._name_of(p)} ended with an error: {message}", code if code in REPEATED else Exit.LOST
        lost = self._lost()
        return None if lost is None else (lost, Exit.LOST)

    def _lost(self) -> str | None:
        """Which process is lost, if one is."""
        now, others = self.clock(), {p: x for p, x in self.last.items() if p != self.process}
        again = "start all processes again: they continue from the last checkpoint"
        silent = now - self.answered
        if self.process and self.last[0][0] != [DONE] and (self.refused or silent > self.lost_after):
            why = "has ended" if self.refused else f"has not answered for {silent:.0f} s"
            return f"lost {self._name_of(0)}, the coordinator at {self.address}: it {why}; {again}"
        if silent > 5 * INTERVAL:
            return None  # the others' heartbeats are as old as the coordinator's last answer
        for p, (heartbeat, when) in others.items():
            if heartbeat != [DONE] and now - when > self.lost_after:
                return f"lost {self._name_of(p)}: no sign of life for {now - when:.0f} s; {again}"
        return None

    def _name_of(self, process: int) -> str:
        return f"process {process} of {len(self.hosts)} on host {self.hosts[process]}"


class HeartbeatServer(socketserver.ThreadingTCPServer):
    """Runs in process 0 and keeps the latest heartbeat of every process. A client that sends its heartbeat, with the
    program's `token`, gets all of them back."""

    daemon_threads, allow_reuse_address, request_queue_size = True, True, 1024

    def __init__(self, token: str):
        # The coordinator's address may be IPv4 or IPv6; JAX's own service listens on both too.
        self.address_family = socket.AF_INET6 if socket.has_dualstack_ipv6() else socket.AF_INET
        super().__init__(("", 0), _HeartbeatHandler)
        self.token, self.heartbeats = token, dict[int, Heartbeat]()
        threading.Thread(target=self.serve_forever, name="heartbeats", daemon=True).start()

    def server_bind(self) -> None:
        if self.address_family == socket.AF_INET6:
            self.socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, False)  # accepts IPv4 too
        super().server_bind()

    @property
    def port(self) -> int:
        return self.server_address[1]

    def exchange(self, process: int, heartbeat: Heartbeat) -> dict[int, Heartbeat]:
        self.heartbeats[process] = heartbeat
        return dict(self.heartbeats)

    def handle_error(self, *_: Any) -> None:
        """Ignored: a client whose connection broke sends its next heartbeat on a new one."""


class _HeartbeatHandler(socketserver.StreamRequestHandler):
    timeout = EXCHANGE_TIMEOUT

    def handle(self) -> None:
        token, process, heartbeat = json.loads(self.rfile.readline(MAX_BYTES))
        if token == self.server.token:
            self.wfile.write(json.dumps([*self.server.exchange(process, heartbeat).items()]).encode() + b"\n")


def send_heartbeat(host: str, port: int, token: str, process: int, heartbeat: Heartbeat) -> dict[int, Heartbeat]:
    """Sends a heartbeat to a `HeartbeatServer`; returns those of all. Raises OSError; ConnectionRefusedError means that
    the server's process has ended."""
    with (
        socket.create_connection((host, port), timeout=EXCHANGE_TIMEOUT) as connection,
        connection.makefile("rb") as answers,
    ):
        connection.sendall(json.dumps([token, process, heartbeat]).encode() + b"\n")
        answer = answers.readline()
    if not answer.endswith(b"\n"):
        raise ConnectionResetError("the connection broke")
    return {int(p): heartbeat for p, heartbeat in json.loads(answer)}


class Watchdog:
    """Sends this process's heartbeats and checks those of the others, in threads of its own."""

    def __init__(
        self,
        heartbeats: Heartbeats,
        exchange: Callable[[int, Heartbeat], dict[int, Heartbeat]],
        on_failure: Callable[[str, int], None],
    ):
        """`exchange(process, heartbeat)` is `HeartbeatServer.exchange` or `send_heartbeat`; `on_failure` is called with
        `Heartbeats.failure`, if there is one."""
        self.heartbeats, self._exchange, self._on_failure = heartbeats, exchange, on_failure
        self._ended = threading.Event()
        for work in (self._beat, self._check):
            threading.Thread(target=work, name=f"watchdog{work.__name__}", daemon=True).start()

    def end(self, heartbeat: Heartbeat) -> None:
        """Stops both threads and sends `heartbeat`, DONE or FAILED, as the last one of this process."""
        self._ended.set()
        try:
            self._exchange(self.heartbeats.process, heartbeat)
        except OSError as error:
            print(f"note: the other processes could not be notified ({error})", file=sys.stderr)

    def _beat(self) -> None:
        count = 0
        while not self._ended.is_set():
            count += 1
            try:
                self.heartbeats.receive(self._exchange(self.heartbeats.process, [count]))
            except ConnectionRefusedError:
                self.heartbeats.refused = True
            except (OSError, ValueError):  # may pass; `_check` measures how long it lasts
                pass
            self._ended.wait(INTERVAL)

    def _check(self) -> None:
        checked = self.heartbeats.clock()
        while not self._ended.wait(INTERVAL / 2):
            slept, checked = self.heartbeats.clock() - checked, self.heartbeats.clock()
            if slept > 5 * INTERVAL:  # this process, or its machine, was suspended
                self.heartbeats.extend_deadlines(slept)
            failure = self.heartbeats.failure()
            if failure is not None and not self._ended.is_set():
                self._on_failure(*failure)


def start(heartbeats: Heartbeats, exchange: Callable[[int, Heartbeat], dict[int, Heartbeat]]) -> None:
    """From now on this process ends when another one is lost or failed (`Heartbeats.failure`)."""
    global _watchdog
    _delay_aborts()
    _watchdog = Watchdog(heartbeats, exchange, _exit_now)


def stop(error: str | None = None, code: int = Exit.DONE, *, perhaps_lost: bool = False) -> None:
    """At the end of this process: tells the others that it is done, or why it failed and with which exit code.

    `perhaps_lost`: the error may be due to the loss of another process; the watchdog then gets time to find out which.
    """
    global _watchdog
    watchdog, _watchdog = _watchdog, None
    if watchdog is None:
        return
    if error is None:
        watchdog.end([DONE])
        return
    if perhaps_lost:
        time.sleep(watchdog.heartbeats.lost_after + GRACE + INTERVAL)
    watchdog.end([FAILED, error[: MAX_BYTES // 8], code])
    time.sleep(GRACE + 2 * INTERVAL)  # the others read it before the coordinator may be gone


_watchdog: Watchdog | None = None


def _exit_now(failure: str, code: int) -> None:
    print(f"error: {failure} (exit code {int(code)})", file=sys.stderr, flush=True)
    os._exit(code)  # threads that wait in collectives would block a normal exit


def _delay_aborts() -> None:
    """Delays JAX's abort of a process whose connection to the coordinator broke, because its message names no process.

    The C function `sleep` is installed as the handler of SIGABRT: the aborting thread sleeps for six seconds (the
    signal's number), in which the watchdog reports the lost process. It is a C function because the thread may have
    stopped anywhere, where Python code cannot run.
    """
    libc = ctypes.CDLL(None)
    libc.signal.argtypes = (ctypes.c_int, ctypes.c_void_p)
    libc.signal(int(signal.SIGABRT), ctypes.cast(libc.sleep, ctypes.c_void_p))
