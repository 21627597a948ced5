"""Several processes watch over each other: one that is lost, or fails, ends all of them, by name.

A collective waits for ever for a process that is gone, on most platforms without a word. So every process gives a
sign of life to the coordinator (process 0) once a second, in a connection of its own, and is told those of the
others. A process whose sign has not changed for `lost_after` seconds is lost; so is the coordinator if it has not
answered for as long, or refuses connections, which only one that has ended does. Who finds that out says whom it
misses and ends with Exit.LOST: nothing of what was computed since the last checkpoint could be saved without it.

A cut of the network that is shorter than `lost_after` does nothing: connections go on when it is over. (JAX's own
heartbeats name nobody, and its service closes connections that are silent in the middle of an answer for 20
seconds: the less is said there, the longer a cut may last.)
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

EVERY = 1.0  # seconds between two signs of life
GRACE = 2.0  # seconds: all may fail in the same way, and then each says so itself
PATIENCE = 3.0  # seconds for one exchange of signs
LONGEST = 2**12  # bytes of a sign
DONE, FAILED = "done", "failed"

Sign = list[Any]
"""[count], [DONE] or [FAILED, message]."""


@dataclass
class Signs:
    """What one process knows of all, by its own clock: no two clocks are compared."""

    process: int
    hosts: list[str]
    address: str  # of the coordinator
    lost_after: float  # seconds
    clock: Callable[[], float] = time.monotonic
    last: dict[int, tuple[Sign, float]] = field(default_factory=dict)  # of each process, and when it came
    answered: float = 0.0  # when the coordinator was heard of last
    refused: bool = False  # it takes no connections any more

    def __post_init__(self):
        self.answered = self.clock()
        self.last = {p: ([], self.answered) for p in range(len(self.hosts))}

    def hear(self, signs: dict[int, Sign]) -> None:
        """The coordinator answered with everybody's last sign."""
        now = self.answered = self.clock()
        self.refused = False
        for p, sign in signs.items():
            if self.last[p][0] != sign:
                self.last[p] = (sign, now)

    def excuse(self, seconds: float) -> None:
        """This process itself stood still for so long: nobody could be heard meanwhile."""
        self.answered += seconds
        self.last = {p: (sign, when + seconds) for p, (sign, when) in self.last.items()}

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


class Board(socketserver.ThreadingTCPServer):
    """Where process 0 keeps everybody's last sign: whoever brings one, and the program's `word`, is told all of
    them."""

    daemon_threads, allow_reuse_address, request_queue_size = True, True, 1024

    def __init__(self, word: str):
        super().__init__(("", 0), _Visit)
        self.word, self.signs = word, dict[int, Sign]()
        threading.Thread(target=self.serve_forever, name="signs of life", daemon=True).start()

    @property
    def port(self) -> int:
        return self.server_address[1]

    def exchange(self, process: int, sign: Sign) -> dict[int, Sign]:
        self.signs[process] = sign
        return dict(self.signs)

    def handle_error(self, *_: Any) -> None:
        """A visitor that broke off comes again."""


class _Visit(socketserver.StreamRequestHandler):
    timeout = PATIENCE

    def handle(self) -> None:
        word, process, sign = json.loads(self.rfile.readline(LONGEST))
        if word == self.server.word:
            self.wfile.write(json.dumps([*self.server.exchange(process, sign).items()]).encode() + b"\n")


def visit(host: str, port: int, word: str, process: int, sign: Sign) -> dict[int, Sign]:
    """Brings a sign to the board there. Raises OSError; ConnectionRefusedError means that its process has ended."""
    with socket.create_connection((host, port), timeout=PATIENCE) as line, line.makefile("rb") as answers:
        line.sendall(json.dumps([word, process, sign]).encode() + b"\n")
        answer = answers.readline()
    if not answer.endswith(b"\n"):
        raise ConnectionResetError("it broke off")
    return {int(p): sign for p, sign in json.loads(answer)}


class Watchdog:
    """Gives this process's signs and judges those of the others, in threads of its own."""

    def __init__(self, signs: Signs, exchange: Callable[[int, Sign], dict[int, Sign]], leave: Callable[[str], None]):
        """`exchange(process, sign)` is `Board.exchange` or `visit`; `leave` is told the verdict."""
        self.signs, self._exchange, self._leave = signs, exchange, leave
        self._over = threading.Event()
        for work in (self._beat, self._judge):
            threading.Thread(target=work, name=f"watchdog{work.__name__}", daemon=True).start()

    def end(self, sign: Sign) -> None:
        """The last sign of this process, which judges no more."""
        self._over.set()
        try:
            self._exchange(self.signs.process, sign)
        except OSError as error:
            print(f"note: the other processes could not be told ({error})", file=sys.stderr)

    def _beat(self) -> None:
        count = 0
        while not self._over.is_set():
            count += 1
            try:
                self.signs.hear(self._exchange(self.signs.process, [count]))
            except ConnectionRefusedError:
                self.signs.refused = True
            except (OSError, ValueError):  # for now; `_judge` counts for how long
                pass
            self._over.wait(EVERY)

    def _judge(self) -> None:
        looked = self.signs.clock()
        while not self._over.wait(EVERY / 2):
            slept, looked = self.signs.clock() - looked, self.signs.clock()
            if slept > 5 * EVERY:  # stopped, or a machine that was
                self.signs.excuse(slept)
            verdict = self.signs.verdict()
            if verdict is not None and not self._over.is_set():
                self._leave(verdict)


def watch(signs: Signs, exchange: Callable[[int, Sign], dict[int, Sign]]) -> None:
    """From now on this process ends with Exit.LOST when another one is lost."""
    global _watchdog
    _keep_aborting_threads()
    _watchdog = Watchdog(signs, exchange, _leave)


def finish(error: str | None = None, *, perhaps_lost: bool = False) -> None:
    """At the end of this process: the others need not wait for it, or learn why it failed.

    `perhaps_lost`: the error may come of another process's end; then the watchdog has time to say whose.
    """
    global _watchdog
    watchdog, _watchdog = _watchdog, None
    if watchdog is None:
        return
    if error is None:
        watchdog.end([DONE])
        return
    if perhaps_lost:
        time.sleep(watchdog.signs.lost_after + GRACE + EVERY)
    watchdog.end([FAILED, error[: LONGEST // 8]])
    time.sleep(GRACE + 2 * EVERY)  # the others read it before the coordinator may be gone


_watchdog: Watchdog | None = None


def _leave(verdict: str) -> None:
    print(f"error: {verdict} (exit code {Exit.LOST})", file=sys.stderr, flush=True)
    os._exit(Exit.LOST)  # threads wait inside of collectives and would hold up any other end


def _keep_aborting_threads() -> None:
    """JAX aborts a process as soon as its connection to the coordinator breaks, without naming anyone.

    The thread that aborts sleeps first (six seconds, the number of the signal), in which the watchdog
    says who is missing. No Python runs in a thread that may have broken off anywhere.
    """
    libc = ctypes.CDLL(None)
    libc.signal.argtypes = (ctypes.c_int, ctypes.c_void_p)
    libc.signal(int(signal.SIGABRT), ctypes.cast(libc.sleep, ctypes.c_void_p))
