"""Ego-Exo4D: a fixed camera and the automatic hand poses, 30 frames per second.

Annotations: `annotations/ego_pose/<split>/hand/automatic/<take_uid>.json`, frame number -> poses,
of which the first has `annotation2D[<camera>][left_wrist | right_wrist]` with x and y in pixels of
the camera's full resolution. Videos: `takes/<take_name>/frame_aligned_videos/<camera>.mp4`, or their
downscaled copies (`downscaled/448`). `takes.json` joins the two. The action is where both wrists are
in the next frame. A clip must span at least 300 labelled frames, 10 s.
DIFFERS: the release keeps clips that are shorter than that instead, so almost nothing is left, and uses another name
for the dataset than its table of rates does (reference sections 5.4 and 5.5).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.names import is_dataset_name, quote
from data_pipelines.registry import get_spec
from data_pipelines.sources.convertible import Episode, Skipped, UnitError
from data_pipelines.sources.human.hands import LAYOUT, NONE, cut_episodes, destination
from data_pipelines.sources.rlds.writer import encode_jpeg
from data_pipelines.sources.settings import EgoExo4dSettings
from data_pipelines.sources.video import ADVICE, Video, open_video, shrink
from hma_jax.config.json import to_dict

NAME = "exoego4d"
"""As the release and the registry call it."""

HZ = float(get_spec(NAME).hz)
MAX_STEPS = 900  # half a minute
FULL_SIZE = (3840, 2160)
"""Pixels of the exo cameras, in which poses are given; needed where only a downscaled video is there."""

WRISTS = ("left_wrist", "right_wrist")


class EgoExo4dSource:
    """Takes that have a video of `camera` and automatic poses. Raises DataError if there is none."""

    layout = LAYOUT
    hz = HZ

    def __init__(self, root: str | Path, settings: EgoExo4dSettings = EgoExo4dSettings()):
        settings.check()
        self.root, self.settings, self.camera = Path(root), settings, settings.camera
        self._poses = self.root / "annotations" / "ego_pose" / settings.split / "hand" / "automatic"
        root_advice = "Give the root of the dataset, with takes.json, takes and annotations."
        takes = _json(self.root / "takes.json", DataError, root_advice)
        if not isinstance(takes, list) or not all(isinstance(t, dict) for t in takes):
            raise DataError(f"{self.root / 'takes.json'}: not a list of takes. Download it again.")
        for take in takes:
            for field in ("take_uid", "take_name"):
                if not is_dataset_name(take.get(field)):
                    raise DataError(
                        f"{self.root / 'takes.json'}: {field} {quote(take.get(field))} is not a file name. Download "
                        "the file again."
                    )
        self._takes = [t for t in takes if self._pose(t).is_file() and self._video(t) is not None]
        self.units = [str(t.get("take_name")) for t in self._takes]
        if not self.units:
            raise DataError(
                f"{self.root}: none of the {len(takes)} takes of takes.json has both a video "
                f"takes/<take_name>/frame_aligned_videos/{self.camera}.mp4 and poses in {self._poses}."
            )
        self.description = f"Ego-Exo4D, camera {self.camera}, both wrists, {self.hz:g} Hz."

    def identity(self) -> dict[str, Any]:
        return {
            "format": "egoexo4d",
            "takes": {n: self._facts(t) for n, t in zip(self.units, self._takes, strict=True)},
            "settings": to_dict(self.settings),
        }

    def read(self, unit: int) -> Iterator[Episode | Skipped]:
        take, name = self._takes[unit], self.units[unit]
        path = self._video(take)
        with open_video(path) as video:
            numbers, positions = self._wrists(take, video)
            if not len(numbers):
                yield Skipped(NONE)
                return
            if numbers[-1] >= video.max_frames:
                raise UnitError(
                    f"{self._pose(take)}: it has frame {numbers[-1]}, but {path} has at most {video.max_frames} "
                    f"frames. {ADVICE}"
                )
            rows = np.full((int(numbers[-1]) + 1, 4), np.nan)
            rows[numbers] = positions
            if abs(video.rate - HZ) > 0.02 * HZ:
                raise UnitError(f"{path}: {video.rate:g} frames per second, not {HZ:g}. {ADVICE}")
            yield from cut_episodes(
                rows,
                lambda at: [encode_jpeg(shrink(f, self.settings.short_side)) for f in video.frames(at / video.rate)],
                action=destination,
                min_frames=self.settings.min_frames,
                max_steps=MAX_STEPS,
                origin=lambda row: f"{name}/{self.camera}/{row}",
            )

    def _wrists(self, take: dict[str, Any], video: Video) -> tuple[np.ndarray, np.ndarray]:
        """Frame numbers [K], ascending, and positions [K, 4] of frames with both wrists."""
        path = self._pose(take)
        poses = _json(path, UnitError)
        if not isinstance(poses, dict):
            raise UnitError(f"{path}: not an object of frames. {ADVICE}")
        size = np.tile(self._full_size(video), 2)
        found = {}
        for frame, people in poses.items():
            try:
                if not people:
                    continue
                joints = people[0]["annotation2D"].get(self.camera) or {}
                if all(joints.get(wrist) for wrist in WRISTS):
                    xy = [float(joints[wrist][axis]) for wrist in WRISTS for axis in ("x", "y")]
                    found[_frame_number(frame)] = np.array(xy) / size
            except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
                raise UnitError(f"{path}: frame {frame!r} has no usable annotation2D ({error!r}). {ADVICE}") from error
        numbers = sorted(found)
        return np.array(numbers, np.int64), np.array([found[n] for n in numbers]).reshape(-1, 4)

    def _full_size(self, video: Video) -> np.ndarray:
        """Width and height in which poses are given."""
        if video.height >= FULL_SIZE[1]:
            return np.array([video.width, video.height], float)
        if abs(video.width / video.height - FULL_SIZE[0] / FULL_SIZE[1]) > 0.02:
            raise UnitError(
                f"{self.camera}: the downscaled video of {video.width} x {video.height} pixels has another aspect "
                f"ratio than {FULL_SIZE[0]} x {FULL_SIZE[1]}, the size for which poses are given. Download the "
                "full-scale video."
            )
        return np.array(FULL_SIZE, float)

    def _pose(self, take: dict[str, Any]) -> Path:
        return self._poses / f"{take['take_uid']}.json"

    def _video(self, take: dict[str, Any]) -> Path | None:
        """The full-scale video, or a downscaled copy of it."""
        folder = self.root / "takes" / str(take.get("take_name")) / "frame_aligned_videos"
        places = [
            folder / f"{self.camera}.mp4",
            *sorted(folder.glob(f"downscaled/*/{self.camera}.mp4"), reverse=True),
        ]
        return next((place for place in places if place.is_file()), None)

    def _facts(self, take: dict[str, Any]) -> list[Any]:
        pose = hashlib.sha256(self._pose(take).read_bytes()).hexdigest()[:16]
        video = self._video(take)
        return [pose, str(video.relative_to(self.root)), video.stat().st_size]


def _frame_number(text: str) -> int:
    if not (len(text) <= 9 and text.isascii() and text.isdecimal()):
        raise ValueError(f"{quote(text)} is not a frame number")
    return int(text)


def _json(path: Path, kind: type[DataError], advice: str = ADVICE) -> Any:
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise kind(f"{path} cannot be read ({error}). {advice}") from error
