"""The record types of the tables: everything that defines one simulated robot and its dataset.

Declarations only; `families` holds the tables, `world` simulates, `render` renders.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from data_pipelines.suite.bodies import Body
from data_pipelines.suite.controls import Control
from data_pipelines.suite.tasks import Task
from hma_jax.config import require

RGB = tuple[int, int, int]

IMAGE_KEY = "image"
IMAGE_SIZE = 64
"""Pixels along each side of a recorded frame. Studies on two cores see them at 32."""

MAX_SECONDS = 60.0


@dataclass(frozen=True)
class Camera:
    """A fixed view: pixel = rotate(point - centre) * zoom, in halves of the image's side.

    The floor spans [-1, 1] x [-1, 1]. `tilt` < 1 looks at it from the front, so that it appears less high than wide.
    """

    rotate: float = 0.0  # degrees
    zoom: float = 1.0
    centre: tuple[float, float] = (0.0, 0.0)
    tilt: float = 1.0


@dataclass(frozen=True)
class Palette:
    """Colours (0..255). Every episode draws its own light and object colours."""

    name: str
    floor: RGB
    outside: RGB
    robot: tuple[RGB, RGB, RGB]
    objects: tuple[RGB, RGB, RGB]
    pattern: Literal["plain", "tiles", "stripe", "table", "rings"] = "plain"


@dataclass(frozen=True)
class Physics:
    """How things move; the same for all robots of a family."""

    inertia: float = 0.08  # seconds in which a joint reaches the commanded velocity
    friction: float = 2.5  # deceleration of a sliding object, world units per second squared
    bounce: float = 0.2  # restitution of contacts


@dataclass(frozen=True)
class EmbodimentSpec:
    """One robot = one dataset of the suite."""

    name: str
    family: str
    hz: int
    episodes: int  # to train on, at scale 1
    body: Body
    controls: tuple[Control, ...]
    task: Task
    instruction: str
    palette: Palette
    physics: Physics = Physics()
    camera: Camera = Camera()
    seconds: tuple[float, float] = (4.0, 14.0)  # shortest and longest episode
    dict_actions: bool = False  # one tensor per control, instead of one tensor
    video_only: bool = False  # the dataset does not say what the actions were
    delay: int = 0  # native steps until an action is executed
    purpose: float = 0.4  # mean share of the time spent on the task; the rest explores
    restless: float = 1.2  # mean changes of the explored goal per second
    noise: float = 0.2  # noise of goals, in units of what a joint can move in 0.5 s

    def __post_init__(self):
        name = self.name
        require(bool(re.fullmatch(r"[a-z][a-z0-9_]*", name)), f"embodiment name {name!r} is not snake_case")
        require(1 <= self.hz <= 60, f"{name}: hz must lie in 1..60, got {self.hz}")
        keys = [c.key for c in self.controls]
        require(len(set(keys)) == len(keys), f"{name}: control keys repeat: {keys}")
        joints = sorted(j for c in self.controls for j in c.joints)
        require(joints == list(range(self.body.size)), f"{name}: controls must move every joint once, got {joints}")
        require(
            1.0 <= self.seconds[0] <= self.seconds[1] <= MAX_SECONDS,
            f"{name}: seconds must be (shortest, longest) within 1..{MAX_SECONDS:g}, got {self.seconds}",
        )
        require(self.delay >= 0, f"{name}: delay must not be negative, got {self.delay}")

    @property
    def action_dim(self) -> int:
        """A, also for a robot whose dataset has video only."""
        return sum(c.dim for c in self.controls)

    @property
    def action_layout(self) -> tuple[tuple[str, int], ...]:
        """Ordered (key, dim) of the recorded action's tensors: one called "action", one for each
        control, or none at all."""
        if self.video_only:
            return ()
        if self.dict_actions:
            return tuple((f"action/{c.key}", c.dim) for c in self.controls)
        return (("action", self.action_dim),)

    @property
    def convention(self) -> str:
        """absolute, delta or velocity: that of the first control, the main one."""
        return self.controls[0].convention

    @property
    def points(self) -> tuple[str, ...]:
        """Names of the P points whose true position comes with every frame: tools, then objects."""
        tools = [f"tool_{m}" for m in range(len(self.body.tools))]
        return (*tools, *(f"object_{k}" for k in range(self.task.objects)))
