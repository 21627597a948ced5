"""What a visitor recorded, as a video and as an RLDS dataset."""

from __future__ import annotations

import io
import tempfile
import zipfile
from collections.abc import Iterable
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np

from data_pipelines.names import made_name
from data_pipelines.sources.convertible import require_module
from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.images import decode_image
from data_pipelines.sources.rlds.schema import RATE_KEY
from data_pipelines.sources.rlds.tfrecord import write_shard
from data_pipelines.sources.rlds.writer import (
    STEP_FIELDS,
    TEXT,
    Field,
    build_features,
    encode_jpeg,
    image_field,
    shard_name,
    step_features,
    vector_field,
    write_info,
)
from hma_jax.simulator.robots import Robot

MOST_FRAMES = 3000
"""A recording ends after this many frames: downloads of all visitors are encoded one after the other."""

MOST_BYTES = 2**26
"""A recording also ends after this many bytes of images, which are kept in memory."""

SHOWN = 2.0
"""Frames per second of a video of a robot whose own rate is unknown."""

ENLARGED = 4
"""Times that a frame's sides are longer in the video."""


class Recording:
    """Frames of one episode and the chunks between them, newest last. Frames are kept as JPEG, as in the dataset."""

    def __init__(self, robot: Robot):
        self.robot = robot
        self._images: list[bytes] = []
        self._chunks: list[np.ndarray] = []

    def __len__(self) -> int:
        return len(self._images)

    def add(self, before: np.ndarray, chunk: np.ndarray, after: np.ndarray) -> None:
        """Adds the frame `after` [H, W, 3] the `chunk` [stride, A], and the first time also the one `before`."""
        if not self._images:
            self._images.append(encode_jpeg(before))
        self._images.append(encode_jpeg(after))
        self._chunks.append(np.array(chunk, np.float32))

    @property
    def full(self) -> bool:
        """Whether it takes no further frames."""
        return len(self) >= MOST_FRAMES or sum(map(len, self._images)) >= MOST_BYTES

    def copy(self) -> Recording:
        """A copy of its present state for another thread to read, even while frames are being added or taken back."""
        other = Recording(self.robot)
        images, chunks = self._images[:], self._chunks[:]
        frames = min(len(images), len(chunks) + 1)
        other._images, other._chunks = images[:frames], chunks[: max(frames - 1, 0)]
        return other

    def drop(self, frames: int) -> None:
        """Removes the newest frames, or all if it has no more than these."""
        keep = len(self._images) - frames
        del self._images[max(keep, 0) :], self._chunks[max(keep - 1, 0) :]

    @property
    def rate(self) -> float | None:
        """Frames per second of the robot's own time; None if unknown."""
        return self.robot.hz / self.robot.stride or None

    def video(self) -> bytes:
        """MP4, enlarged, at the robot's own rate if it is known."""
        return encode_video(map(decode_image, self._images), self.rate or SHOWN)

    def dataset(self) -> bytes:
        """A zip of <robot>_played/1.0.0: one episode, a step per frame with the chunk that was executed after it.
        metadata.json gives the rate if it is known."""
        name = made_name(f"{self.robot.name}_played")
        height, width = decode_image(self._images[0]).shape[:2]
        chunk = self.robot.stride * self.robot.action_dim
        step = {"observation/image": image_field(height, width), "action": vector_field(chunk)} | STEP_FIELDS
        features = build_features(step, {"file_path": Field(TEXT)})
        steps = len(self._images)
        actions = np.zeros((steps, chunk), np.float32)
        actions[: steps - 1] = [c.ravel() for c in self._chunks]
        record = encode_example({
            **step_features(np.zeros(steps), [""] * steps),
            "steps/observation/image": self._images,
            "steps/action": actions.ravel(),
            "episode_metadata/file_path": [f"played/{self.robot.name}".encode()],
        })  # fmt: skip
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / name / "1.0.0"
            place.mkdir(parents=True)
            write_shard(place / shard_name(name, 0, 1), [record])
            write_info(
                place, name=name, features=features, splits={"train": ([1], len(record))},
                description=f"One episode of {self.robot.name}, played by hand in a learned simulator.",
                metadata={**({RATE_KEY: self.rate} if self.rate else {}), "stride": self.robot.stride, "generated": True},
                module="experiments.applications.play",
            )  # fmt: skip
            return _zipped(Path(folder))


def encode_video(images: Iterable[np.ndarray], rate: float) -> bytes:
    """MP4 of frames uint8 [H, W, 3], enlarged, `rate` of them per second. Raises ConfigError if PyAV is missing."""
    av = require_module("av", "a video")
    file = io.BytesIO()
    large = (image.repeat(ENLARGED, 0).repeat(ENLARGED, 1) for image in images)
    first = next(large)
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(rate).limit_denominator(1000))
        stream.height, stream.width = first.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": "16"}
        for image in chain([first], large):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    return file.getvalue()


def _zipped(folder: Path) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.write(path, path.relative_to(folder))
    return file.getvalue()
