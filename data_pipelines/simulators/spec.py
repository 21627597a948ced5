"""The record type of the simulator table: everything that defines one simulated dataset.

Declarations only; `embodiments` holds the table, `backends` know the packages. Imports no simulator.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from hma_jax.config import require

Backend = Literal["metaworld", "robosuite", "gymnasium", "dm_control", "aloha", "pusht", "so101"]

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class View:
    """Where the camera is: one of the model's own by name, or a free one (metres, degrees).

    `follow` names a body that a free camera looks at instead of at a fixed point. `turned` is for cameras that are
    mounted upside down (Meta-World's corners): the picture is turned by 180 degrees.
    """

    name: str = ""
    lookat: Vector = (0.0, 0.0, 0.0)
    distance: float = 2.0
    azimuth: float = 150.0
    elevation: float = -25.0
    follow: str = ""
    turned: bool = False

    @property
    def title(self) -> str:
        """For people."""
        return self.name or ("following" if self.follow else "fixed, free")


@dataclass(frozen=True)
class SimSpec:
    """One embodiment and action space = one dataset.

    Episode i runs `envs[i % len(envs)]`. An action is one float32 vector, the parts of `layout` in
    their order; each is held for `repeat` steps of the environment, so that `hz` is the rate at
    which frames and actions are recorded.
    """

    name: str
    package: str  # distribution on PyPI
    backend: Backend
    envs: tuple[str, ...]  # ids in that package
    layout: tuple[tuple[str, int], ...]  # (what, values)
    hz: float
    view: View
    instruction: str = ""  # "" takes the environment's name, in words
    kwargs: Mapping[str, Any] = field(default_factory=dict)  # arguments of the environment
    repeat: int = 1
    expert: str = ""  # the script that acts; "": a random walk
    success: bool = False  # whether the environment reports success
    seconds: tuple[float, float] = (8.0, 10.0)  # shortest and longest episode
    gain: float = 0.6  # standard deviation of the random walk, as a share of half the action range
    tau: float = 0.6  # correlation time of the random walk, seconds
    noise: float = 0.4  # standard deviation of an expert's noise at level 1, as a share of half the action range
    note: str = ""

    def __post_init__(self):
        name = self.name
        require(bool(re.fullmatch(r"[a-z][a-z0-9_]*", name)), f"simulator name {name!r} is not snake_case")
        require(bool(self.envs), f"{name}: envs must name at least one environment")
        require(1 <= self.hz <= 60, f"{name}: hz must lie in 1..60, got {self.hz}")
        require(self.repeat >= 1, f"{name}: repeat must be at least 1, got {self.repeat}")
        require(0 < self.seconds[0] <= self.seconds[1], f"{name}: seconds must be (shortest, longest)")

    @property
    def action_dim(self) -> int:
        return sum(dim for _, dim in self.layout)

    @property
    def steps(self) -> tuple[int, int]:
        """Shortest and longest episode in frames."""
        return round(self.seconds[0] * self.hz), round(self.seconds[1] * self.hz)
