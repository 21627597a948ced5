"""Visitors of the page: their sessions in the simulator, their pending requests and the replies to be sent.

Everything here runs in the event loop's thread except `requests.answer`, of which one call at a time runs in another
thread. Both queues are bounded: if a visitor's requests come faster than frames are made, no more are read, and a
visitor who does not read the replies is disconnected.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import secrets
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

from aiohttp import web

from experiments.applications.play.requests import HANDLERS, Message, Request, Session, Truth, answer
from hma_jax.simulator.simulator import Simulator

log = logging.getLogger(__name__)

MAX_PENDING_REQUESTS = 4
"""Largest number of unanswered requests of one visitor; while there are this many, no more are read."""

MAX_PENDING_REPLIES = 16
"""Largest number of unsent replies to one visitor; with one more the visitor is disconnected."""

SEND_SECONDS = 10.0
"""Seconds within which a message must have been sent, or the visitor is disconnected."""

PROGRESS_SECONDS = 3.0
"""Seconds between messages, to those who wait, that a round is still being computed: a page that hears nothing for
three times as long takes its connection for lost."""

CLOSE_SECONDS = 1.0
"""Seconds within which a page that loses its session must have been told, before its connection is closed."""

IDLE_SECONDS = 900.0
"""Seconds without a request after which a connected visitor's session may be given to somebody else."""

MAX_INVALID_MESSAGES = 20
"""Number of invalid messages on one connection after which it is closed."""

FAILED = "the simulator failed (see the server's log); start the episode again if it no longer moves"
"""The reply to requests that were lost by a fault of the server."""


class NoFreeSession(Exception):
    """All sessions are taken by visitors who are active."""


@dataclass(eq=False)
class Visitor:
    """Somebody with a session, who may be disconnected for a while."""

    token: str
    session: Session
    requests: deque[Request] = field(default_factory=deque)
    answered: asyncio.Event = field(default_factory=asyncio.Event)
    replies: asyncio.Queue[str] | None = None  # None while not connected
    socket: web.WebSocketResponse | None = None
    transport: asyncio.Transport | None = None  # transport of the socket
    active: float = field(default_factory=time.monotonic)
    downloads: int = 0  # downloads that are being made or wait
    acted: int = 0  # the newest round in which an action of this visitor was executed

    def tell(self, message: Message) -> None:
        """Queues a message to be sent. If the queue is full, the visitor is disconnected."""
        if self.replies is None:
            return
        try:
            self.replies.put_nowait(json.dumps(message))
        except asyncio.QueueFull:
            log.info("a visitor does not read; disconnected")
            self.abort()
            self.replies = None

    def abort(self) -> None:
        """Ends the connection without a closing handshake, which a client that does not read would not answer."""
        if self.transport is not None:
            self.transport.abort()
        self.socket = self.transport = None


async def _close_with_reason(socket: web.WebSocketResponse, transport: asyncio.Transport | None, why: str) -> None:
    """Tells a page why its connection ends, and ends it, whether the page listens or not."""
    with contextlib.suppress(ConnectionError, RuntimeError, TimeoutError):
        await asyncio.wait_for(socket.send_str(json.dumps({"type": "gone", "message": why})), CLOSE_SECONDS)
    if transport is not None:
        transport.abort()


class SessionManager:
    """The visitors of one simulator; its episodes are the sessions."""

    def __init__(self, simulator: Simulator, truth: Truth, max_acting: int | None = None):
        """`max_acting`: how many may act in one round, limited by the batch sizes for which programs are compiled
        (default: all). It may grow later."""
        self.simulator, self.truth = simulator, truth
        self.max_acting = len(simulator) if max_acting is None else max_acting
        self.visitors: dict[str, Visitor] = {}
        self._free = list(range(len(simulator)))
        self._wanted = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, "simulator")
        self._ending: set[asyncio.Task[None]] = set()
        self._rounds = 0

    # --- Coming and going --------------------------------------------------------------------------

    def connect(self, token: str | None) -> Visitor:
        """The visitor with this token, if there still is one, or a new one. Raises NoFreeSession."""
        now = time.monotonic()
        if token in self.visitors:
            visitor = self.visitors[token]
            # The same page in a second window takes over. The first is told, or it would come back and take over again.
            self._disconnect(visitor, "this session continues in another window")
            visitor.active = now
            return visitor
        if not self._free:
            self._evict(now)
        visitor = Visitor(secrets.token_urlsafe(16), Session(self._free.pop(0)))
        self.visitors[visitor.token] = visitor
        return visitor

    def _disconnect(self, visitor: Visitor, why: str) -> None:
        """Tells a visitor's page, if one is connected, why its connection ends, and ends it. Pending requests are
        dropped."""
        if visitor.socket is not None:
            ending = asyncio.create_task(_close_with_reason(visitor.socket, visitor.transport, why))
            self._ending.add(ending)
            ending.add_done_callback(self._ending.discard)
        visitor.socket = visitor.transport = visitor.replies = None
        visitor.requests.clear()
        visitor.answered.set()  # wakes `wait_for_capacity` of that connection

    def _evict(self, now: float) -> None:
        """Frees the session of the visitor who has been away or idle for the longest. Raises NoFreeSession without
        any."""
        away = [v for v in self.visitors.values() if v.socket is None or now - v.active > IDLE_SECONDS]
        if not away:
            raise NoFreeSession
        gone = min(away, key=lambda v: (v.socket is not None, v.active))
        self._disconnect(gone, "your place was given to another visitor; reload the page")
        del self.visitors[gone.token]
        self._free.append(gone.session.episode)

    def connection_lost(self, visitor: Visitor, socket: web.WebSocketResponse) -> None:
        """The connection ended. The session is kept, for the visitor to reconnect, until somebody else needs it."""
        if visitor.socket is socket:
            visitor.socket = visitor.replies = visitor.transport = None
            visitor.requests.clear()
            visitor.active = time.monotonic()

    # --- Requests ------------------------------------------------------------------------------------

    def submit(self, visitor: Visitor, message: Message) -> bool:
        """Queues a message as a request. False if it is invalid."""
        kind = message.get("type")
        if not isinstance(kind, str) or (kind != "act" and kind not in HANDLERS):
            return False
        visitor.active = time.monotonic()
        visitor.requests.append(Request(kind, message))
        self._wanted.set()
        return True

    async def wait_for_capacity(self, visitor: Visitor) -> None:
        """Waits until a visitor has fewer than MAX_PENDING_REQUESTS. Meanwhile nothing of that visitor is read."""
        while len(visitor.requests) >= MAX_PENDING_REQUESTS:
            visitor.answered.clear()
            await visitor.answered.wait()

    async def serve(self) -> None:
        """Answers requests in rounds, the oldest of each visitor, until cancelled. A request gets one reply, over the
        connection on which it came, and none if that has ended."""
        loop = asyncio.get_running_loop()
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            due = self._next_round()
            if not due:
                continue
            connections = [v.replies for v in due]
            requests = {i: (v.session, v.requests.popleft()) for i, v in enumerate(due)}
            made = loop.run_in_executor(self._thread, answer, self.simulator, self.truth, requests)
            try:
                while not (await asyncio.wait([made], timeout=PROGRESS_SECONDS))[0]:
                    self._report_progress(due)
                replies = made.result()
            except Exception:  # a fault of the server: this round's requests are lost, and the server continues
                log.exception("a round of requests could not be answered")
                self._reset_failed()
                replies = {i: {"type": "error", "message": FAILED} for i in requests}
            for i, message in replies.items():
                due[i].answered.set()
                if due[i].replies is connections[i]:  # not the connection of another window
                    due[i].tell(message)
            if any(v.requests for v in self.visitors.values()):
                self._wanted.set()

    def _next_round(self) -> list[Visitor]:
        """The visitors whose oldest request is answered next: all who have one, but at most `max_acting` of those who
        act; the latter take turns."""
        self._rounds += 1
        due = [v for v in self.visitors.values() if v.requests]
        acting = sorted((v for v in due if v.requests[0].kind == "act"), key=lambda v: v.acted)
        for visitor in acting[: self.max_acting]:
            visitor.acted = self._rounds
        waiting = acting[self.max_acting :]
        return [v for v in due if v not in waiting]

    def _report_progress(self, due: list[Visitor]) -> None:
        """Tells all who wait for a reply, those of this round and those of later ones, that the server is at work."""
        for visitor in self.visitors.values():
            if visitor in due or visitor.requests:
                visitor.tell({"type": "working"})

    def _reset_failed(self) -> None:
        """After a failure: visitors whose episode was lost have to begin a new one."""
        for visitor in self.visitors.values():
            if not self.simulator.counts[visitor.session.episode]:
                visitor.session.robot = None

    async def send(self, visitor: Visitor, socket: web.WebSocketResponse, replies: asyncio.Queue[str]) -> None:
        """Sends the replies queued for a connection, until cancelled or until one takes longer than SEND_SECONDS."""
        with contextlib.suppress(ConnectionError, RuntimeError):  # it was closed meanwhile
            while True:
                text = await replies.get()
                try:
                    await asyncio.wait_for(socket.send_str(text), SEND_SECONDS)
                except TimeoutError:
                    log.info("a visitor does not read; disconnected")
                    if visitor.socket is socket:
                        visitor.abort()
                    return

    def close(self) -> None:
        self._thread.shutdown(wait=False, cancel_futures=True)
