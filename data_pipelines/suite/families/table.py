"""How a family's table is written: the common settings, then one `Row` per sibling."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from data_pipelines.suite.bodies import Body
from data_pipelines.suite.controls import Control
from data_pipelines.suite.spec import Camera, EmbodimentSpec, Palette, Physics
from data_pipelines.suite.tasks import Task

PIXEL = 1 / 32  # world units per pixel of a 64-pixel image at zoom 1
METRE = 2.0  # world units per metre, where the floor is 1 m wide
INCH = 0.0254 * METRE
DEGREE = math.pi / 180
TICK = 2 * math.pi / 4096  # one encoder step of a hobby servo, radians


def joints(first: int, count: int) -> tuple[int, ...]:
    """Joints first .. first + count - 1."""
    return tuple(range(first, first + count))


@dataclass(frozen=True)
class Row:
    """One sibling. `more` are fields of its spec that differ from the family's."""

    palette: Palette
    hz: int
    episodes: int
    seconds: tuple[float, float]
    body: Body
    controls: tuple[Control, ...]
    camera: Camera = Camera()
    more: Mapping[str, Any] = field(default_factory=dict)


def family(
    name: str, *rows: Row, task: Task, instruction: str, physics: Physics, **common: Any
) -> tuple[EmbodimentSpec, ...]:
    """The specs of a family, each called <family>_<palette>."""
    return tuple(
        EmbodimentSpec(
            name=f"{name}_{row.palette.name}", family=name, hz=row.hz, episodes=row.episodes, seconds=row.seconds,
            body=row.body, controls=row.controls, camera=row.camera, palette=row.palette, task=task,
            instruction=instruction, physics=physics, **{**common, **row.more},
        )
        for row in rows
    )  # fmt: skip
