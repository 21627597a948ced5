"""The web server of `hma play` (extra `play`): a page, what it must know, and a websocket for each visitor."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import AsyncIterator, Callable
from importlib.resources import files
from urllib.parse import urlsplit

from aiohttp import WSMsgType, web

from experiments.applications.play.crowd import FAULTS, REPLIES, Crowd, Full, Visitor
from experiments.applications.play.turn import Truth, command, picture
from hma_jax.config.json import to_dict
from hma_jax.simulator.simulator import Simulator

log = logging.getLogger(__name__)

LARGEST_MESSAGE = 2**16
"""Bytes of a message from a visitor; a longer one ends the connection."""

HEARTBEAT = 20.0
"""Seconds between questions whether a silent visitor is still there."""

WAITING = 32
"""Connections besides those with a seat that are listened to; further ones are refused."""

CROWD = web.AppKey("crowd", Crowd)
SOCKETS = web.AppKey("sockets", set)
HEADERS = {
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline'; img-src 'self' data:; connect-src 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


def make_app(simulator: Simulator, truth: Truth, together: int | None = None) -> web.Application:
    """The application; it serves as many visitors at once as the simulator has episodes. Of those, `together` (default:
    all) act at once, until its crowd is told that more can."""
    app = web.Application(client_max_size=LARGEST_MESSAGE)
    app[SOCKETS] = set()
    app.cleanup_ctx.append(lambda app: _crowd(app, simulator, truth, together))
    about = json.dumps(describe(simulator, truth))
    page = files("experiments.applications.play").joinpath("page.html").read_text()

    async def show(_: web.Request) -> web.Response:
        return web.Response(text=page, content_type="text/html", headers=HEADERS)

    async def robots(_: web.Request) -> web.Response:
        return web.Response(text=about, content_type="application/json", headers=HEADERS)

    app.add_routes([
        web.get("/", show), web.get("/robots", robots), web.get("/drive", _drive),
        web.get("/recording/{token}/{kind}", _recording),
    ])  # fmt: skip
    return app


async def serve(app: web.Application, host: str, port: int, ready: Callable[[int], None]) -> None:
    """Serves until cancelled; `ready` is told the port, which port 0 leaves open. Raises OSError for a taken one."""
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=2.0)
    await runner.setup()
    try:
        await web.TCPSite(runner, host, port).start()
        ready(runner.addresses[0][1])
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()


async def _crowd(app: web.Application, simulator: Simulator, truth: Truth, together: int | None) -> AsyncIterator[None]:
    crowd = app[CROWD] = Crowd(simulator, truth, together)
    serving = asyncio.create_task(crowd.serve())
    yield
    serving.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await serving
    for socket in list(app[SOCKETS]):
        await socket.close(code=1001)
    crowd.close()


def describe(simulator: Simulator, truth: Truth) -> list[dict]:
    """Every robot with its commands, its starts as pictures, whether the model is deaf to them, and whether its true
    simulator is here."""
    described = []
    for robot in simulator.robots.values():
        starts = [start for start in simulator.starts if start.robot == robot.name]
        if not starts:
            continue
        described.append({
            **to_dict(robot),
            "starts": [picture(start.images[-1]) for start in starts],
            "first": [command(robot, s.actions[-1] if len(s.actions) else None) for s in starts],
            "deaf": simulator.deaf,
            "truth": truth(robot) is not None and all(start.seed is not None for start in starts),
        })  # fmt: skip
    return described


def _same_origin(request: web.Request) -> bool:
    """Whether the page that connects came from here: others must not drive what a visitor's browser can reach."""
    origin = request.headers.get("Origin")
    return origin is None or urlsplit(origin).netloc == request.host


async def _drive(request: web.Request) -> web.StreamResponse:
    crowd, sockets = request.app[CROWD], request.app[SOCKETS]
    if not _same_origin(request):
        raise web.HTTPForbidden(text="this page is served elsewhere")
    if len(sockets) >= len(crowd.simulator) + WAITING:
        raise web.HTTPServiceUnavailable(text="too many connections")
    socket = web.WebSocketResponse(max_msg_size=LARGEST_MESSAGE, heartbeat=HEARTBEAT)
    await socket.prepare(request)
    sockets.add(socket)
    try:
        visitor = crowd.enter(request.query.get("token"))
        await _converse(crowd, visitor, socket, request.transport)
    except Full:
        await socket.send_str(json.dumps({"type": "full", "message": "all seats are taken; try again later"}))
        await socket.close(code=1013)
    finally:
        sockets.discard(socket)
    return socket


async def _converse(
    crowd: Crowd, visitor: Visitor, socket: web.WebSocketResponse, transport: asyncio.Transport | None
) -> None:
    replies: asyncio.Queue[str] = asyncio.Queue(REPLIES)
    visitor.socket, visitor.transport, visitor.replies = socket, transport, replies
    sending = asyncio.create_task(crowd.send(visitor, socket, replies))
    robot, start = visitor.seat.robot, visitor.seat.start
    visitor.tell({"type": "hello", "token": visitor.token, "robot": robot.name if robot else None, "start": start})
    try:
        await _listen(crowd, visitor, socket)
    finally:
        crowd.leave(visitor, socket)
        sending.cancel()


async def _listen(crowd: Crowd, visitor: Visitor, socket: web.WebSocketResponse) -> None:
    faults = 0
    async for message in socket:
        await crowd.room_for(visitor)
        if visitor.socket is not socket:  # its seat, or its visitor, went elsewhere
            return
        if message.type != WSMsgType.TEXT or not crowd.wish(visitor, _parsed(message.data)):
            faults += 1
            visitor.tell({"type": "error", "message": "that message makes no sense"})
            if faults >= FAULTS:
                await socket.close(code=1008)
                return


def _parsed(data: str) -> dict:
    """An empty dict for what is no JSON object."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


async def _recording(request: web.Request) -> web.Response:
    """A download of what a visitor recorded: kind mp4, or rlds as a zip."""
    visitor = request.app[CROWD].visitors.get(request.match_info["token"])
    recording = visitor.seat.recording if visitor else None  # read once: the simulator's thread may take it away
    recording = recording.copy() if recording else None
    kinds: dict[str, tuple[Callable[[], bytes], str, str]] = {}
    if recording is not None and len(recording) > 1:
        kinds = {
            "mp4": (recording.video, "video/mp4", f"{recording.robot.name}.mp4"),
            "rlds": (recording.dataset, "application/zip", f"{recording.robot.name}_rlds.zip"),
        }
    if request.match_info["kind"] not in kinds:
        raise web.HTTPNotFound(text="nothing was recorded")
    make, kind, name = kinds[request.match_info["kind"]]
    body = await asyncio.get_running_loop().run_in_executor(None, make)
    disposition = f'attachment; filename="{name}"'
    return web.Response(body=body, content_type=kind, headers=HEADERS | {"Content-Disposition": disposition})
