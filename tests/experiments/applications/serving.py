"""A page's server around the tiny simulator of `tests.hma_jax.simulator.small`, in this process."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from typing import Any

from aiohttp import ClientWebSocketResponse, TCPConnector, WSMsgType
from aiohttp.test_utils import TestClient, TestServer

from experiments.applications.play.requests import Truth
from experiments.applications.play.server import make_app
from hma_jax.simulator.warm_up import warm_up
from tests.hma_jax.simulator.small import simulator, start

SECONDS = 120.0
"""That any answer may take on a busy machine."""


def no_truth(_: Any) -> None:
    return None


def serving(
    test: Callable[[TestClient], Awaitable[None]],
    *,
    visitors: int = 2,
    truth: Truth = no_truth,
    max_acting: int | None = None,
    public_names: Sequence[str] = (),
    run: Callable[[Coroutine[Any, Any, None]], None] = asyncio.run,
) -> None:
    """Runs `test` with a client of a server for so many visitors, `max_acting` of whom act at once, by `run`."""
    sim = simulator(episodes=visitors)
    warm_up(sim)  # nobody waits for the compiler
    sim.starts = tuple(start(robot, 2, seed) for robot in (0, 1) for seed in range(2))

    async def main() -> None:
        app = make_app(sim, truth, max_acting, public_names)
        async with TestClient(TestServer(app), connector=TCPConnector(limit=0)) as client:
            await asyncio.wait_for(test(client), 4 * SECONDS)

    run(main())


async def hear(socket: ClientWebSocketResponse) -> dict[str, Any]:
    """The next message, but for words that one is worked on; {"type": "closed"} where there is none any more."""
    while True:
        message = await asyncio.wait_for(socket.receive(), SECONDS)
        if message.type in (WSMsgType.CLOSE, WSMsgType.CLOSING, WSMsgType.CLOSED, WSMsgType.ERROR):
            return {"type": "closed"}
        if (heard := json.loads(message.data))["type"] != "working":
            return heard


async def ask(socket: ClientWebSocketResponse, **message: Any) -> dict[str, Any]:
    await socket.send_str(json.dumps(message))
    return await hear(socket)


async def until(true) -> None:
    """Waits for it, not forever."""
    for _ in range(int(SECONDS * 100)):
        if true():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("it never was")


class Player:
    """A visitor who begins an episode and drives."""

    def __init__(self, client: TestClient):
        self.client = client

    async def enter(self, robot: str = "arm", token: str = "", seed: int = 5, begin: bool = True) -> dict[str, Any]:
        self.socket = await self.client.ws_connect("/drive", params={"token": token} if token else {})
        hello = await hear(self.socket)
        if hello["type"] == "hello":
            self.token = hello["token"]
            if begin:
                await ask(self.socket, type="start", robot=robot, start=0, seed=seed)
        return hello

    async def drive(self, value: float, frames: int, dim: int = 7) -> list[str]:
        """The pictures of so many frames under one action."""
        answers = [await ask(self.socket, type="act", action=[value] * dim) for _ in range(frames)]
        assert all(a["type"] == "frame" for a in answers), answers
        return [a["image"] for a in answers]
