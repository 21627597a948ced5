"""Writing the video of one camera."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

from data_pipelines.export.statistics import PixelCounts, Statistics
from data_pipelines.sources.source import SourceFrame, decode_frame

SAMPLED = 128
"""At most about this many frames of an episode are counted in a camera's statistics."""

ENCODING = {"crf": "18", "g": "2", "bf": "0"}
"""Every second frame can be decoded without others: policies are trained on frames in random order."""


class VideoWriter:
    """The video `path`, of `hz` frames per second, while it is written. Needs the extra `convert`."""

    def __init__(self, path: Path, hz: float):
        self.path = path
        self._rate = Fraction(hz).limit_denominator(1000)

    def __enter__(self) -> VideoWriter:
        import av

        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(self.path), "w", format="mp4")
        self._stream = self._container.add_stream("libx264", rate=self._rate, options=dict(ENCODING))
        self._begun = False
        return self

    def add(self, frames: Sequence[SourceFrame]) -> Statistics:
        """Adds the frames of the next episode; returns their statistics."""
        import av

        counts, every = PixelCounts(), max(len(frames) // SAMPLED, 1)
        for step, frame in enumerate(frames):
            image = decode_frame(frame, ValueError)
            if not self._begun:
                self._stream.height, self._stream.width = image.shape[:2]
                self._stream.pix_fmt, self._begun = pixel_format(*image.shape[:2]), True
            if step % every == 0:
                counts.add(image)
            self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        return counts.statistics()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None and self._begun:
            self._container.mux(self._stream.encode())
        self._container.close()


def pixel_format(height: int, width: int) -> str:
    """Colours at half resolution, which every player decodes, need even sizes."""
    return "yuv444p" if height % 2 or width % 2 else "yuv420p"
