"""EPIC-KITCHENS-100: extracted frames and the published hand detections.

Frames lie at `<root>/<participant>/rgb_frames/<video>/frame_%010d.jpg`, counted from 1, detections
at `<detections>/<participant>/<video>.pkl`. The action is the displacement of both hands' box
centres until the next kept frame. The state is where they are.

Rates: frames of the first recording (videos P01_01 .. P99_99) were extracted at 60 per second,
whatever the camera's rate, those of the extension (P01_101 ..) at 50, as the published frame counts
and durations show; two videos were first extracted at 60 by mistake and are recognised by their counts. Every 6th and
every 5th frame is kept, so that all videos become 10 Hz.

DIFFERS: from the release (reference sections 5.4 and 5.5) in these points:
* it calls the rate 30 Hz; here it is the true one;
* it takes detection i with frame i, but detections count from 0 and frames from 1;
* it drops frames without two hands and joins the rest over the gaps into one episode per video;
* it takes any two detections of score 0.1, even two left hands, as left and right; here the best
  left and the best right one of score 0.5, the threshold that the detections' authors advise;
* it stops after 5000 steps of a video; here long runs become several episodes.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.registry import get_spec
from data_pipelines.sources.convertible import Episode, Skipped, UnitError
from data_pipelines.sources.human.detections import ADVICE, read_hands
from data_pipelines.sources.human.hands import LAYOUT, cut_episodes, displacement
from data_pipelines.sources.settings import EpicKitchensSettings
from data_pipelines.sources.video import stored_jpeg
from hma_jax.config.json import to_dict

NAME = "epic_kitchen"
HZ = float(get_spec(NAME).hz)
FIRST_RATE, EXTENSION_RATE = 60, 50
EXTRACTED_AT_60 = {"P01_109": 222_487, "P27_103": 146_918}
"""Frames of the extension's two videos whose first published extraction has 60 per second."""

MAX_STEPS = 600  # one minute


class EpicKitchensSource:
    """Raises DataError if no video has both frames and detections."""

    layout = LAYOUT
    hz = HZ

    def __init__(
        self,
        frames: str | Path,
        detections: str | Path,
        settings: EpicKitchensSettings = EpicKitchensSettings(),
    ):
        settings.check()
        self.frames, self.detections, self.settings = Path(frames), Path(detections), settings
        found = sorted(p.name for p in self.frames.glob("P*/rgb_frames/P*_*") if p.is_dir())
        self.units = [video for video in found if self._pickle(video).is_file()]
        if not self.units:
            what = f"{found[0]} has no {self._pickle(found[0])}" if found else "it has no P*/rgb_frames/<video>/"
            raise DataError(
                f"{frames}: no video with frames and detections ({what}). Extract the tar files of "
                "rgb_frames, and give the folder hand-objects with --detections."
            )
        self.description = f"EPIC-KITCHENS-100, both hands as detected, {self.hz:g} Hz."

    def identity(self) -> dict[str, Any]:
        return {
            "format": "epic-kitchens",
            "detections": {video: self._pickle(video).stat().st_size for video in self.units},
            "settings": to_dict(self.settings),
        }

    def read(self, unit: int) -> Iterator[Episode | Skipped]:
        video = self.units[unit]
        positions = read_hands(self._pickle(video), self.settings.min_score)
        folder = self.frames / _participant(video) / "rgb_frames" / video
        surplus = folder / _frame_name(len(positions) + 1)
        if surplus.exists():
            raise UnitError(
                f"{folder}: it has {surplus.name}, but {self._pickle(video)} ends with frame {len(positions)}: frames "
                f"and detections are from different extractions. {ADVICE}"
            )
        step = int(_rate(video, len(positions)) // HZ)
        kept = np.arange(0, len(positions), step)

        def load(rows: np.ndarray) -> list[bytes]:
            return [self._frame(folder / _frame_name(int(kept[row]) + 1)) for row in rows]

        yield from cut_episodes(
            positions[kept],
            load,
            action=displacement,
            min_frames=self.settings.min_frames,
            max_steps=MAX_STEPS,
            origin=lambda row: f"{video}/{_frame_name(int(kept[row]) + 1)}",
        )

    def _frame(self, path: Path) -> bytes:
        try:
            data = path.read_bytes()
        except OSError as error:
            raise UnitError(f"{path}: the frame cannot be read ({error.strerror}). {ADVICE}") from error
        return stored_jpeg(data, self.settings.short_side, f"{path}: the frame")

    def _pickle(self, video: str) -> Path:
        return self.detections / _participant(video) / f"{video}.pkl"


def _participant(video: str) -> str:
    return video.partition("_")[0]


def _frame_name(number: int) -> str:
    return f"frame_{number:010d}.jpg"


def _rate(video: str, frames: int) -> int:
    """Extracted frames per second."""
    extension = len(video.partition("_")[2]) == 3
    return EXTENSION_RATE if extension and frames != EXTRACTED_AT_60.get(video) else FIRST_RATE
