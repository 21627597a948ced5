"""Counterfactual frames: recorded episodes of the suite, simulated from their start under other actions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from data_pipelines.sources.rlds.images import decode_image, fit_image
from data_pipelines.sources.rlds.writer import encode_jpeg
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.rollout import simulate
from data_pipelines.suite.spec import EmbodimentSpec


def frames_under(
    spec: EmbodimentSpec, seeds: Sequence[int], actions: Sequence[np.ndarray], times: np.ndarray, size: int
) -> np.ndarray:
    """uint8 [n, k, size, size, 3]: the frames before native steps `times` [n, k] of the episodes with these seeds.

    Episode i executes `actions[i]`, float32 [>= max(times[i]), A]. The frames are as they would be recorded and read:
    JPEG, then resized. Under an episode's own actions these are its frames, pixel by pixel.
    """
    steps = int(times.max()) + 1
    executed = np.zeros((len(seeds), steps, spec.action_dim), np.float32)
    for row, own in zip(executed, actions, strict=True):
        row[: len(own)] = own[:steps]
    rollout = simulate(spec, seeds, executed)
    rows, columns = np.repeat(np.arange(len(seeds)), times.shape[1]), times.ravel()
    looks, q, objects = draw_appearance(spec, rollout.seeds), rollout.q[rows, columns], rollout.objects[rows, columns]
    frames = render_frames(spec, looks, rollout.goals, q, objects, rows)
    seen = [fit_image(decode_image(encode_jpeg(frame)), size) for frame in frames]
    return np.stack(seen).reshape(*times.shape, size, size, 3)
