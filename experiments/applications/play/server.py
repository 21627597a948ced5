"""The web server of `hma play` (extra `play`): a page, the data that it needs, and a websocket for each visitor."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import json
import logging
import re
from collections.abc import AsyncIterator, Awaitable, Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files

from aiohttp import WSMsgType, web
from yarl import URL

from data_pipelines.names import made_name
from experiments.applications.play.requests import Truth, command, picture
from experiments.applications.play.sessions import (
    MAX_INVALID_MESSAGES,
    MAX_PENDING_REPLIES,
    NoFreeSession,
    SessionManager,
    Visitor,
)
from hma_jax.config.json import to_dict
from hma_jax.simulator.simulator import Simulator

log = logging.getLogger(__name__)

LARGEST_MESSAGE = 2**16
"""Largest size in bytes of a message from a visitor; a longer one ends the connection."""

HEARTBEAT = 20.0
"""Seconds between checks of whether a silent visitor is still there."""

REQUEST_SECONDS = 30.0
"""Seconds within which a connection must have sent a whole request (its first or a further one), or it is closed;
aiohttp's own limit is an hour. Time spent writing an answer does not count, and may be unlimited."""

EXTRA_CONNECTIONS = 32
"""Number of websockets, beyond the number of sessions, that are accepted; further ones are refused."""

OTHER_CONNECTIONS = 64
"""Largest number of connections that are not websockets; for one more, the oldest is closed. So newcomers always get
in, and connections that send nothing, or read no answer, do not take all of the process's file descriptors."""

BACKLOG = 32
"""Number of connections that are accepted at once: this many may arrive before the first of them is counted."""

MAX_DOWNLOADS = 2
"""Number of downloads of one visitor, one of each kind, that may be running or waiting; further ones are answered with
429."""

SESSIONS = web.AppKey("sessions", SessionManager)
SOCKETS = web.AppKey("sockets", dict)
"""Websockets and the transport of each."""
DOWNLOADS = web.AppKey("downloads", ThreadPoolExecutor)
"""The executor of downloads. It has one thread: concurrent downloads would take cores from the visitors who drive."""
REFUSED = web.AppKey("refused", set)
"""Largest number of logged reasons for refusals, so that strangers cannot fill the log."""
HEADERS = {
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline'; img-src 'self' data:; connect-src 'self'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


def make_app(
    simulator: Simulator, truth: Truth, max_acting: int | None = None, public_names: Collection[str] = ()
) -> web.Application:
    """The application; it serves as many visitors at once as the simulator has episodes. Of those, `max_acting`
    (default: all) act at once, until `SESSIONS` is told that more can. It answers at localhost, at IP addresses and at
    `public_names`."""
    app = web.Application(client_max_size=LARGEST_MESSAGE, middlewares=[_refuse_other_names(public_names)])
    app[SOCKETS], app[REFUSED] = {}, set()
    app.cleanup_ctx.append(lambda app: _manage_sessions(app, simulator, truth, max_acting))
    about = json.dumps(describe(simulator, truth))
    page = files("experiments.applications.play").joinpath("page.html").read_text(encoding="utf-8")

    async def show(_: web.Request) -> web.Response:
        return web.Response(text=page, content_type="text/html", headers=HEADERS)

    async def robots(_: web.Request) -> web.Response:
        return web.Response(text=about, content_type="application/json", headers=HEADERS)

    app.add_routes([
        web.get("/", show), web.get("/robots", robots), web.get("/drive", _drive),
        web.get("/recording/{token}/{kind}", _recording),
    ])  # fmt: skip
    return app


async def require_free(host: str, port: int) -> None:
    """Raises OSError if `serve` could not listen now."""
    (await asyncio.get_running_loop().create_server(asyncio.Protocol, host, port, start_serving=False)).close()


async def serve(app: web.Application, host: str, port: int, ready: Callable[[int], None]) -> None:
    """Serves until cancelled; `ready` is called with the port, which the system chooses if `port` is 0. Raises OSError
    for a port that is taken."""
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=2.0, keepalive_timeout=REQUEST_SECONDS)
    await runner.setup()
    requests, sockets = runner.server, app[SOCKETS]
    try:
        listening = await asyncio.get_running_loop().create_server(
            lambda: _admit(requests, sockets), host, port, backlog=BACKLOG
        )
        with contextlib.closing(listening):
            ready(listening.sockets[0].getsockname()[1])
            await asyncio.Event().wait()
    finally:
        await runner.cleanup()


def _admit(
    requests: web.Server, sockets: Mapping[web.WebSocketResponse, asyncio.Transport | None]
) -> web.RequestHandler:
    """What answers a new connection. Older ones are closed so that at most OTHER_CONNECTIONS are not websockets."""
    websockets = set(sockets.values())
    others = [c.transport for c in requests.connections if c.transport is not None and c.transport not in websockets]
    for transport in others[: max(0, len(others) + 1 - OTHER_CONNECTIONS)]:  # they are in the order of their arrival
        transport.abort()  # a client that does not read would keep a connection that is closed normally
    return requests()


async def _manage_sessions(
    app: web.Application, simulator: Simulator, truth: Truth, max_acting: int | None
) -> AsyncIterator[None]:
    sessions = app[SESSIONS] = SessionManager(simulator, truth, max_acting)
    downloads = app[DOWNLOADS] = ThreadPoolExecutor(1, "downloads")
    serving = asyncio.create_task(sessions.serve())
    yield
    serving.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await serving
    for socket in list(app[SOCKETS]):
        await socket.close(code=1001)
    sessions.close()
    downloads.shutdown(wait=False, cancel_futures=True)


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
            "deaf": simulator.ignores_actions,
            "truth": truth(robot) is not None and all(start.seed is not None for start in starts),
        })  # fmt: skip
    return described


def _refuse_other_names(public_names: Collection[str]) -> Callable[..., Awaitable[web.StreamResponse]]:
    """A middleware that answers 403 to requests whose Host header has a name that is not this server's.

    Such a name may belong to a hostile page and be made to resolve to this server's address: to the browser both then
    have the same origin, and the page could drive and read what only this computer can reach (DNS rebinding).
    """
    names = {"localhost", *map(name_as_sent, public_names)} - {""}

    @web.middleware
    async def refuse(request: web.Request, handler: Callable[..., Awaitable[web.StreamResponse]]) -> web.StreamResponse:
        host = request.headers.get("Host", "")
        if not (_name_of(host) in names or _is_address(_name_of(host))):
            _log_once(
                request,
                "refused a request to %.80r. If that is a name of this server, start it with --public-name and the name "
                "(docs/simulator.md)",
                host,
            )
            raise web.HTTPForbidden(text="this server does not answer at this name; see --public-name of `hma play`")
        return await handler(request)

    return refuse


def name_as_sent(name: str) -> str:
    """A name as browsers write it in the Host header: in lower case, an international name in ASCII ("xn--..."),
    without the final dot, which has no meaning. Empty for anything that is not a name."""
    try:
        return URL.build(scheme="http", host=name.strip().removesuffix(".")).raw_host or ""
    except ValueError:
        return ""


def _name_of(host: str) -> str:
    """The name or the IP address of a Host header, without its port."""
    name = re.sub(r":\d*$", "", host)
    return name.lower().removesuffix(".")


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name[1:-1] if name.startswith("[") and name.endswith("]") else name)
    except ValueError:
        return False
    return True


def _same_origin(request: web.Request) -> bool:
    """Whether the connecting page came from this server: other pages must not drive what a visitor's browser can
    reach."""
    origin = request.headers.get("Origin")
    return origin is None or origin.partition("://")[2] == request.host  # any text may be sent as an origin


def _log_once(request: web.Request, reason: str, *values: object) -> None:
    if reason not in request.app[REFUSED]:
        request.app[REFUSED].add(reason)
        log.warning(f"{reason}. Further refusals are not logged", *values)


async def _drive(request: web.Request) -> web.StreamResponse:
    sessions, sockets = request.app[SESSIONS], request.app[SOCKETS]
    if not _same_origin(request):
        _log_once(
            request,
            "refused a page of %.80r, which connects to %.80r. If the page is this server's own, behind a proxy, the "
            "proxy must pass the Host header (docs/simulator.md)",
            request.headers["Origin"],
            request.host,
        )
        raise web.HTTPForbidden(text="this page is served elsewhere")
    if len(sockets) >= len(sessions.simulator) + EXTRA_CONNECTIONS:
        raise web.HTTPServiceUnavailable(text="too many connections")
    socket = web.WebSocketResponse(max_msg_size=LARGEST_MESSAGE, heartbeat=HEARTBEAT)
    try:
        await socket.prepare(request)
    except ConnectionError:  # the client is gone; aiohttp would log a fault of the server
        return socket
    sockets[socket] = request.transport
    try:
        visitor = sessions.connect(request.query.get("token"))
        await _serve_connection(sessions, visitor, socket, request.transport)
    except NoFreeSession:
        with contextlib.suppress(ConnectionError):
            await socket.send_str(json.dumps({"type": "full", "message": "all places are taken"}))
        await socket.close(code=1013)
    finally:
        del sockets[socket]
    return socket


async def _serve_connection(
    sessions: SessionManager, visitor: Visitor, socket: web.WebSocketResponse, transport: asyncio.Transport | None
) -> None:
    replies: asyncio.Queue[str] = asyncio.Queue(MAX_PENDING_REPLIES)
    visitor.socket, visitor.transport, visitor.replies = socket, transport, replies
    sending = asyncio.create_task(sessions.send(visitor, socket, replies))
    robot, start = visitor.session.robot, visitor.session.start
    visitor.tell({"type": "hello", "token": visitor.token, "robot": robot.name if robot else None, "start": start})
    try:
        await _receive(sessions, visitor, socket)
    finally:
        sessions.connection_lost(visitor, socket)
        sending.cancel()


async def _receive(sessions: SessionManager, visitor: Visitor, socket: web.WebSocketResponse) -> None:
    faults = 0
    async for message in socket:
        await sessions.wait_for_capacity(visitor)
        if visitor.socket is not socket:  # the session, or the visitor, has another connection
            return
        if message.type != WSMsgType.TEXT or not sessions.submit(visitor, _parsed(message.data)):
            faults += 1
            visitor.tell({"type": "error", "message": "this message is not valid"})
            if faults >= MAX_INVALID_MESSAGES:
                await socket.close(code=1008)
                return


def _parsed(data: str) -> dict:
    """The JSON object in `data`; an empty dict if it is not one."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


async def _recording(request: web.Request) -> web.Response:
    """A download of what a visitor recorded: kind mp4, or rlds as a zip."""
    visitor = request.app[SESSIONS].visitors.get(request.match_info["token"])
    recording = visitor.session.recording if visitor else None  # read once: the simulator's thread may take it away
    recording = recording.copy() if recording else None
    kinds: dict[str, tuple[Callable[[], bytes], str, str]] = {}
    if recording is not None and len(recording) > 1:
        name = made_name(recording.robot.name)
        kinds = {
            "mp4": (recording.video, "video/mp4", f"{name}.mp4"),
            "rlds": (recording.dataset, "application/zip", f"{name}_rlds.zip"),
        }
    if request.match_info["kind"] not in kinds:
        raise web.HTTPNotFound(text="nothing was recorded")
    make, kind, name = kinds[request.match_info["kind"]]
    if visitor.downloads >= MAX_DOWNLOADS:
        raise web.HTTPTooManyRequests(text="earlier downloads of yours are being made; try again when they have come")
    visitor.downloads += 1
    try:
        body = await asyncio.get_running_loop().run_in_executor(request.app[DOWNLOADS], make)
    finally:
        visitor.downloads -= 1
    disposition = f'attachment; filename="{name}"'
    return web.Response(body=body, content_type=kind, headers=HEADERS | {"Content-Disposition": disposition})
