"""The suite's robots as a `TrueSimulator`, how they are commanded, and starts of their held-out episodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_pipelines.registry.spec import FRAME_RATE, stride_of
from data_pipelines.suite.controls import Control, Drive
from data_pipelines.suite.embodiments import SPECS
from data_pipelines.suite.environment import Environment
from data_pipelines.suite.rollout import episode_seeds, simulate
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.true_simulator import TrueSimulator
from hma_jax.simulator.robots import KEYS, Robot, rest_action
from hma_jax.simulator.starts import Start

UNITS = {"delta": "per step", "velocity": "per second", "absolute": "position"}


class SuiteSimulator(TrueSimulator[Environment]):
    """B episodes of the suite's robots."""

    @staticmethod
    def dims() -> dict[str, int]:
        return {name: spec.action_dim for name, spec in SPECS.items()}

    def open_world(self, name: str) -> Environment:
        return Environment(name)


def suite_robot(
    name: str, low: Sequence[float], high: Sequence[float], mean: Sequence[float], stride: int, *, recorded: bool = True
) -> Robot:
    """How a robot of the suite is commanded, given the least, greatest and mean of its recorded actions."""
    spec = SPECS[name]
    names = [f"{control.key} {part}" for control in spec.controls for part in _parts(control)]
    return Robot(
        name, stride, tuple(low), tuple(high), rest_action(low, high, mean), tuple(names),
        unit=UNITS[spec.convention], keeps=spec.convention == "absolute", hz=float(spec.hz), keys=_keys(spec),
        recorded=recorded,
    )  # fmt: skip


def _parts(control: Control) -> Sequence[str]:
    if isinstance(control, Drive):
        return ("left", "right") if control.style == "wheels" else ("forward", "sideways", "turn")
    return ("x", "y") if control.key == "xy" else [str(i + 1) for i in range(control.dim)]


def _keys(spec: EmbodimentSpec) -> tuple[tuple[float, ...], ...]:
    """What the keys right, up, D and W do to each action value; a positive angle turns to the left."""
    if isinstance(spec.controls[0], Drive) and spec.controls[0].style == "wheels":
        turn, ahead = (1.0, -1.0), (1.0, 1.0)
        return turn, ahead, turn, ahead
    turning = spec.body.links[0].kind == "turn"
    signs = [-1.0 if turning and c.key == "joints" else 1.0 for c in spec.controls for _ in range(c.dim)]
    dim = spec.action_dim
    moved = [key % 2 if dim <= 2 else min(key, dim - 1) for key in range(KEYS)]
    return tuple(tuple(sign * (d == at) for d, sign in enumerate(signs)) for at in moved)


def suite_starts(
    name: str, count: int, frames: int, *, stride: int | None = None, seed: int = 0, most: int | None = None
) -> list[Start]:
    """The first `frames` frames of up to `most` episodes (None: all that are long enough), which begin as the first
    `count` held-out ones of a suite made with `seed`.

    Actions are drawn anew: they are not those of the suite's episodes, and depend on `count`. A frame is shown every
    `stride` native steps; None: as near to FRAME_RATE as possible.
    """
    spec = SPECS[name]
    stride, numbers = stride or stride_of(spec.hz, FRAME_RATE), episode_seeds(spec, count, seed, "val")
    rollout, starts = simulate(spec, numbers), []
    for i, number in enumerate(numbers):
        if len(starts) == most:
            break
        if rollout.lengths[i] <= (frames - 1) * stride:
            continue
        world, images = Environment(spec), []
        world.reset(int(number))
        actions = rollout.actions[i, : (frames - 1) * stride].astype(np.float32)
        for t in range(frames):
            images.append(world.render())
            for action in actions[t * stride : (t + 1) * stride]:
                world.step(action)
        starts.append(Start(name, np.stack(images), actions, int(number)))
    return starts
