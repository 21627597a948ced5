"""Who is there: visitors, their seats in the simulator, what they wait for and what waits for them.

Everything here runs in the event loop's thread but `turn.answer`, of which one runs at a time in another. Queues are
bounded on both ends: of a visitor who asks faster than frames are made no more is read, one who does not read is let
go.
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

from experiments.applications.play.turn import CHANGES, Message, Seat, Truth, Wish, answer
from hma_jax.simulator.simulator import Simulator

log = logging.getLogger(__name__)

WISHES = 4
"""Of one visitor that may wait to be answered."""

REPLIES = 16
"""To one visitor that may wait to be sent."""

SEND_SECONDS = 10.0
"""That a message may take until the visitor's computer has it."""

WORKING_SECONDS = 3.0
"""Of work on a round, after each of which those who wait are told of it: a page that hears nothing for three times as
long takes its connection for lost."""

PARTING_SECONDS = 1.0
"""That a page which loses its seat has to hear of it."""

LINGER_SECONDS = 120.0
"""That a seat is kept for a visitor whose connection was lost."""

IDLE_SECONDS = 900.0
"""Without a wish, after which a connected visitor's seat is free for others who want it."""

FAULTS = 20
"""Messages of one connection that make no sense, until it is closed."""

FAILED = "the simulator failed, as the server's log says; start again if it no longer moves"
"""What visitors are told whose wishes are lost by a fault of ours."""


class Full(Exception):
    """There is no free seat."""


@dataclass(eq=False)
class Visitor:
    """Somebody with a seat, connected or for a while not."""

    token: str
    seat: Seat
    wishes: deque[Wish] = field(default_factory=deque)
    answered: asyncio.Event = field(default_factory=asyncio.Event)
    replies: asyncio.Queue[str] | None = None  # None while not connected
    socket: web.WebSocketResponse | None = None
    transport: asyncio.Transport | None = None  # of the socket
    active: float = field(default_factory=time.monotonic)
    acted: int = 0  # the newest round in which an action of it was taken

    def tell(self, message: Message) -> None:
        """Leaves a message to be sent. One who lets so many wait that there is no room is disconnected."""
        if self.replies is None:
            return
        try:
            self.replies.put_nowait(json.dumps(message))
        except asyncio.QueueFull:
            log.info("a visitor does not read; disconnected")
            self.abort()
            self.replies = None

    def abort(self) -> None:
        """Ends the connection at once: whoever does not read does not say goodbye either."""
        if self.transport is not None:
            self.transport.abort()
        self.socket = self.transport = None


async def _say_goodbye(socket: web.WebSocketResponse, transport: asyncio.Transport | None, why: str) -> None:
    """Then the connection is ended, whether the page listens or not."""
    with contextlib.suppress(ConnectionError, RuntimeError, TimeoutError):
        await asyncio.wait_for(socket.send_str(json.dumps({"type": "gone", "message": why})), PARTING_SECONDS)
    if transport is not None:
        transport.abort()


class Crowd:
    """The visitors of one simulator."""

    def __init__(self, simulator: Simulator, truth: Truth, together: int | None = None):
        """`together`: who can act in one round, as far as programs are compiled (default: all). May grow meanwhile."""
        self.simulator, self.truth = simulator, truth
        self.together = len(simulator) if together is None else together
        self.visitors: dict[str, Visitor] = {}
        self._free = list(range(len(simulator)))
        self._wanted = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, "simulator")
        self._ending: set[asyncio.Task[None]] = set()
        self._rounds = 0

    # --- Coming and going --------------------------------------------------------------------------

    def enter(self, token: str | None) -> Visitor:
        """The visitor with this token, if there still is one, or a new one. Raises Full."""
        now = time.monotonic()
        if token in self.visitors:
            visitor = self.visitors[token]
            # The same page in a second window takes over. The first is told, or it would come back and take over again.
            self._part(visitor, "this goes on in another window")
            visitor.active = now
            return visitor
        if not self._free:
            self._make_room(now)
        visitor = Visitor(secrets.token_urlsafe(16), Seat(self._free.pop(0)))
        self.visitors[visitor.token] = visitor
        return visitor

    def _part(self, visitor: Visitor, why: str) -> None:
        """Tells a visitor's page, if one is connected, that it has no seat any more, and ends its connection,
        with what was asked through it."""
        if visitor.socket is not None:
            ending = asyncio.create_task(_say_goodbye(visitor.socket, visitor.transport, why))
            self._ending.add(ending)
            ending.add_done_callback(self._ending.discard)
        visitor.socket = visitor.transport = visitor.replies = None
        visitor.wishes.clear()
        visitor.answered.set()  # whoever listens to that connection waits for this

    def _make_room(self, now: float) -> None:
        """Frees the seat of whoever is away for the longest, if anybody is."""
        away = [v for v in self.visitors.values() if v.socket is None or now - v.active > IDLE_SECONDS]
        if not away:
            raise Full
        gone = min(away, key=lambda v: (v.socket is not None, v.active))
        self._part(gone, "your seat was given to another visitor; reload the page")
        self.dismiss(gone)

    def leave(self, visitor: Visitor, socket: web.WebSocketResponse) -> None:
        """The connection ended. The seat stays for a while."""
        if visitor.socket is socket:
            visitor.socket = visitor.replies = visitor.transport = None
            visitor.wishes.clear()
            visitor.active = time.monotonic()

    def dismiss(self, visitor: Visitor) -> None:
        if self.visitors.pop(visitor.token, None) is not None:
            self._free.append(visitor.seat.episode)

    def tidy(self) -> None:
        """Frees the seats of those who were away for too long."""
        now = time.monotonic()
        for visitor in list(self.visitors.values()):
            if visitor.socket is None and now - visitor.active > LINGER_SECONDS:
                self.dismiss(visitor)

    # --- Wishes ------------------------------------------------------------------------------------

    def wish(self, visitor: Visitor, message: Message) -> bool:
        """Takes a message as a wish. False if it makes no sense."""
        kind = message.get("type")
        if not isinstance(kind, str) or (kind != "act" and kind not in CHANGES):
            return False
        visitor.active = time.monotonic()
        visitor.wishes.append(Wish(kind, message))
        self._wanted.set()
        return True

    async def room_for(self, visitor: Visitor) -> None:
        """Until few enough of a visitor's wishes wait. Meanwhile nothing of that visitor is read."""
        while len(visitor.wishes) >= WISHES:
            visitor.answered.clear()
            await visitor.answered.wait()

    async def serve(self) -> None:
        """Answers wishes, a round of visitors' oldest ones at a time, until cancelled. Each has one answer, through the
        connection that it came through or, if that has ended, none."""
        loop = asyncio.get_running_loop()
        while True:
            await self._wanted.wait()
            self._wanted.clear()
            asking = self._round()
            if not asking:
                continue
            connections = [v.replies for v in asking]
            wishes = {i: (v.seat, v.wishes.popleft()) for i, v in enumerate(asking)}
            made = loop.run_in_executor(self._thread, answer, self.simulator, self.truth, wishes)
            try:
                while not (await asyncio.wait([made], timeout=WORKING_SECONDS))[0]:
                    self._say_it_works(asking)
                replies = made.result()
            except Exception:  # a fault of ours: this round's wishes are lost, the server is not
                log.exception("a round of wishes could not be answered")
                self._forget_lost()
                replies = {i: {"type": "error", "message": FAILED} for i in wishes}
            for i, message in replies.items():
                asking[i].answered.set()
                if asking[i].replies is connections[i]:  # another window has not asked
                    asking[i].tell(message)
            if any(v.wishes for v in self.visitors.values()):
                self._wanted.set()
            self.tidy()

    def _round(self) -> list[Visitor]:
        """Whose oldest wish is answered next: all, but of those who act no more than `together`, who take turns."""
        self._rounds += 1
        asking = [v for v in self.visitors.values() if v.wishes]
        acting = sorted((v for v in asking if v.wishes[0].kind == "act"), key=lambda v: v.acted)
        for visitor in acting[: self.together]:
            visitor.acted = self._rounds
        waiting = acting[self.together :]
        return [v for v in asking if v not in waiting]

    def _say_it_works(self, asking: list[Visitor]) -> None:
        """To all who wait for an answer: those of this round, and those whose turn has not come."""
        for visitor in self.visitors.values():
            if visitor in asking or visitor.wishes:
                visitor.tell({"type": "working"})

    def _forget_lost(self) -> None:
        """After a failure: visitors whose episode went with it have to begin one."""
        for visitor in self.visitors.values():
            if not self.simulator.counts[visitor.seat.episode]:
                visitor.seat.robot = None

    async def send(self, visitor: Visitor, socket: web.WebSocketResponse, replies: asyncio.Queue[str]) -> None:
        """Sends a connection's messages until it is cancelled or takes too long."""
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
