"""Frames of a video at given times, and the encoding and resizing of stored frames.

Owns decoding with PyAV (extra `convert`). Times are seconds since the video's first frame.
"""

from __future__ import annotations

import errno
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from data_pipelines.errors import UnreachableError
from data_pipelines.sources.convertible import UnitError, require_module
from data_pipelines.sources.rlds.images import decode_image
from data_pipelines.sources.rlds.location import is_io_error, retry
from data_pipelines.sources.rlds.writer import encode_jpeg

ADVICE = "Download the file again, or leave it out with --skip-damaged (when tokenising, corrupt='skip')."

SEEK_SECONDS = 2.0
"""A jump forward by more seconds than this seeks; for a shorter one the frames in between are decoded."""


def shrink(image: np.ndarray, short_side: int | None) -> np.ndarray:
    """`image`, uint8 [H, W, 3], antialiased down to `short_side`; never enlarged."""
    height, width = image.shape[:2]
    if short_side is None or min(height, width) <= short_side:
        return image
    scale = short_side / min(height, width)
    size = (max(round(width * scale), 1), max(round(height * scale), 1))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.BILINEAR))


def stored_jpeg(data: bytes, short_side: int | None, where: str) -> bytes:
    """The bytes to store for an encoded image: unchanged if it is a JPEG that is small enough, otherwise a new JPEG.

    Raises UnitError, naming `where`, if the bytes are no image.
    """
    try:
        image = decode_image(data)
    except ValueError as error:
        raise UnitError(f"{where} cannot be decoded: {error}. {ADVICE}") from error
    small = shrink(image, short_side)
    return data if small is image and data.startswith(b"\xff\xd8\xff") else encode_jpeg(small)


MIN_FRAME_BYTES = 4
"""Least number of bytes that a frame takes in a video file: the entry for its size in the file's index."""


class Video:
    """An opened video. `rate` in frames per second, `width` and `height` in pixels. `max_frames` bounds the number of
    its frames by the file's size, whatever its header claims. `hz`: frames are asked for at this rate; 0: at any
    times."""

    def __init__(self, path: Path, container: Any, hz: float):
        self._path, self._container, self._hz = path, container, hz
        self._stream = container.streams.video[0]
        self._stream.thread_type = "AUTO"
        self._start = self._stream.start_time or 0
        self.max_frames = path.stat().st_size // MIN_FRAME_BYTES
        self.rate = float(self._stream.average_rate or self._stream.guessed_rate or 0)
        self.width, self.height = self._stream.codec_context.width, self._stream.codec_context.height
        self._frames: Iterator[tuple[float, Any]] | None = None
        self._neighbours: tuple[Any, Any] = None, None  # last frame before the time asked for, first frame from it on
        self._shown, self._pixels = None, None

    def frames(self, times: Sequence[float]) -> Iterator[np.ndarray]:
        """`at` each of `times` (ascending)."""
        return map(self.at, times)

    def at(self, time: float) -> np.ndarray:
        """The frame nearest to `time`, uint8 [H, W, 3], RGB. With ascending times each frame is decoded once.

        Raises UnitError if none is within half a frame interval and half of 1 / `hz`.
        """
        # If a video had fewer frames than rows, the nearest frame could show what the row's action did.
        near = 0.5 / max(self.rate, self._hz) + 1e-4
        before, after = self._neighbours
        if (
            self._frames is None
            or time < (before or after or (np.inf,))[0]
            or (after and time > after[0] + SEEK_SECONDS)
        ):
            self._frames = self._from(time)
            before, after = None, next(self._frames, None)
        while after is not None and after[0] < time:
            before, after = after, next(self._frames, None)
        self._neighbours = before, after
        nearest = min((f for f in (before, after) if f is not None), key=lambda f: abs(f[0] - time), default=None)
        if nearest is None or abs(nearest[0] - time) > near:
            found = "the video has no frame" if nearest is None else f"the nearest is at {nearest[0]:.4f} s"
            raise UnitError(f"{self._path}: no frame at {time:.4f} s within {near:.4f} s: {found}. {ADVICE}")
        if nearest[1] is not self._shown:
            self._shown, self._pixels = nearest[1], nearest[1].to_ndarray(format="rgb24")
        return self._pixels

    def _from(self, time: float) -> Iterator[tuple[float, Any]]:
        """(time, frame) in order, beginning at or before `time`."""
        base = float(self._stream.time_base)
        for target in (self._start + int(max(time - 0.5 / self.rate, 0) / base), None):
            # If the file's index leads too far, decode from the beginning.
            frames = self._decode(base, self._start if target is None else target)
            first = next(frames, None)
            if first is not None and (first[0] <= time or target is None):
                yield first
                yield from frames
                return

    def _decode(self, base: float, target: int) -> Iterator[tuple[float, Any]]:
        import av

        try:
            self._container.seek(target, stream=self._stream, backward=True)
            for frame in self._container.decode(self._stream):
                yield (frame.pts - self._start) * base, frame
        except (av.FFmpegError, TypeError) as error:  # TypeError: a frame without a time
            if _is_io_error(error):
                again = "Run the same command again."
                raise UnreachableError(f"{self._path}: cannot be read ({error}). {again}") from error
            raise UnitError(f"{self._path}: it cannot be decoded ({error}). {ADVICE}") from error


def _is_io_error(error: Exception) -> bool:
    """As `is_io_error`, but without EPERM: FFmpeg reports damaged contents so; a denied read is EACCES."""
    return is_io_error(error) and getattr(error, "errno", None) != errno.EPERM


@contextmanager
def open_video(path: Path, hz: float = 0.0) -> Iterator[Video]:
    """`hz` as in Video. Raises UnitError for a file that is missing or not a video."""
    av = require_module("av")

    def opened() -> Any:
        try:
            return av.open(str(path), metadata_errors="ignore")
        except (OSError, av.FFmpegError) as error:
            if _is_io_error(error):
                raise  # to be tried again
            raise UnitError(f"{path}: not a readable video ({error}). {ADVICE}") from error

    with retry(path, opened) as container:
        if not container.streams.video:
            raise UnitError(f"{path}: it has no video stream. {ADVICE}")
        if container.streams.video[0].codec_context is None:
            raise UnitError(f"{path}: the encoding of its video is not known. {ADVICE}")
        video = Video(path, container, hz)
        if not video.rate:
            raise UnitError(f"{path}: it has no frame rate. {ADVICE}")
        yield video
