"""Episodes of human video: the positions of both hands in the image are the state, their next positions the action.

A position row is [left x, left y, right x, right y] as fractions of the image's width and height,
from its top left corner; NaN where a hand is not seen. An episode is a run of frames, evenly
spaced in time, in each of which both hands are seen; nothing is joined over a gap. Its state is the row of the frame,
its action is made from this row and the next one, so the last frame of a run is only a target. Long runs are cut into
equal pieces without losing a step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import pairwise

import numpy as np

from data_pipelines.sources.convertible import Episode, Layout, Skipped
from data_pipelines.sources.rlds.writer import image_field

IMAGE, STATE, ACTION = "observation/image", "observation/state", "action"
LAYOUT = Layout({IMAGE: image_field(None, None)}, {ACTION: 4, STATE: 4}, knows_success=False)

TEXT = "use both hands"

NONE = "no frame with both hands"

Reader = Callable[[np.ndarray], list[bytes]]
"""Encoded frames at these row numbers."""


def runs(seen: np.ndarray) -> list[tuple[int, int]]:
    """[start, stop) of each maximal run of True in bool [N]."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def both_seen(positions: np.ndarray) -> np.ndarray:
    """bool [N]: both hands are there, inside the image."""
    with np.errstate(invalid="ignore"):
        return ((positions >= 0) & (positions <= 1)).all(axis=1)


def displacement(now: np.ndarray, following: np.ndarray) -> np.ndarray:
    return following - now


def destination(now: np.ndarray, following: np.ndarray) -> np.ndarray:
    del now
    return following


def cut_episodes(
    positions: np.ndarray,
    read_frames: Reader,
    *,
    action: Callable[[np.ndarray, np.ndarray], np.ndarray],
    min_frames: int,
    max_steps: int,
    origin: Callable[[int], str],
) -> Iterator[Episode | Skipped]:
    """The episodes in [N, 4] positions of evenly spaced frames; `origin` names an episode by its first row."""
    found = runs(both_seen(positions))
    if not found:
        yield Skipped(NONE)
    for start, stop in found:
        if stop - start < min_frames:
            yield Skipped(f"fewer than {min_frames} frames in a row with both hands")
            continue
        # Equal pieces that share the frame between them: the last action of one leads to the first row
        # of the next.
        steps = stop - 1 - start
        bounds = np.linspace(start, stop - 1, -(-steps // max_steps) + 1).round().astype(int)
        for first, last in pairwise(bounds):
            rows = positions[first : last + 1]
            yield Episode(
                origin=origin(int(first)),
                images={IMAGE: read_frames(np.arange(first, last))},
                vectors={STATE: rows[:-1], ACTION: action(rows[:-1], rows[1:])},
                instructions=[TEXT] * int(last - first),
            )
