"""`hma play`: a page on which you drive a trained model."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, UseAppendAction, arg

from experiments.applications import DRIVEN
from experiments.study_setup import UNSET
from experiments.terminal.progress import console, say, step
from experiments.terminal.words import few
from hma_jax.config import ConfigError, ExecutionConfig, require
from hma_jax.runtime.exits import raise_pending_stop

if TYPE_CHECKING:
    from data_pipelines.true_simulator import TrueSimulator
    from hma_jax.simulator.robots import Robot

EVERYWHERE = ("0.0.0.0", "::")
"""Addresses that stand for all addresses of this computer; a browser cannot be sent to them."""


def play(
    run: Annotated[Positional[Path], arg(metavar="RUN")] = DRIVEN,
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1",
    port: int = 8765,
    public_name: Annotated[UseAppendAction[tuple[str, ...]], arg(name="public-name", metavar="NAME"), UNSET] = (),
    visitors: int = 4,
    window: Annotated[Literal["exact", "streaming"] | None, arg(metavar="{exact,streaming}"), UNSET] = None,
    unmask_steps: Annotated[int | None, arg(name="unmask-steps", metavar="M"), UNSET] = None,
    temperature: Annotated[float | None, UNSET] = None,
    tokenizer: Annotated[Path | None, arg(metavar="DIR"), UNSET] = None,
) -> None:
    """Serve a web page on which you drive a trained model with keys, gamepad or sliders.

    Needs the extra `play`. Runs until it is interrupted, and then ends with exit code 130 (SIGTERM: 143).
    docs/simulator.md describes the page.

    Args:
        run: Directory of a training run.
        host: Address to listen on. 127.0.0.1: for this computer only; 0.0.0.0: for everybody who can reach it.
        port: Port to listen on; 0 takes a free one.
        public_name: A name, without port, by which browsers reach this server through a proxy, a tunnel or a network;
            repeat the option for further ones. It refuses requests for any name except these, localhost and --host; it
            always answers requests for IP addresses.
        visitors: How many people can drive at the same time, in one batch.
        window: How to continue when the episode is longer than the model's window: exact computes the window again for
            every frame; streaming is faster, but may stop following commands (docs/endurance_small.md). Default: as
            in RUN/decode.json, or exact.
        unmask_steps: Unmasking steps per frame; more are slower. Default: as in RUN/decode.json, or 2.
        temperature: Temperature at which tokens or latents are sampled; 0 takes the most likely ones. Default: as in
            RUN/decode.json, or 0.
        tokenizer: Directory of the tokenizer that the model was trained with, if it is not beside RUN.
    """
    try:
        from experiments.applications.play.server import SESSIONS, make_app, name_as_sent, require_free, serve
    except ModuleNotFoundError as error:
        if error.name != "aiohttp":
            raise
        raise ConfigError("the page needs aiohttp: pip install 'hma-jax[play]'") from error
    from experiments.simulators import (
        DEAF,
        in_suite,
        load_simulator,
        mark_absolute_actions,
        true_simulator,
    )
    from hma_jax.simulator.folder import change_decode, find_decode
    from hma_jax.simulator.warm_up import warm_up, warm_up_more

    require(
        run != DRIVEN or run.is_dir(),
        f"there is no model at {DRIVEN}: give the directory of a run, or train one with "
        "`hma train --preset play --out runs/play` and serve it with `hma play runs/play/model`",
    )
    require(0 <= port < 65536, f"--port must lie in 0..65535, got {port}")
    for name in public_name:
        require(bool(name_as_sent(name)), f"--public-name takes a name without scheme and port, got {name!r}")
    require(visitors >= 1, f"--visitors must be at least 1, got {visitors}")
    decode = change_decode(find_decode(run), temperature, slide=window, unmask_steps=unmask_steps)
    with _listening_at(host, port):
        asyncio.run(require_free(host, port))
    simulator = load_simulator(
        run, tokenizer=tokenizer, execution=ExecutionConfig(remat="none"), episodes=visitors, decode=decode
    )
    mark_absolute_actions(simulator, run)
    begins = {start.robot for start in simulator.starts}
    if missing := [name for name in simulator.robots if name not in begins]:
        say(
            f"note: not on the page: {few(missing)}; this directory has no held-out frames of them to start from. This is "
            "so for robots that the model already knew when `hma adapt` added others"
        )
    if simulator.ignores_actions:
        say(f"note: {DEAF}")
    say(f"{run}: {few([name for name in simulator.robots if name in begins])}")
    with step("compile the simulator") as progress:
        warm_up(simulator, together=1, progress=progress)
    raise_pending_stop()

    def truth(robot: Robot) -> TrueSimulator | None:
        # The renderer of a physics simulator belongs to one thread, but turns are taken in several.
        return true_simulator(simulator, [robot]) if in_suite(robot) else None

    app, ended = make_app(simulator, truth, max_acting=1, public_names=(host, *public_name)), threading.Event()

    def reached(together: int) -> None:
        app[SESSIONS].max_acting = together

    # It is joined at the end, after at most one more program: the interpreter cannot exit while a thread compiles.
    compiling = threading.Thread(
        target=warm_up_more, args=(simulator, 1), kwargs={"ended": ended.is_set, "reached": reached}
    )

    def ready(actual: int) -> None:
        shown = "localhost" if host in ("127.0.0.1", *EVERYWHERE) else host
        others = ", from other computers at this one's address" if host in EVERYWHERE else ""
        say(f"drive it at http://{_place(shown, actual)}{others} (end with Ctrl-C)")
        if visitors > 1:  # in the background: until programs for several visitors are compiled, they take turns
            compiling.start()

    try:
        with _listening_at(host, port):
            asyncio.run(serve(app, host, port, ready))
    except KeyboardInterrupt:
        if compiling.is_alive():
            console.print("stopping, as soon as the running compilation is finished")
        raise
    finally:
        ended.set()


@contextmanager
def _listening_at(host: str, port: int) -> Iterator[None]:
    """If the system does not let the block listen, raises an error that names host and port. Errors that name a file,
    such as a closed or full standard output, are no fault of theirs."""
    try:
        yield
    except OSError as error:
        if error.filename is not None:
            raise
        raise ConfigError(
            f"cannot listen on {_place(host, port)}: {error.strerror}; choose another --host or --port"
        ) from error


def _place(host: str, port: int) -> str:
    """Host and port as in a URL, where an IPv6 address is in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
