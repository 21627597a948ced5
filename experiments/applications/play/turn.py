"""One round of visitors' wishes, answered with one batch: the part that computes, in a thread of its own."""

from __future__ import annotations

import base64
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from data_pipelines.sources.rlds.writer import encode_jpeg
from data_pipelines.true_simulator import TrueSimulator
from experiments.applications.play.recording import Recording
from hma_jax.config import ConfigError, require
from hma_jax.evaluation.metrics import psnr
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator

Kind = Literal["start", "act", "rewind", "record", "truth"]
Message = dict[str, Any]

Truth = Callable[[Robot], TrueSimulator | None]
"""The true simulator of a robot, where there is one."""


LARGEST = 3e38
"""Number of an action: single precision holds it."""

VALUES = 4096
"""Of an action, at most."""


@dataclass(frozen=True)
class Wish:
    """What a visitor asked for, checked for its form only."""

    kind: Kind
    values: Message
    at: float = field(default_factory=time.perf_counter)


@dataclass
class Seat:
    """A visitor's episode of the simulator, and what belongs to it."""

    episode: int
    robot: Robot | None = None
    start: int = 0
    truth: TrueSimulator | None = None
    recording: Recording | None = None
    recorded: bool = False  # frames are being added to it


def answer(simulator: Simulator, truth: Truth, wishes: Mapping[int, tuple[Seat, Wish]]) -> dict[int, Message]:
    """What each visitor is told. A wish that cannot be granted is an error of that visitor's alone."""
    replies: dict[int, Message] = {}
    acting: dict[int, np.ndarray] = {}
    for visitor, (seat, wish) in wishes.items():
        try:
            if wish.kind == "act":
                require(seat.robot is not None, "begin an episode first")
                acting[visitor] = seat.robot.chunk(numbers(wish.values.get("action")))
            else:
                CHANGES[wish.kind](simulator, truth, seat, wish.values)
                replies[visitor] = frame_of(simulator, seat, wish)
        except ConfigError as error:
            replies[visitor] = error_of(error, wish)
    if acting:
        _act(simulator, wishes, acting)
        for visitor in acting:
            replies[visitor] = frame_of(simulator, *wishes[visitor])
    return replies


def _act(simulator: Simulator, wishes: Mapping[int, tuple[Seat, Wish]], acting: Mapping[int, np.ndarray]) -> None:
    actions: list[np.ndarray | None] = [None] * len(simulator)
    for visitor, chunk in acting.items():
        actions[wishes[visitor][0].episode] = chunk
    before = simulator.images
    simulator.step(actions)
    for visitor, chunk in acting.items():
        seat = wishes[visitor][0]
        if seat.truth is not None:
            seat.truth.step([chunk])
        if seat.recorded and seat.recording is not None:
            done = seat.robot.confine(chunk, "clip")[0]
            seat.recorded = seat.recording.add(before[seat.episode], done, simulator.images[seat.episode])


# --- Everything but acting ---------------------------------------------------------------------


def _start(simulator: Simulator, truth: Truth, seat: Seat, values: Message) -> None:
    robot = simulator.robot(text(values.get("robot")))
    starts = [start for start in simulator.starts if start.robot == robot.name]
    number, seed = whole(values.get("start", 0)), whole(values.get("seed", 0))
    require(number < len(starts), f"{robot.name} has {len(starts)} starts, no {number}")
    true = None if seat.truth is None else _begun(truth, robot, starts[number])  # may fail: before anything changes
    simulator.reset(starts[number], seeds=[seed], episodes=[seat.episode])
    seat.robot, seat.start, seat.truth, seat.recorded = robot, number, true, False


def _begun(truth: Truth, robot: Robot, start: Any) -> TrueSimulator | None:
    true = truth(robot)
    if true is not None:
        true.reset(start)
    return true


def _rewind(simulator: Simulator, truth: Truth, seat: Seat, values: Message) -> None:
    del truth
    require(seat.robot is not None, "begin an episode first")
    reach = simulator.reach(seat.episode)
    frames = min(whole(values.get("frames", 1)), reach)
    if seat.truth is not None:
        frames = min(frames, seat.truth.reach(0))
    simulator.rewind(frames, [seat.episode])
    if seat.truth is not None:
        seat.truth.rewind(frames)
    if seat.recorded and seat.recording is not None:  # a finished one is kept as it is
        seat.recording.drop(frames)


def _record(simulator: Simulator, truth: Truth, seat: Seat, values: Message) -> None:
    del truth, simulator
    require(seat.robot is not None, "begin an episode first")
    seat.recorded = switch(values.get("on"))
    if seat.recorded:
        seat.recording = Recording(seat.robot)


def _truth(simulator: Simulator, truth: Truth, seat: Seat, values: Message) -> None:
    """Both begin anew at the same start: a true state is not known of frames that the model made."""
    require(seat.robot is not None, "begin an episode first")
    on = switch(values.get("on"))
    seat.truth = None
    if not on:
        return
    starts = [start for start in simulator.starts if start.robot == seat.robot.name]
    seat.truth = _begun(truth, seat.robot, starts[seat.start])
    require(seat.truth is not None, f"{seat.robot.name} has no true simulator here")
    simulator.reset(starts[seat.start], episodes=[seat.episode])
    seat.recorded = False


CHANGES = {"start": _start, "rewind": _rewind, "record": _record, "truth": _truth}


# --- Messages ----------------------------------------------------------------------------------


def frame_of(simulator: Simulator, seat: Seat, wish: Wish) -> Message:
    """The visitor's present frame, and where it stands."""
    image = simulator.images[seat.episode]
    message: Message = {
        "type": "frame",
        "after": wish.kind,
        "image": picture(image),
        "count": simulator.counts[seat.episode],
        "window": simulator.model.config.frames,
        "reach": simulator.reach(seat.episode) if seat.robot else 0,
        "clipped": list(simulator.clipped[seat.episode]) if wish.kind == "act" else [],
        "recorded": len(seat.recording) if seat.recording is not None else 0,
        "recording": seat.recorded,
        "ms": round(1000 * (time.perf_counter() - wish.at), 1),
    }
    if seat.truth is not None:
        true = seat.truth.images[0]
        message |= {"true": picture(true), "psnr": round(float(psnr(image[None], true[None])[0]), 2)}
    if wish.kind == "rewind" or (wish.kind == "truth" and seat.truth is not None):  # it stands elsewhere now
        message["command"] = command(seat.robot, simulator.last_action(seat.episode))
    return message


def command(robot: Robot, last: np.ndarray | None) -> list[float]:
    """The action [A] that a page goes on with after a robot's `last`: where that was a place to go to, it stays."""
    action = last if robot.keeps and last is not None else robot.rest
    return np.clip(action, robot.low, robot.high).tolist()


def error_of(error: Exception, wish: Wish) -> Message:
    return {"type": "error", "after": wish.kind, "message": str(error)}


def picture(image: np.ndarray) -> str:
    """A frame uint8 [H, W, 3] as a browser shows it."""
    return "data:image/jpeg;base64," + base64.b64encode(encode_jpeg(np.ascontiguousarray(image))).decode()


def numbers(value: Any) -> np.ndarray:
    """ConfigError for what is no list of finite numbers."""
    flat = isinstance(value, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value)
    fits = flat and len(value) <= VALUES and all(abs(v) <= LARGEST for v in value)  # ints may have any number of digits
    require(fits, f"an action is a list of at most {VALUES} finite numbers, from {-LARGEST:g} to {LARGEST:g}")
    return np.array(value, np.float32)


def switch(value: Any) -> bool:
    """ConfigError for what is neither true nor false."""
    require(isinstance(value, bool), f'"on" must be true or false, got {value!r:.80}')
    return value


def whole(value: Any) -> int:
    """ConfigError for what is no whole number from 0 to 2^32 - 1."""
    fits = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**32
    require(fits, "a whole number from 0 to 2^32 - 1 is expected")
    return value


def text(value: Any) -> str:
    require(isinstance(value, str), f"{value!r:.80} is no name")
    return value
