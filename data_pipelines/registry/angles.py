"""Wrapping angles in actions: they jump by a whole turn while the motion is continuous.

Such values lie near both ends of their range, so their means and differences are meaningless. An entry names the
values that are angles, and they are then given unwrapped, or as sine and cosine, which do not jump.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

AngleForm = Literal["as_recorded", "unwrapped", "sine_cosine"]
AngleUnit = Literal["radian", "degree", "turn"]

TURN: dict[AngleUnit, float] = {"radian": 2 * np.pi, "degree": 360.0, "turn": 1.0}
"""One whole turn in each unit."""


RECOGNISED: tuple[AngleUnit, ...] = ("radian", "degree")
"""Units of wrapping angles that are found in data. (An angle in turns cannot be distinguished from a switch.)"""

SWITCH_SHARE = 0.8
"""A value that takes one of two numbers in at least this share of the steps is a switch, not an angle."""


def count_jumps(actions: np.ndarray, unit: AngleUnit) -> np.ndarray:
    """int64 [2, A]: how often each value of an episode's actions [N, A] changes from one step to the next by more than
    half a turn, and by more than 0.9 of a turn."""
    changes = np.abs(np.diff(actions, axis=0)) / TURN[unit]
    return np.stack([(changes > 0.5).sum(0), (changes > 0.9).sum(0)])


def find_turns(low: np.ndarray, high: np.ndarray, jumps: np.ndarray, unit: AngleUnit) -> np.ndarray:
    """bool [A]: which values stay within one turn, centred at 0 or starting at 0, and jump from one end of it to the
    other.

    `low`, `high` [A]: the smallest and the largest of each value; `jumps` [2, A]: the sum of `count_jumps` over
    episodes. Noise in that range jumps by a whole turn too, but more often by less: a wrapping value moves by a little
    or by nearly a whole turn.
    """
    turn = TURN[unit]
    near = 0.002 * turn
    about_zero = (low > -turn / 2 - near) & (high < turn / 2 + near)
    from_zero = (low > -near) & (high < turn + near)
    large, whole = jumps
    return (about_zero | from_zero) & (whole >= 2) & (2 * whole >= large)


def angle_lines(values: Sequence[int], unit: AngleUnit) -> str:
    """What an entry says about such values, in words."""
    also = "" if unit == "radian" else f' and angle_unit = "{unit}"'
    return f'angles = [{", ".join(map(str, values))}] and angle_form = "sine_cosine" (or "unwrapped"){also}'


def angle_width(width: int, angles: Sequence[int], form: AngleForm) -> int:
    """Number of values of an action that was recorded with `width` values, if its `angles` are given as `form`."""
    return width + (len(angles) if form == "sine_cosine" else 0)


def convert_angles(actions: np.ndarray, angles: Sequence[int], form: AngleForm, unit: AngleUnit) -> np.ndarray:
    """float32 [N, A'] from the actions of one episode [N, A] in order, with the columns `angles` as `form`.

    `unwrapped`: a step of more than half a turn becomes the shorter way round, counted from the
    episode's first value, which stays as it is; the unit stays too. `sine_cosine`: the sine stands
    where the angle stood and the cosine behind it, so that A' = A + len(angles).
    """
    if form == "as_recorded" or not angles:
        return np.asarray(actions, np.float32)
    columns = []
    for d in range(actions.shape[1]):
        values = actions[:, d].astype(np.float64)
        if d not in angles:
            columns.append(values)
        elif form == "unwrapped":
            columns.append(np.unwrap(values, period=TURN[unit]))
        else:
            phase = values * (2 * np.pi / TURN[unit])
            columns += [np.sin(phase), np.cos(phase)]
    return np.stack(columns, axis=1).astype(np.float32)
