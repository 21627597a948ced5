"""A round of visitors' requests, answered by one batch of the simulator; runs in a thread of its own."""

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


LARGEST_VALUE = 3e38
"""Largest absolute value of an action's number, which is stored in single precision."""

MAX_VALUES = 4096
"""Numbers of an action."""


@dataclass(frozen=True)
class Request:
    """A message from a visitor; only its kind has been checked."""

    kind: Kind
    values: Message
    at: float = field(default_factory=time.perf_counter)


@dataclass
class Session:
    """A visitor's episode in the simulator, and what belongs to it."""

    episode: int
    robot: Robot | None = None
    start: int = 0
    truth: TrueSimulator | None = None
    recording: Recording | None = None
    recorded: bool = False  # frames are being added to it


def answer(simulator: Simulator, truth: Truth, requests: Mapping[int, tuple[Session, Request]]) -> dict[int, Message]:
    """The reply to each visitor. A request that cannot be met is an error for that visitor only."""
    replies: dict[int, Message] = {}
    acting: dict[int, np.ndarray] = {}
    for visitor, (session, request) in requests.items():
        try:
            if request.kind == "act":
                require(session.robot is not None, "begin an episode first")
                acting[visitor] = session.robot.chunk(numbers(request.values.get("action")))
            else:
                HANDLERS[request.kind](simulator, truth, session, request.values)
                replies[visitor] = frame_of(simulator, session, request)
        except ConfigError as error:
            replies[visitor] = error_of(error, request)
    if acting:
        _act(simulator, requests, acting)
        for visitor in acting:
            replies[visitor] = frame_of(simulator, *requests[visitor])
    return replies


def _act(
    simulator: Simulator, requests: Mapping[int, tuple[Session, Request]], acting: Mapping[int, np.ndarray]
) -> None:
    actions: list[np.ndarray | None] = [None] * len(simulator)
    for visitor, chunk in acting.items():
        actions[requests[visitor][0].episode] = chunk
    before = simulator.images
    simulator.step(actions)
    for visitor, chunk in acting.items():
        session = requests[visitor][0]
        if session.truth is not None:
            session.truth.step([chunk])
        if session.recorded and session.recording is not None:
            done = session.robot.clip_to_range(chunk, "clip")[0]
            session.recording.add(before[session.episode], done, simulator.images[session.episode])
            session.recorded = not session.recording.full


# --- Everything but acting ---------------------------------------------------------------------


def _start(simulator: Simulator, truth: Truth, session: Session, values: Message) -> None:
    robot = simulator.robot(text(values.get("robot")))
    starts = [start for start in simulator.starts if start.robot == robot.name]
    number, seed = whole(values.get("start", 0)), whole(values.get("seed", 0))
    require(number < len(starts), f"{robot.name} has {len(starts)} starts; there is no start {number}")
    # This may fail, so it comes before anything changes.
    true = None if session.truth is None else _begin_truth(truth, robot, starts[number])
    simulator.reset(starts[number], seeds=[seed], episodes=[session.episode])
    session.robot, session.start, session.truth, session.recorded = robot, number, true, False


def _begin_truth(truth: Truth, robot: Robot, start: Any) -> TrueSimulator | None:
    true = truth(robot)
    if true is not None:
        true.reset(start)
    return true


def _rewind(simulator: Simulator, truth: Truth, session: Session, values: Message) -> None:
    del truth
    require(session.robot is not None, "begin an episode first")
    frames = min(whole(values.get("frames", 1)), reach(simulator, session))
    simulator.rewind(frames, [session.episode])
    if session.truth is not None:
        session.truth.rewind(frames)
    if session.recorded and session.recording is not None:  # a finished one is kept as it is
        session.recording.drop(frames)


def _record(simulator: Simulator, truth: Truth, session: Session, values: Message) -> None:
    del truth, simulator
    require(session.robot is not None, "begin an episode first")
    session.recorded = switch(values.get("on"))
    if session.recorded:
        session.recording = Recording(session.robot)


def _truth(simulator: Simulator, truth: Truth, session: Session, values: Message) -> None:
    """Lets both simulators begin anew at the same start: for frames that the model made, the true state is unknown."""
    require(session.robot is not None, "begin an episode first")
    on = switch(values.get("on"))
    session.truth = None
    if not on:
        return
    starts = [start for start in simulator.starts if start.robot == session.robot.name]
    session.truth = _begin_truth(truth, session.robot, starts[session.start])
    require(session.truth is not None, f"{session.robot.name} has no true simulator here")
    simulator.reset(starts[session.start], episodes=[session.episode])
    session.recorded = False


HANDLERS = {"start": _start, "rewind": _rewind, "record": _record, "truth": _truth}


# --- Messages ----------------------------------------------------------------------------------


def reach(simulator: Simulator, session: Session) -> int:
    """Number of frames by which a visitor's episode can be rewound: no further than the true simulator beside it."""
    most = simulator.max_rewind(session.episode)
    return most if session.truth is None else min(most, session.truth.max_rewind(0))


def frame_of(simulator: Simulator, session: Session, request: Request) -> Message:
    """The present frame of a visitor whose episode has begun, and its position in the episode."""
    image = simulator.images[session.episode]
    message: Message = {
        "type": "frame",
        "after": request.kind,
        "robot": session.robot.name,
        "start": session.start,
        "image": picture(image),
        "count": simulator.counts[session.episode],
        "window": simulator.model.config.frames,
        "reach": reach(simulator, session),
        "clipped": list(simulator.clipped[session.episode]) if request.kind == "act" else [],
        "recorded": len(session.recording) if session.recording is not None else 0,
        "recording": session.recorded,
        "full": session.recording is not None and session.recording.full,
        "ms": round(1000 * (time.perf_counter() - request.at), 1),
    }
    if session.truth is not None:
        true = session.truth.images[0]
        message |= {"true": picture(true), "psnr": round(float(psnr(image[None], true[None])[0]), 2)}
    if request.kind == "rewind" or (request.kind == "truth" and session.truth is not None):  # it is elsewhere now
        message["command"] = command(session.robot, simulator.last_action(session.episode))
    return message


def command(robot: Robot, last: np.ndarray | None) -> list[float]:
    """The action [A] with which a page continues after a robot's `last` one: if that was a target position, it
    stays."""
    action = last if robot.keeps and last is not None else robot.rest
    return np.clip(action, robot.low, robot.high).tolist()


def error_of(error: Exception, request: Request) -> Message:
    return {"type": "error", "after": request.kind, "message": str(error)}


def picture(image: np.ndarray) -> str:
    """A frame uint8 [H, W, 3] as a browser shows it."""
    return "data:image/jpeg;base64," + base64.b64encode(encode_jpeg(image)).decode()


def numbers(value: Any) -> np.ndarray:
    """The numbers. Raises ConfigError for anything that is not a list of finite numbers."""
    flat = isinstance(value, list) and all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in value)
    # isfinite would not be enough: ints may have any number of digits.
    fits = flat and len(value) <= MAX_VALUES and all(abs(v) <= LARGEST_VALUE for v in value)
    require(
        fits,
        f"an action is a list of at most {MAX_VALUES} finite numbers, from {-LARGEST_VALUE:g} to {LARGEST_VALUE:g}",
    )
    return np.array(value, np.float32)


def switch(value: Any) -> bool:
    """The truth value. Raises ConfigError for anything that is neither true nor false."""
    require(isinstance(value, bool), f'"on" must be true or false, got {value!r:.80}')
    return value


def whole(value: Any) -> int:
    """The number. Raises ConfigError for anything that is not a whole number from 0 to 2^32 - 1."""
    fits = isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**32
    require(fits, "a whole number from 0 to 2^32 - 1 is expected")
    return value


def text(value: Any) -> str:
    require(isinstance(value, str), f"{value!r:.80} is not a name")
    return value
