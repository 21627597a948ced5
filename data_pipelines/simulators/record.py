"""An episode of a simulator as the bytes of one RLDS record, and the features it declares."""

from __future__ import annotations

from typing import Any

import numpy as np

from data_pipelines.simulators.episode import Episode
from data_pipelines.simulators.spec import SimSpec
from data_pipelines.sources.rlds import writer as rlds_writer
from data_pipelines.sources.rlds.example import encode_example
from data_pipelines.sources.rlds.writer import (
    STEP_FIELDS,
    TEXT,
    Field,
    encode_jpeg,
    image_field,
    step_features,
    vector_field,
)

IMAGE_KEY = "image"
START_KEY = "episode_metadata/start"


def instruction(spec: SimSpec, env: str) -> str:
    """What the robot was to do, in words."""
    return spec.instruction or env.split("/")[-1].split("-v")[0].replace("-", " ").replace("_", " ")


def encode_episode(spec: SimSpec, episode: Episode, index: int) -> bytes:
    """The record of episode `index`; equal episodes give equal bytes."""
    steps = len(episode.actions)
    text = instruction(spec, episode.start.env)
    features = step_features(episode.rewards, [text] * steps) | {
        f"steps/observation/{IMAGE_KEY}": [encode_jpeg(f) for f in episode.frames],
        "steps/observation/state": episode.states.ravel(),
        "steps/action": episode.actions.ravel(),
        "steps/is_terminal": np.zeros(steps, np.int64),  # the clock cuts episodes; none ends by itself
        "episode_metadata/file_path": [f"sim/{spec.name}/{index:06d}".encode()],
        "episode_metadata/seed": np.array([episode.start.seed], np.int64),
        START_KEY: [episode.start.to_json().encode()],
    }
    if spec.success:
        features["episode_metadata/success"] = np.array([episode.success], np.int64)
    return encode_example(features)


def build_features(spec: SimSpec, size: int, states: int) -> Any:
    """The tfds features of these records; `states` is S, `size` that of the frames."""
    step = STEP_FIELDS | {
        f"observation/{IMAGE_KEY}": image_field(size, size),
        "observation/state": vector_field(states),
        "action": vector_field(spec.action_dim),
    }
    episode = {"file_path": Field(TEXT), "seed": Field("int64"), "start": Field(TEXT)}
    if spec.success:
        episode["success"] = Field("bool")
    return rlds_writer.build_features(step, episode)
