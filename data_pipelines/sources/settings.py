"""The options of a conversion, for each format. Needs no library, so that the command line can read it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from hma_jax.config import require

HUMAN_SHORT_SIDE = 256
"""Pixels of the shorter side of frames of human video: what the release's tokenizers see."""

UNSET = arg(help_behavior_hint="")
"""For an option whose help text says what happens without it."""

Cameras = Annotated[tuple[str, ...], arg(metavar="[NAME ...]"), UNSET]


def _check_side(short_side: int | None) -> None:
    require(short_side is None or short_side >= 8, f"short_side must be at least 8 pixels, got {short_side}")


@dataclass(frozen=True)
class RobomimicSettings:
    """What is taken from the file."""

    camera: Cameras = ()
    """Cameras to keep, such as agentview. (default: all)"""
    filter_key: str | None = None
    """Take only the demonstrations of this mask (filter key), or of several, such as train+valid."""
    hz: Annotated[float | None, UNSET] = None
    """Control rate in Hz. (default: the file's own, or 20)"""
    short_side: int | None = None
    """Shrink images to this shorter side."""

    def check(self) -> None:
        """Raises ConfigError for invalid settings."""
        _check_side(self.short_side)
        require(self.hz is None or 0 < self.hz < math.inf, f"hz must be positive and finite, got {self.hz}")


@dataclass(frozen=True)
class LeRobotSettings:
    """What is taken from the dataset."""

    camera: Cameras = ()
    """Cameras to keep, such as top. (default: all)"""
    short_side: int | None = None
    """Shrink images to this shorter side."""

    def check(self) -> None:
        """Raises ConfigError for invalid settings."""
        _check_side(self.short_side)


@dataclass(frozen=True)
class HumanSettings:
    """Which frames of human videos make episodes."""

    min_frames: int
    """Shortest run of frames that makes an episode."""
    short_side: int | None = HUMAN_SHORT_SIDE
    """Shrink frames to this shorter side."""

    def check(self) -> None:
        """Raises ConfigError for invalid settings."""
        _check_side(self.short_side)
        require(self.min_frames >= 2, f"min_frames must be at least 2, got {self.min_frames}")


@dataclass(frozen=True)
class EpicKitchensSettings(HumanSettings):
    """Which frames make episodes."""

    min_frames: int = 61
    """Shortest run of frames with both hands that makes an episode: 61 at 10 Hz are 6 s."""
    min_score: float = 0.5
    """Lowest score of a detection that is used; the authors of the detections recommend 0.5."""


@dataclass(frozen=True)
class Ego4dSettings(HumanSettings):
    """Which frames make episodes."""

    min_frames: int = 16
    """Shortest episode, in frames at 2 Hz."""
    max_gap: float = 1.0
    """Longest pause between annotated frames of one episode, in seconds."""

    def check(self) -> None:
        super().check()
        require(self.max_gap > 0, f"max_gap must be positive, got {self.max_gap}")


@dataclass(frozen=True)
class EgoExo4dSettings(HumanSettings):
    """Which takes and frames make episodes."""

    min_frames: int = 300
    """Shortest run of labelled frames that makes an episode: 300 at 30 Hz are 10 s."""
    camera: str = "cam01"
    """Name of the fixed camera."""
    split: str = "train"
    """Split of the annotations: train, val or test."""
