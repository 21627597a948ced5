"""`hma play`: what it asks for, says and answers signals with."""

import contextlib
import errno
import os
import signal
import socket
from dataclasses import replace

import pytest

pytest.importorskip("aiohttp", reason="needs the extra `play`")

from aiohttp.test_utils import TestClient, TestServer
from rich.console import Console

from experiments.applications.play import server
from experiments.cli.main import main
from hma_jax.config import ConfigError, MaskingConfig, TrainConfig, require
from hma_jax.runtime.exits import Exit
from hma_jax.simulator import Simulator
from hma_jax.simulator.folder import DECODE, DEFAULT_DECODE, save_decode
from tests.experiments.applications.serving import no_truth, until
from tests.hma_jax.simulator.small import parts, simulator, start


@pytest.fixture(autouse=True)
def every_address_is_free(monkeypatch):
    """Also those of other computers, and those that somebody listens on."""

    async def free(host, port):
        pass

    monkeypatch.setattr(server, "require_free", free)


@pytest.fixture
def not_warmed_up(monkeypatch):
    """Nobody drives: nothing need be compiled."""
    monkeypatch.setattr("hma_jax.simulator.warm_up.warm_up", lambda *_, **__: None)


def test_the_command_fills_frames_as_the_run_says_unless_it_is_told_otherwise(monkeypatch, tmp_path):
    from experiments import simulators

    asked = []

    def load(*_, decode, **__):
        asked.append(decode.slide)
        raise ConfigError("enough is known")

    monkeypatch.setattr(simulators, "load_simulator", load)
    save_decode(replace(DEFAULT_DECODE, slide="streaming"), tmp_path / DECODE)
    for more in ([], ["--window", "exact"]):
        assert main(["play", str(tmp_path), *more]) == 2
    assert asked == ["streaming", "exact"]


def test_the_command_lets_more_act_at_once_as_they_are_compiled(monkeypatch, tmp_path):
    from experiments import simulators
    from experiments.cli.play import play

    first, compiled = [], []

    async def serve(app, host, port, ready):
        async with TestServer(app):
            first.append((app[server.SESSIONS].max_acting, list(compiled)))
            ready(port)
            await until(lambda: app[server.SESSIONS].max_acting == 2)

    monkeypatch.setattr(Simulator, "compile", lambda _, together: compiled.append(together))
    monkeypatch.setattr(simulators, "load_simulator", lambda *_, episodes, **__: simulator(episodes=episodes))
    monkeypatch.setattr(server, "serve", serve)
    play(tmp_path, visitors=2)
    assert first == [(1, [1])] and compiled == [1, 2]


@pytest.mark.usefixtures("not_warmed_up")
def test_the_command_answers_at_its_host_and_at_the_public_names_that_it_is_given(monkeypatch, tmp_path, capsys):
    from experiments import simulators

    answers = {}

    async def serve(app, host, port, ready):
        async with TestClient(TestServer(app)) as client:
            for name in ("robots.lan:80", "robots.example", "others.example"):
                answers[name] = (await client.get("/robots", headers={"Host": name})).status

    monkeypatch.setattr(simulators, "load_simulator", lambda *_, episodes, **__: simulator(episodes=episodes))
    monkeypatch.setattr(server, "serve", serve)
    command = ["play", str(tmp_path), "--visitors", "1", "--host", "robots.lan", "--public-name"]
    assert main([*command, "robots.example", "--public-name", "third.example"]) == 0
    assert answers == {"robots.lan:80": 200, "robots.example": 200, "others.example": 403}
    for unusable in ("robots.example:80", "robots.example/", "two names", " ", "."):
        assert main([*command, unusable]) == 2
        assert f"a name without scheme and port, got {unusable!r}" in " ".join(capsys.readouterr().err.split())


def test_the_command_names_robots_that_nobody_can_drive(monkeypatch, tmp_path, capsys):
    """Those of a model that robots were added to: there are frames of these alone."""
    from experiments import simulators
    from hma_jax.simulator import warm_up

    model = simulator(episodes=1)
    model.starts = (start(0, 2),)
    first, *others = model.robots
    monkeypatch.setattr(simulators, "load_simulator", lambda *_, **__: model)
    monkeypatch.setattr(warm_up, "warm_up", lambda *_, **__: require(False, "enough is said"))
    assert main(["play", str(tmp_path)]) == 2
    said = " ".join(capsys.readouterr().out.split())
    assert f"not on the page: {', '.join(others)}; this directory has no held-out frames" in said
    assert said.endswith(f"{tmp_path}: {first} compile the simulator ...")


def test_the_command_and_the_page_say_that_a_model_without_actions_follows_none(monkeypatch, tmp_path, capsys):
    from experiments import simulators
    from hma_jax.simulator import warm_up

    monkeypatch.setattr(simulators, "load_simulator", lambda *_, **__: model)
    monkeypatch.setattr(warm_up, "warm_up", lambda *_, **__: require(False, "enough is said"))
    for setting in ("forward", "passive"):
        trained, tokenizer = parts()
        run = replace(trained.run, train=TrainConfig(masking=MaskingConfig(setting=setting)))
        model = Simulator(replace(trained, run=run), tokenizer, starts=[start(0, 2)])
        assert main(["play", str(tmp_path)]) == 2
        said, known = " ".join(capsys.readouterr().out.split()), server.describe(model, no_truth)
        deaf = "note: the model was trained without actions (train.masking.setting passive)" in said
        assert deaf == known[0]["deaf"] == (setting == "passive")


@pytest.mark.usefixtures("not_warmed_up")
@pytest.mark.parametrize(
    ("host", "said"),
    [
        ("127.0.0.1", "localhost:8765 (end"),
        ("::1", "[::1]:8765 (end"),
        ("::", "localhost:8765, from other computers at this one's address (end"),
        ("0.0.0.0", "localhost:8765, from other computers at this one's address (end"),
        ("robots.lan", "robots.lan:8765 (end"),
    ],
)
def test_the_address_that_it_prints_can_be_opened(host, said, monkeypatch, tmp_path, capsys):
    from experiments import simulators

    async def serve(app, host, port, ready):
        ready(port)

    monkeypatch.setattr(simulators, "load_simulator", lambda *_, episodes, **__: simulator(episodes=episodes))
    monkeypatch.setattr(server, "serve", serve)
    assert main(["play", str(tmp_path), "--visitors", "1", "--host", host]) == 0
    assert f"drive it at http://{said}" in " ".join(capsys.readouterr().out.split())


@pytest.mark.usefixtures("not_warmed_up")
def test_a_place_where_nobody_can_listen_may_be_the_fault_of_either_option(monkeypatch, tmp_path, capsys):
    """An unknown host was told to choose another port."""
    from experiments import simulators

    async def serve(*_):
        raise OSError(-2, "Name or service not known")

    monkeypatch.setattr(simulators, "load_simulator", lambda *_, episodes, **__: simulator(episodes=episodes))
    monkeypatch.setattr(server, "serve", serve)
    assert main(["play", str(tmp_path), "--visitors", "1", "--host", "nosuchhost"]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "nosuchhost:" in said and "Name or service not known; choose another --host or --port" in said


@pytest.mark.usefixtures("not_warmed_up")
def test_an_output_that_is_closed_is_no_fault_of_host_or_port(monkeypatch, tmp_path):
    """The command ended with 2, as for wrong arguments, after which a scheduler does not start it again."""
    from experiments import simulators
    from experiments.cli import play as command

    def closed(*_, **__):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    async def serve(app, host, port, ready):
        monkeypatch.setattr(Console, "print", closed)
        ready(port)

    monkeypatch.setattr(simulators, "load_simulator", lambda *_, episodes, **__: simulator(episodes=episodes))
    monkeypatch.setattr(server, "serve", serve)
    with pytest.raises(BrokenPipeError, match="standard output"):
        command.play(tmp_path, visitors=1)


@pytest.mark.usefixtures("ascii_locale")
def test_the_page_is_read_in_any_locale():
    """The server ended after minutes of compiling, or its page had other characters."""
    server.make_app(simulator(), no_truth)


def test_a_taken_port_is_said_before_anything_is_loaded(monkeypatch, tmp_path, capsys):
    """It was said after minutes of compiling."""
    from experiments import simulators

    monkeypatch.undo()  # addresses are asked for
    monkeypatch.setattr(simulators, "load_simulator", lambda *_, **__: pytest.fail("it loads"))
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["play", str(tmp_path), "--port", str(port)]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"cannot listen on 127.0.0.1:{port}: " in said and "choose another --host or --port" in said


@pytest.mark.usefixtures("not_warmed_up")
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, Exit.INTERRUPTED), (signal.SIGTERM, Exit.STOPPED)])
def test_a_signal_ends_the_command_with_its_code_and_a_true_word(number, code, monkeypatch, tmp_path, capsys):
    from experiments import simulators

    async def serve(app, host, port, ready):
        ready(port)
        os.kill(os.getpid(), number)

    monkeypatch.setattr(simulators, "load_simulator", lambda *_, episodes, **__: simulator(episodes=episodes))
    monkeypatch.setattr(server, "serve", serve)
    assert main(["play", str(tmp_path), "--visitors", "1"]) == code
    assert capsys.readouterr().err.endswith("; the same command begins anew\n")


def test_a_request_to_stop_that_was_lost_while_it_compiled_is_obeyed_before_it_serves(monkeypatch, tmp_path):
    from experiments import simulators
    from hma_jax.simulator import warm_up

    def lost(*_, **__):
        with contextlib.suppress(KeyboardInterrupt):  # as in a library's callback
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(simulators, "load_simulator", lambda *_, episodes, **__: simulator(episodes=episodes))
    monkeypatch.setattr(warm_up, "warm_up", lost)
    monkeypatch.setattr(server, "serve", lambda *_: pytest.fail("it serves"))
    assert main(["play", str(tmp_path)]) == Exit.STOPPED
