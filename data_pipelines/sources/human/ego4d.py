"""Ego4D: narrated actions with hand boxes (FHO annotations, `fho_main.json`, version 2.1).

A narrated action comes with up to seven annotated frames (three at half-second steps before it,
then pre-condition, contact, point of no return, post-condition), each with boxes in pixels of the
full-scale video. The action is where the centres of both hands are in the next frame.

Rule across actions: all frames of one annotated interval that show both hands are ordered by time, whichever action
they belong to; a pause longer than `max_gap` seconds ends an episode. As annotated frames are not evenly spaced, an
episode is sampled at 2 Hz from its first one: frames from the video at these times, positions interpolated linearly
between annotated frames.

DIFFERS: from the release (reference sections 5.4 and 5.5) in these points:
* it calls annotated frames an even 1 Hz and joins four actions whatever time lies between them;
* its images are BGR; here they are RGB;
* it counts boxes of any kind before it looks for hands; here both hands are required by name;
* frame n is what the video shows at n / fps seconds; the release reads the frame before it.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.names import is_dataset_name, quote
from data_pipelines.registry import get_spec
from data_pipelines.sources.convertible import Episode, Skipped, UnitError
from data_pipelines.sources.human.hands import LAYOUT, NONE, cut_episodes, destination
from data_pipelines.sources.rlds.writer import encode_jpeg
from data_pipelines.sources.settings import Ego4dSettings
from data_pipelines.sources.video import ADVICE, Video, open_video, shrink
from hma_jax.config.json import to_dict

NAME = "ego4d"
HZ = float(get_spec(NAME).hz)
MAX_STEPS = 600
HANDS = ("left_hand", "right_hand")


class Ego4dSource:
    """`videos` holds `<video_uid>.mp4`; annotated videos that are missing there do not count as units.

    Raises DataError for annotations of another layout, or if no video is there.
    """

    layout = LAYOUT
    hz = HZ

    def __init__(
        self,
        annotations: str | Path,
        videos: str | Path,
        settings: Ego4dSettings = Ego4dSettings(),
    ):
        settings.check()
        self.path, self.videos, self.settings = Path(annotations), Path(videos), settings
        data = self._read()
        if not isinstance(data, dict) or not isinstance(data.get("videos"), list):
            raise DataError(f"{self.path}: it has no list 'videos'; give fho_main.json of the v2 annotations.")
        labels = {str(label.get("video_uid")): label for label in data["videos"] if isinstance(label, dict)}
        wrong = [uid for uid in labels if not is_dataset_name(uid)]
        if wrong:
            raise DataError(f"{self.path}: video_uid {quote(wrong[0])} is not a file name. Download the file again.")
        self._labels = {uid: label for uid, label in labels.items() if self._video(uid).is_file()}
        self.units = list(self._labels)
        if not self.units:
            raise DataError(
                f"{self.videos}: it contains none of the {len(labels)} annotated videos as <video_uid>.mp4. Give the "
                "folder full_scale with --videos."
            )
        self.description = f"Ego4D, both hands as annotated (FHO), {self.hz:g} Hz."

    def identity(self) -> dict[str, Any]:
        return {
            "format": "ego4d",
            "annotations": self._hash,
            "videos": {uid: self._video(uid).stat().st_size for uid in self.units},
            "settings": to_dict(self.settings),
        }

    def read(self, unit: int) -> Iterator[Episode | Skipped]:
        uid = self.units[unit]
        with open_video(self._video(uid)) as video:
            for number, interval in enumerate(self._field(self._labels[uid], "annotated_intervals", uid)):
                times, positions = self._annotated(uid, number, interval, video)
                if not len(times):
                    yield Skipped(NONE)
                for first, last in _stretches(times, self.settings.max_gap):
                    yield from self._episodes(uid, video, times[first:last], positions[first:last])

    def _episodes(
        self, uid: str, video: Video, times: np.ndarray, positions: np.ndarray
    ) -> Iterator[Episode | Skipped]:
        grid = times[0] + np.arange(int((times[-1] - times[0]) * HZ + 1e-6) + 1) / HZ
        even = np.stack([np.interp(grid, times, column) for column in positions.T], axis=1)
        yield from cut_episodes(
            even,
            lambda rows: [encode_jpeg(shrink(f, self.settings.short_side)) for f in video.frames(grid[rows])],
            action=destination,
            min_frames=self.settings.min_frames,
            max_steps=MAX_STEPS,
            origin=lambda row: f"{uid}/{grid[row]:.3f}s",
        )

    def _annotated(
        self, uid: str, number: int, interval: Mapping[str, Any], video: Video
    ) -> tuple[np.ndarray, np.ndarray]:
        """Times [K] in seconds, ascending, and positions [K, 4] of the frames with both hands."""
        where = f"{uid}, interval {number}"
        meta = self._labels[uid].get("video_metadata") or {}
        rate = float(meta.get("fps") or video.rate)
        size = float(meta.get("width") or video.width), float(meta.get("height") or video.height)
        found: dict[int, np.ndarray] = {}
        for action in self._field(interval, "narrated_actions", where):
            if action.get("is_rejected") or action.get("is_invalid_annotation"):
                continue
            for frame in action.get("frames") or ():
                row = self._centres(frame, size, f"{where}, frame {frame.get('frame_number')}")
                if row is not None:
                    frame_number = self._field(frame, "frame_number", where)
                    if type(frame_number) is not int or not 0 <= frame_number < video.max_frames:
                        raise UnitError(f"{self.path}: {where} has frame_number {quote(frame_number)}. {ADVICE}")
                    found.setdefault(frame_number, row)
        numbers = sorted(found)
        return np.array(numbers) / rate, np.array([found[n] for n in numbers]).reshape(-1, 4)

    def _centres(self, frame: Mapping[str, Any], size: tuple[float, float], where: str) -> np.ndarray | None:
        """[4], as fractions of the image; None unless both hands are annotated."""
        boxes = {box.get("object_type"): box for box in frame.get("boxes") or ()}
        if not all(hand in boxes for hand in HANDS):
            return None
        centres = []
        for hand in HANDS:
            box = self._field(boxes[hand], "bbox", f"{where}, {hand}")
            x, y, width, height = (
                float(self._field(box, k, f"{where}, {hand}")) for k in ("x", "y", "width", "height")
            )
            centres += [(x + width / 2) / size[0], (y + height / 2) / size[1]]
        return np.clip(centres, 0, 1)  # a box may reach over the edge by a pixel

    def _field(self, values: Any, name: str, where: str) -> Any:
        if not isinstance(values, Mapping) or values.get(name) is None:
            raise UnitError(f"{self.path}: {where} has no {name!r}. {ADVICE}")
        return values[name]

    def _read(self) -> Any:
        try:
            text = self.path.read_bytes()
            self._hash = hashlib.sha256(text).hexdigest()[:16]
            return json.loads(text)
        except (OSError, ValueError, RecursionError) as error:
            raise DataError(f"{self.path} cannot be read ({error}). Download it again.") from error

    def _video(self, uid: str) -> Path:
        return self.videos / f"{uid}.mp4"


def _stretches(times: np.ndarray, max_gap: float) -> list[tuple[int, int]]:
    """[start, stop) of stretches of ascending times without a pause longer than `max_gap`."""
    if not len(times):
        return []
    breaks = np.flatnonzero(np.diff(times) > max_gap + 1e-6) + 1
    return list(pairwise([0, *breaks.tolist(), len(times)]))
