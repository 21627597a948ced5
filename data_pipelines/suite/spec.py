"""The record type of the embodiment table: everything that defines one simulated dataset.

Facts only; `embodiments` holds the table, `world` simulates it, `render` draws it.
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


@dataclass(frozen=True)
class Camera:
    """A view. Without `follow` it is fixed in the world; with it, it rides on that link.

    Pixel = flip(rotate(point - centre)) * zoom, in units of half the shorter image side.
    """

    key: str = "image"
    rotate: float = 0.0  # degrees
    zoom: float = 1.0
    centre: tuple[float, float] = (0.0, 0.0)  # in the world, or in the followed link's frame
    flip: bool = False  # mirror left-right
    follow: int | None = None
    height: int = 64
    width: int = 64


@dataclass(frozen=True)
class Look:
    """Colours (0..255). Every episode draws its own light, floor shade and object colours."""

    floor: RGB = (176, 168, 156)
    outside: RGB = (120, 116, 112)
    robot: tuple[RGB, RGB, RGB] = ((70, 90, 160), (215, 120, 60), (60, 60, 70))
    pattern: Literal["plain", "slope", "stripe", "table"] = "plain"
    shade: float = 4.0  # standard deviation of the floor's colour between episodes
    distractors: int = 0
    distractor_speed: float = 0.35  # world units per second
    distractor_size: float = 0.13


@dataclass(frozen=True)
class EmbodimentSpec:
    """One embodiment = one dataset of the suite."""

    name: str
    kind: Literal["arm", "pusher", "gripper", "rover", "mobile_arm", "bimanual", "hand"]
    hz: int
    episodes: int  # at scale 1
    body: Body
    controls: tuple[Control, ...]
    task: Task
    instruction: str
    look: Look = Look()
    cameras: tuple[Camera, ...] = (Camera(),)
    seconds: tuple[float, float] = (8.0, 12.0)  # shortest and longest episode
    dict_actions: bool = False  # one tensor per control, instead of one tensor
    purpose: float = 0.5  # mean share of the time spent on the task; the rest explores
    restless: float = 0.8  # changes of mind per second
    noise: float = 0.15  # of the wishes, in units of what a joint can do in 0.5 s

    def __post_init__(self):
        name = self.name
        require(bool(re.fullmatch(r"[a-z][a-z0-9_]*", name)), f"embodiment name {name!r} is not snake_case")
        require(1 <= self.hz <= 60, f"{name}: hz must lie in 1..60, got {self.hz}")
        require(self.cameras[0].key == "image", f"{name}: the first camera must be called 'image'")
        keys = [c.key for c in self.controls]
        require(len(set(keys)) == len(keys), f"{name}: control keys repeat: {keys}")
        require(self.seconds[0] <= self.seconds[1], f"{name}: seconds must be (shortest, longest)")

    @property
    def action_dim(self) -> int:
        return sum(c.dim for c in self.controls)

    @property
    def action_layout(self) -> tuple[tuple[str, int], ...]:
        """Ordered (key, dim) of the action's tensors; ("action", A) when it is a single one."""
        if self.dict_actions:
            return tuple((c.key, c.dim) for c in self.controls)
        return (("action", self.action_dim),)

    @property
    def convention(self) -> str:
        """absolute, delta or velocity: of the first, the main control."""
        return self.controls[0].convention

    @property
    def image_keys(self) -> tuple[str, ...]:
        return tuple(c.key for c in self.cameras)
