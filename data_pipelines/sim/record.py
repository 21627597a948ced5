"""An episode of a simulator as the bytes of one RLDS record, and the features it declares."""

from __future__ import annotations

from typing import Any

import numpy as np
import simplejpeg

from data_pipelines.example import encode_example
from data_pipelines.sim.episode import Episode
from data_pipelines.sim.spec import SimSpec
from data_pipelines.suite.write import JPEG_QUALITY

IMAGE_KEY = "image"
START_KEY = "episode_metadata/start"


def instruction(spec: SimSpec, env: str) -> str:
    """What the robot was to do, in words."""
    return spec.instruction or env.split("/")[-1].split("-v")[0].replace("-", " ").replace("_", " ")


def encode_frame(frame: np.ndarray) -> bytes:
    """The JPEG of uint8 [H, W, 3]."""
    return simplejpeg.encode_jpeg(np.ascontiguousarray(frame), quality=JPEG_QUALITY, colorsubsampling="444")


def encode_episode(spec: SimSpec, episode: Episode, index: int) -> bytes:
    """The record of episode `index`; equal episodes give equal bytes."""
    steps = len(episode.actions)
    flags = np.zeros((2, steps), np.int64)
    flags[0, 0] = flags[1, -1] = 1
    features: dict[str, np.ndarray | list[bytes]] = {
        f"steps/observation/{IMAGE_KEY}": [encode_frame(frame) for frame in episode.frames],
        "steps/observation/state": episode.states.ravel(),
        "steps/action": episode.actions.ravel(),
        "steps/discount": np.ones(steps, np.float32),
        "steps/reward": episode.rewards,
        "steps/is_first": flags[0],
        "steps/is_last": flags[1],
        "steps/is_terminal": np.zeros(steps, np.int64),  # cut by the clock, none ends by itself
        "steps/language_instruction": [instruction(spec, episode.start.env).encode()] * steps,
        "episode_metadata/file_path": [f"sim/{spec.name}/{index:06d}".encode()],
        "episode_metadata/seed": np.array([episode.start.seed], np.int64),
        START_KEY: [episode.start.to_json().encode()],
    }
    if spec.success:
        features["episode_metadata/success"] = np.array([episode.success], np.int64)
    return encode_example(features)


def build_features(spec: SimSpec, size: int, states: int) -> Any:
    """The tfds features of these records; `states` is S, `size` that of the frames."""
    # Costs over a second and is not needed to simulate or to read the table.
    from tensorflow_datasets import features as tf

    def tensor(length: int) -> Any:
        return tf.Tensor(shape=(length,), dtype=np.float32)

    image = tf.Image(shape=(size, size, 3), dtype=np.uint8, encoding_format="jpeg")
    flag = {key: tf.Scalar(dtype=np.bool_) for key in ("is_first", "is_last", "is_terminal")}
    step = {
        "observation": tf.FeaturesDict({IMAGE_KEY: image, "state": tensor(states)}),
        "action": tensor(spec.action_dim),
        "discount": tf.Scalar(dtype=np.float32),
        "reward": tf.Scalar(dtype=np.float32),
        "language_instruction": tf.Text(),
    }
    episode = {"file_path": tf.Text(), "seed": tf.Scalar(dtype=np.int64), "start": tf.Text()}
    if spec.success:
        episode["success"] = tf.Scalar(dtype=np.bool_)
    return tf.FeaturesDict(
        {"steps": tf.Dataset(step | flag), "episode_metadata": tf.FeaturesDict(episode)}
    )
