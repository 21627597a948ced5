"""Several processes watch over each other: one that is lost, or fails, ends all of them, by name.

A collective waits for ever for a process that is gone, on most platforms without a word. So every process leaves a
sign of life with the coordinator (process 0) once a second and reads those of the others. A process
whose sign has not changed for `lost_after` seconds is lost; so is the coordinator if it has not answered for as
long, or refuses connections, which only a coordinator that has ended does. Who finds that out says whom it misses
and ends with LOST: nothing of what was computed since the last checkpoint could be saved without the lost one.

A cut of the network that is shorter than `lost_after` does nothing: connections go on when it is over.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax

LOST = 75
"""Exit code of a process that misses another one (EX_TEMPFAIL of sysexits.h): start all of them again."""

EVERY = 1.0  # seconds between two signs of life
GRACE = 2.0  # seconds: all may fail in the same way, and then each says so itself
KEY = "hma/alive/"
DONE, FAILED = "done", "failed"


@dataclass
class Signs:
    """What one process knows of all, by its own clock: no two clocks are compared."""

    process: int
    hosts: list[str]
    address: str  # of the coordinator
    lost_after: float  # seconds
    clock: Callable[[], float] = time.monotonic
    last: dict[int, tuple[list[Any], float]] = field(default_factory=dict)  # of each process, and when it came
    answered: float = 0.0  # when the coordinator was heard of last
    refused: bool = False  # it takes no connections any more

    def __post_init__(self):
        self.answered = self.clock()
        self.last = {p: ([], self.answered) for p in range(len(self.hosts))}

    def hear(self, signs: dict[int, list[Any]]) -> None:
        """The coordinator answered with everybody's last sign."""
        now = self.answered = self.clock()
        self.refused = False
        for p, sign in signs.items():
            if self.last[p][0] != sign:
                self.last[p] = (sign, now)

    def verdict(self) -> str | None:
        """Why this process must end; None: it need not."""
        now, others = self.clock(), {p: x for p, x in self.last.items() if p != self.process}
        again = "start all processes again: they go on from the last checkpoint"
        for p, (sign, when) in others.items():
            if sign[:1] == [FAILED] and now - when > GRACE:
                return f"{self._named(p)} ended with an error: {sign[1]}"
        silent = now - self.answered
        if self.process and self.last[0][0] != [DONE] and (self.refused or silent > self.lost_after):
            why = "has ended" if self.refused else f"has not answered for {silent:.0f} s"
            return f"lost {self._named(0)}, the coordinator at {self.address}: it {why}; {again}"
        if silent > 5 * EVERY:
            return None  # what the others did meanwhile is not known
        for p, (sign, when) in others.items():
            if sign != [DONE] and now - when > self.lost_after:
                return f"lost {self._named(p)}: no sign of life for {now - when:.0f} s; {again}"
        return None

    def _named(self, process: int) -> str:
        return f"process {process} of {len(self.hosts)} on host {self.hosts[process]}"


class Watchdog:
    """Leaves this process's signs and judges those of the others, in threads of its own."""

    def __init__(self, client: Any, signs: Signs, leave: Callable[[str], None]):
        """`client` is JAX's, of its coordination service; `leave` is told the verdict."""
        self._client, self.signs, self._leave = client, signs, leave
        self._count, self._over = 0, threading.Event()
        for work in (self._beat, self._judge):
            threading.Thread(target=work, name=f"watchdog{work.__name__}", daemon=True).start()

    def end(self, *sign: str) -> None:
        """The last sign of this process: (DONE,) or (FAILED, message). It judges no more."""
        self._over.set()
        try:
            self._write(list(sign))
        except jax.errors.JaxRuntimeError as error:  # the coordinator is gone: nobody is left to tell
            print(f"note: the other processes could not be told ({error})", file=sys.stderr)

    def _write(self, sign: list[Any]) -> None:
        self._client.key_value_set(f"{KEY}{self.signs.process}", json.dumps(sign), allow_overwrite=True)

    def _beat(self) -> None:
        while not self._over.is_set():
            self._count += 1
            try:
                self._write([self._count])
                found = self._client.key_value_dir_get(KEY)
                self.signs.hear({int(key.rpartition("/")[2]): json.loads(sign) for key, sign in found})
            except jax.errors.JaxRuntimeError:  # it cannot be reached: `_judge` counts for how long
                self.signs.refused = _refuses(self.signs.address)
            self._over.wait(EVERY)

    def _judge(self) -> None:
        while not self._over.wait(EVERY / 2):
            verdict = self.signs.verdict()
            if verdict is not None and not self._over.is_set():
                self._leave(verdict)


def watch(client: Any, process: int, hosts: list[str], address: str, lost_after: float) -> None:
    """From now on this process ends with LOST when another one of the program is lost."""
    global _watchdog
    _keep_aborting_threads()
    _watchdog = Watchdog(client, Signs(process, hosts, address, lost_after), _leave)


def finish(error: str | None = None, *, perhaps_lost: bool = False) -> None:
    """At the end of this process: the others need not wait for it, or learn why it failed.

    `perhaps_lost`: the error may come of another process's end; then the watchdog has time to say whose.
    """
    global _watchdog
    watchdog, _watchdog = _watchdog, None
    if watchdog is None:
        return
    if error is None:
        watchdog.end(DONE)
        return
    if perhaps_lost:
        time.sleep(watchdog.signs.lost_after + GRACE + EVERY)
    watchdog.end(FAILED, error)
    time.sleep(GRACE + EVERY)  # the others read it before the coordinator may be gone


_watchdog: Watchdog | None = None


def _leave(verdict: str) -> None:
    print(f"error: {verdict} (exit code {LOST})", file=sys.stderr, flush=True)
    os._exit(LOST)  # threads wait inside of collectives and would hold up any other end


def _refuses(address: str) -> bool:
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=2).close()
    except ConnectionRefusedError:
        return True
    except OSError:
        return False
    return False


def _keep_aborting_threads() -> None:
    """JAX aborts a process as soon as its connection to the coordinator breaks, without naming anyone.

    The thread that aborts sleeps first (six seconds, the number of the signal), in which the watchdog
    says who is missing. No Python runs in a thread that may have broken off anywhere.
    """
    libc = ctypes.CDLL(None)
    libc.signal.argtypes = (ctypes.c_int, ctypes.c_void_p)
    libc.signal(int(signal.SIGABRT), ctypes.cast(libc.sleep, ctypes.c_void_p))
