"""The page's server: who visits it, well-behaved or not."""

import asyncio
import contextlib
import json
import resource
import socket
import struct
import threading
import time
from copy import copy
from dataclasses import replace

import jax
import numpy as np
import pytest

pytest.importorskip("aiohttp", reason="needs the extra `play`")

from aiohttp import ClientError, ClientSession

from experiments.applications.play import server
from experiments.applications.play import sessions as sessions_module
from experiments.applications.play.requests import Session
from experiments.applications.play.sessions import MAX_PENDING_REPLIES, Visitor
from hma_jax.config import require
from tests.experiments.applications.serving import SECONDS, Player, ask, hear, no_truth, serving, until
from tests.hma_jax.simulator.small import simulator, start


def test_the_page_and_what_it_must_know_are_served():
    async def test(client):
        page = await (await client.get("/")).text()
        assert "<!doctype html>" in page and "http" + "://" not in page.replace("connect-src", ""), (
            "it needs nothing from elsewhere"
        )
        robots = await (await client.get("/robots")).json()
        assert [(r["name"], len(r["starts"]), len(r["dimensions"]), r["truth"]) for r in robots] == [
            ("pusher", 2, 2, False),
            ("arm", 2, 7, False),
        ]
        assert robots[0]["starts"][0].startswith("data:image/jpeg")

    serving(test)


def test_two_visitors_do_not_mix():
    async def test(client):
        alone, first, second = Player(client), Player(client), Player(client)
        await alone.enter(seed=1)
        wanted = await alone.drive(0.5, 6)
        await alone.socket.close()
        await first.enter(seed=1)
        await second.enter(seed=2)
        one, other = await asyncio.gather(first.drive(0.5, 6), second.drive(0.3, 6))
        assert one == wanted, "the other's actions reached it"
        assert other != one

    serving(test)


def test_a_lost_connection_finds_its_episode_again():
    async def test(client):
        player, other, again = Player(client), Player(client), Player(client)
        await player.enter()
        await player.drive(0.5, 2)
        player.socket._response.connection.transport.abort()  # without a word
        gone = client.server.app[server.SESSIONS].visitors[player.token]
        await until(lambda: gone.socket is None)
        gone.active -= 86_400  # for as long as nobody needs the place
        await other.enter()
        await other.drive(0.5, 1)
        hello = await again.enter(token=player.token, begin=False)
        assert (hello["token"], hello["robot"]) == (player.token, "arm")
        frame = await ask(again.socket, type="rewind", frames=0)
        assert frame["count"] == 4
        assert len(await again.drive(0.5, 1)) == 1

    serving(test)


def test_a_second_window_takes_over_and_the_first_is_told():
    async def test(client):
        first, second = Player(client), Player(client)
        await first.enter()
        await first.drive(0.5, 1)
        assert (await second.enter(token=first.token, begin=False))["token"] == first.token
        assert (await hear(first.socket))["type"] == "gone", "or it would come back and take over again"
        assert (await hear(first.socket))["type"] == "closed"
        assert len(await second.drive(0.5, 1)) == 1

    serving(test)


def test_what_the_first_window_asked_for_is_not_answered_to_the_second():
    async def test(client):
        first, second = Player(client), Player(client)
        await first.enter()
        sessions, begun, go_on = client.server.app[server.SESSIONS], threading.Event(), threading.Event()
        step, requests = sessions.simulator.step, sessions.visitors[first.token].requests
        sessions.simulator.step = lambda actions: (begun.set(), go_on.wait(SECONDS), step(actions))[-1]
        for _ in range(2 * sessions_module.MAX_PENDING_REQUESTS):  # one under way, some that wait, the rest unread
            await first.socket.send_str(json.dumps({"type": "act", "action": [0.5] * 7}))
        await until(lambda: begun.is_set() and len(requests) >= sessions_module.MAX_PENDING_REQUESTS - 1)
        await second.enter(token=first.token, begin=False)
        await until(lambda: len(client.server.app[server.SOCKETS]) == 1)  # nobody listens to the first window any more
        go_on.set()
        frame = await ask(second.socket, type="rewind", frames=0)
        assert frame["after"] == "rewind" and frame["count"] == 3, "the one under way was made, for nobody"

    serving(test)


def test_as_many_act_at_once_as_programs_are_compiled_for_and_all_take_turns():
    async def test(client):
        sessions, at_once = client.server.app[server.SESSIONS], []
        step = sessions.simulator.step

        def counted(actions):
            at_once.append(sum(a is not None for a in actions))
            time.sleep(0.05)
            return step(actions)

        sessions.simulator.step = counted
        greedy, player = Player(client), Player(client)
        await greedy.enter()
        await player.enter()
        for _ in range(40):
            await greedy.socket.send_str(json.dumps({"type": "act", "action": [0.5] * 7}))
        await player.drive(0.5, 3)
        assert set(at_once) == {1} and len(at_once) < 30, "the greedy one waits for its turn too"
        sessions.max_acting = 2
        await player.drive(0.5, 3)
        assert max(at_once) == 2

    serving(test, max_acting=1)


def test_after_a_fault_of_the_device_all_begin_again_and_drive_on(monkeypatch):
    async def test(client):
        first, second = Player(client), Player(client)
        await first.enter()
        await second.enter()
        simulator = client.server.app[server.SESSIONS].simulator

        def failing(weights, state, *_):
            jax.tree.map(lambda x: x.delete(), state)  # as donating does
            raise RuntimeError("RESOURCE_EXHAUSTED")

        with monkeypatch.context() as broken:
            broken.setattr(simulator, "_programs", copy(simulator._programs))  # other tests share them
            broken.setattr(simulator._programs, "advance", failing)
            told = await ask(first.socket, type="act", action=[0.5] * 7)
        assert told["type"] == "error" and "start the episode again" in told["message"]
        await ask(first.socket, type="start", robot="arm")
        told = await asyncio.gather(
            ask(first.socket, type="act", action=[0.5] * 7), ask(second.socket, type="act", action=[0.5] * 7)
        )
        assert [t["type"] for t in told] == ["frame", "error"] and "begin an episode" in told[1]["message"]
        again = Player(client)
        assert (await again.enter(token=second.token))["robot"] is None, "the page begins one by itself then"
        assert len(await again.drive(0.5, 1)) == 1

    serving(test)


class FakeTruth:
    """A true simulator whose frames are as bright as the steps it made; a pusher's cannot begin."""

    def __init__(self, robot):
        self.robot = robot

    def reset(self, start):
        require(self.robot.name == "arm", "no true simulator begins there")
        self.made = [0]

    def step(self, chunks):
        assert [c.shape[-1] for c in chunks] == [self.robot.action_dim]
        self.made.append(self.made[-1] + 1)

    def rewind(self, frames):
        del self.made[len(self.made) - frames :]

    def max_rewind(self, _):
        return len(self.made) - 1

    @property
    def images(self):
        return np.full((1, 8, 8, 3), 40 * self.made[-1], np.uint8)


def test_the_true_simulator_goes_along_and_a_start_that_fails_changes_nothing():
    async def test(client):
        player = Player(client)
        await player.enter()
        begun = await ask(player.socket, type="truth", on=True)
        assert begun["count"] == 2 and "psnr" in begun
        assert begun["reach"] == 0, "nothing can be rewound beside it"
        first, second = [await ask(player.socket, type="act", action=[0.5] * 7) for _ in range(2)]
        assert len({begun["true"], first["true"], second["true"]}) == 3 and second["reach"] == 2
        back = await ask(player.socket, type="rewind", frames=9)
        assert (back["count"], back["true"]) == (2, begun["true"]), "no further than both can"
        failed = await ask(player.socket, type="start", robot="pusher", start=0)
        assert failed["type"] == "error" and "no true simulator begins there" in failed["message"]
        on = await ask(player.socket, type="act", action=[0.5] * 7)
        assert (on["type"], on["true"], on["count"]) == ("frame", first["true"], 3)
        assert "true" not in await ask(player.socket, type="truth", on=False)

    serving(test, truth=FakeTruth)


def test_rewinding_and_the_same_actions_give_the_same_frames():
    async def test(client):
        player = Player(client)
        await player.enter()
        made = await player.drive(0.5, 6)
        frame = await ask(player.socket, type="rewind", frames=4)
        assert frame["image"] == made[1] and frame["count"] == 4
        assert await player.drive(0.5, 4) == made[2:]
        assert (await ask(player.socket, type="rewind", frames=100))["count"] == 1

    serving(test)


def test_a_robot_that_went_back_is_told_where_it_was_sent_then():
    async def test(client):
        sessions, player = client.server.app[server.SESSIONS], Player(client)
        sessions.simulator.update_robots([replace(sessions.simulator.robots["arm"], keeps=True)])
        await player.enter()
        for value in (0.4, 0.5, 0.6):
            frame = await ask(player.socket, type="act", action=[value] * 7)
        assert "command" not in frame
        back = await ask(player.socket, type="rewind", frames=1)
        assert back["command"] == pytest.approx([0.5] * 7)
        begun = await ask(player.socket, type="truth", on=True)
        (arm, _) = [s.actions[-1] for s in sessions.simulator.starts if s.robot == "arm"]
        assert begun["command"] == pytest.approx(arm, abs=1e-6)
        await player.drive(0.6, 1)
        assert "command" not in await ask(player.socket, type="truth", on=False), "it stays where it is"
        await player.enter(robot="pusher", token=player.token)
        await player.drive(0.6, 1, dim=2)
        assert (await ask(player.socket, type="rewind", frames=0))["command"] == [0.0, 0.0], "its rest"

    serving(test, truth=FakeTruth)


def test_a_full_house_says_so_and_an_abandoned_seat_is_given_away():
    async def test(client):
        first, second, third = Player(client), Player(client), Player(client)
        await first.enter()
        await second.enter()
        assert (await third.enter())["type"] == "full"
        await second.socket.close()
        await asyncio.sleep(0.05)
        assert (await third.enter())["type"] == "hello"
        assert len(await first.drive(0.5, 1)) == 1

    serving(test)


NONSENSE = [
    "", "{", "[]", "null", "7", '"act"', "[" * 20000, '{"type": 3}', '{"type": "shutdown"}', '{"type": ["act"]}',
    '{"type": "act"}', '{"type": "act", "action": "all"}', '{"type": "act", "action": [1, 2]}',
    '{"type": "act", "action": [[1]]}', '{"type": "act", "action": [NaN, NaN, NaN, NaN, NaN, NaN, NaN]}',
    '{"type": "act", "action": [1e999, 0, 0, 0, 0, 0, 0]}', '{"type": "act", "action": [true, 0, 0, 0, 0, 0, 0]}',
    '{"type": "start"}', '{"type": "start", "robot": "walker"}', '{"type": "start", "robot": {}}',
    '{"type": "start", "robot": "arm", "start": 99}', '{"type": "start", "robot": "arm", "start": -1}',
    '{"type": "start", "robot": "arm", "seed": 1e300}', '{"type": "rewind", "frames": -5}', '{"type": "rewind", "frames": "x"}',
    '{"type": "truth", "on": true}', '{"type": "truth"}', '{"type": "truth", "on": "no"}', '{"type": "record", "on": 0}',
    '{"type": "act", "action": [1' + "0" * 400 + ", 0, 0, 0, 0, 0, 0]}",
]  # fmt: skip


def test_malformed_messages_are_errors_of_their_sender_alone(monkeypatch):
    monkeypatch.setattr(server, "MAX_INVALID_MESSAGES", 1000)

    async def test(client):
        hostile, player = Player(client), Player(client)
        await hostile.enter()
        await player.enter()
        for text in NONSENSE:
            await hostile.socket.send_str(text)
            answer = await hear(hostile.socket)
            assert answer["type"] == "error" and len(json.dumps(answer)) < 5000, (text, answer)
            if "0, 0, 0]" in text and "true" not in text:
                assert "finite numbers, from -3e+38 to 3e+38" in answer["message"], (text, answer)
            if '"on"' in text and "true}" not in text:
                assert '"on" must be true or false' in answer["message"], (text, answer)
        await hostile.socket.send_bytes(b"\0" * 100)
        assert (await hear(hostile.socket))["type"] == "error"
        assert len(await player.drive(0.5, 2)) == len(await hostile.drive(0.5, 2)) == 2

    serving(test)


def test_whoever_sends_only_nonsense_is_let_go():
    async def test(client):
        hostile, player = Player(client), Player(client)
        await hostile.enter()
        await player.enter()
        for _ in range(server.MAX_INVALID_MESSAGES):
            await hostile.socket.send_str("?")
        answers = [await hear(hostile.socket) for _ in range(server.MAX_INVALID_MESSAGES + 1)]
        assert answers[-1]["type"] == "closed"
        assert len(await player.drive(0.5, 2)) == 2

    serving(test)


def test_a_huge_message_ends_its_connection_and_nothing_else():
    async def test(client):
        hostile, player = Player(client), Player(client)
        await hostile.enter()
        await player.enter()
        with contextlib.suppress(ConnectionError):  # it may be over before all is sent
            await hostile.socket.send_str(json.dumps({"type": "act", "action": [0.0] * 10**6}))
        assert (await hear(hostile.socket))["type"] == "closed"
        assert len(await player.drive(0.5, 2)) == 2

    serving(test)


@pytest.mark.parametrize("many", [150, pytest.param(1000, marks=pytest.mark.slow)])
def test_many_connections_are_refused_and_the_visitor_plays_on(monkeypatch, many):
    monkeypatch.setattr(server, "EXTRA_CONNECTIONS", 3)
    files, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    if files < 2 * many + 200:  # both ends of every connection are in this process
        resource.setrlimit(resource.RLIMIT_NOFILE, (2 * many + 200, most))

    async def test(client):
        player = Player(client)
        await player.enter()

        async def knock():
            try:
                socket = await client.ws_connect("/drive")
            except Exception as refusal:
                return getattr(refusal, "status", type(refusal).__name__)
            return (await hear(socket))["type"]

        knocks = asyncio.gather(*(knock() for _ in range(many)))
        pictures = await player.drive(0.5, 5)
        answers = await knocks
        assert len(pictures) == 5 and answers.count("hello") == 1
        assert set(answers) <= {"hello", "full", 503} and 503 in answers, set(answers)
        assert len(await player.drive(0.5, 2)) == 2

    serving(test)


def listening(test, monkeypatch) -> None:
    """Runs `test(port, player, connections)` against `serve`. The player is in; `connections()` are the open ones."""
    runners, make = [], server.web.AppRunner
    monkeypatch.setattr(server.web, "AppRunner", lambda *what, **how: runners.append(make(*what, **how)) or runners[-1])

    def connections():
        return [c for c in runners[0].server.connections if c.transport is not None]

    async def main() -> None:
        sim, ports = simulator(), asyncio.Queue()
        sim.starts = (start(0, 2),)
        serve = asyncio.create_task(server.serve(server.make_app(sim, no_truth), "127.0.0.1", 0, ports.put_nowait))
        port = await asyncio.wait_for(ports.get(), SECONDS)
        async with ClientSession("http" + f"://127.0.0.1:{port}") as client:
            player = Player(client)
            await player.enter("pusher")
            await test(port, player, connections)
            assert (await ask(player.socket, type="act", action=[0.0, 0.0]))["type"] == "frame"
        serve.cancel()
        await asyncio.gather(serve, return_exceptions=True)

    asyncio.run(main())


def test_a_request_that_is_never_finished_ends_its_connection_and_a_visitor_who_waits_stays(monkeypatch):
    """Each kept its connection for an hour: as many as the process may have kept everybody out."""
    monkeypatch.setattr(server, "REQUEST_SECONDS", 0.3)

    async def test(port, player, _):
        for half in (
            b"",
            b"GET / HTTP/1.1\r\nHost: localhost\r\n",
            b"GET /robots HTTP/1.1\r\nHost: localhost\r\n\r\nGET",
        ):
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(half)
            await asyncio.wait_for(reader.read(), 10)  # to its end
            writer.close()

    listening(test, monkeypatch)


def test_answers_that_nobody_reads_keep_no_newcomer_out(monkeypatch):
    """They keep their connections for ever: aiohttp's limits do not hold while an answer is being written."""
    monkeypatch.setattr(server, "OTHER_CONNECTIONS", 5)

    async def test(port, player, connections):
        loop, held = asyncio.get_running_loop(), contextlib.ExitStack()
        with held:
            for _ in range(25):
                connection = held.enter_context(socket.socket())
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
                connection.setblocking(False)
                await loop.sock_connect(connection, ("127.0.0.1", port))
                await loop.sock_sendall(connection, b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" * 200)
            async with ClientSession("http" + f"://127.0.0.1:{port}") as newcomer, newcomer.get("/") as answer:
                assert "<!doctype html>" in await asyncio.wait_for(answer.text(), 10)
                assert len(connections()) <= 5 + 1, "those and the visitor's"

    listening(test, monkeypatch)


def test_whoever_vanishes_while_connecting_leaves_nothing_in_the_log(caplog):
    """A page that is loaded again, say, or a scanner of ports."""

    def knock_and_vanish(port):
        with socket.create_connection(("127.0.0.1", port)) as connection:
            connection.sendall(
                b"GET /drive HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
            )
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # no farewell

    async def test(client):
        app, asked = client.server.app, []
        sessions, sockets = app[server.SESSIONS], app[server.SOCKETS]
        connect = sessions.connect

        def vanishing(token):
            asked.append(token)
            list(sockets.values())[-1].abort()
            return connect(token)

        async def vanish():
            before = len(client.server.handler.connections)
            for _ in range(3):
                knock_and_vanish(client.port)
            await asyncio.sleep(0.05)
            await until(lambda: len(client.server.handler.connections) <= before)
            before = len(sockets)
            sessions.connect = vanishing
            with contextlib.suppress(ClientError):
                await hear(await client.ws_connect("/drive"))
            sessions.connect = connect
            await until(lambda: len(sockets) <= before)

        first, second = Player(client), Player(client)
        await first.enter()
        await vanish()
        await second.enter()
        await vanish()  # all places are taken
        assert len(asked) == 2
        assert len(await first.drive(0.5, 1)) == len(await second.drive(0.5, 1)) == 1

    serving(test)
    assert not [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]


def test_one_who_never_reads_is_let_go_and_others_play_on(monkeypatch):
    monkeypatch.setattr(sessions_module, "SEND_SECONDS", 0.2)

    async def test(client):
        silent, player = Player(client), Player(client)
        await silent.enter()
        await player.enter()
        sessions = client.server.app[server.SESSIONS]
        visitor = sessions.visitors[silent.token]

        async def stuck(_):
            await asyncio.sleep(3600)

        monkeypatch.setattr(visitor.socket, "send_str", stuck)  # as when the buffers of both ends are full
        await silent.socket.send_str(json.dumps({"type": "act", "action": [0.5] * 7}))
        assert len(await player.drive(0.5, 3)) == 3
        for _ in range(100):
            if visitor.socket is None:
                break
            await asyncio.sleep(0.05)
        assert visitor.socket is None, "its connection is still there"

    serving(test)


def test_replies_that_wait_are_bounded():
    visitor = Visitor("t", Session(0), replies=asyncio.Queue(MAX_PENDING_REPLIES))
    for i in range(MAX_PENDING_REPLIES):
        visitor.tell({"i": i})
    assert visitor.replies is not None
    visitor.tell({"i": "one more"})
    assert visitor.replies is None


def test_requests_that_wait_are_bounded():
    async def test(client):
        player = Player(client)
        await player.enter()
        waiting = client.server.app[server.SESSIONS].visitors[player.token].requests
        for _ in range(60):
            await player.socket.send_str(json.dumps({"type": "act", "action": [0.5] * 7}))
        counts = []
        for _ in range(60):
            counts.append((await hear(player.socket))["count"])
            assert len(waiting) <= sessions_module.MAX_PENDING_REQUESTS
        assert counts == list(range(3, 63)), "none is lost, and they stay in order"

    serving(test)


def test_a_page_from_elsewhere_cannot_connect_and_the_log_says_so_once(caplog):
    async def test(client):
        for origin in ("elsewhere.example", "elsewhere.example:80", "["):
            answer = await client.get("/drive", headers={"Origin": "http" + f"://{origin}"})
            assert answer.status == 403
        [said] = [record.getMessage() for record in caplog.records if "refused" in record.message]
        assert "://elsewhere.example'" in said and f"'127.0.0.1:{client.port}'" in said

    serving(test)


def test_a_page_whose_name_was_rebound_to_this_server_reaches_nothing(caplog):
    """Its server's name resolves to this one's address: for the browser it is of the same origin."""

    async def test(client):
        for path in ("/", "/robots", "/drive", "/recording/token/mp4", "/nothing"):
            for host in ("rebound.example:8765", "127.0.0.1.example", "localhost.example", "[::1].example", "", "a b"):
                answer = await client.get(path, headers={"Host": host, "Origin": "http" + f"://{host}"})
                text = await answer.text()
                assert answer.status == 403 and "--public-name" in text, (path, host, text)
        [said] = [record.getMessage() for record in caplog.records if "refused" in record.message]
        assert "'rebound.example:8765'" in said and "--public-name" in said

    serving(test, public_names=("", "a b"))


def test_addresses_this_computer_and_names_that_were_given_are_answered():
    hosts = [
        "localhost",
        "LOCALHOST:8765",
        "127.0.0.1:1",
        "[::1]:8765",
        "10.0.0.7",
        "Robots.example",
        "robots.example.:1",
        "xn--mller-kva.example:80",
        "box.example",
    ]

    async def test(client):
        answers = [await client.get("/robots", headers={"Host": host}) for host in hosts]
        assert [a.status for a in answers] == [200] * len(hosts)

    serving(test, public_names=("robots.EXAMPLE", "Müller.example", " box.example."))
