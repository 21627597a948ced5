"""The scatter plot of a judgement: success in the model against success in the true world, a point for each policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation, Text

from experiments.applications.judging.ladder import kind_of
from experiments.applications.judging.summary import CONTROL, MODEL, REAL, REFERENCE
from experiments.applications.policies.kinds import KINDS
from experiments.report.plot_style import INK, MUTED, STYLE, save, show_caption

COLOURS = {
    **{name: (kind.legend, kind.colour) for name, kind in KINDS.items()},
    "own": ("green: your own", "#2f7d4f"),
    "": ("grey: others", MUTED),
}
"""Kind of a policy -> its name in the caption, and its colour."""

BESIDE = ((4, 4), (-4, 4), (4, -4), (-4, -4))
AWAY = tuple(
    (across * far, up * far)
    for far in (10, 16, 24, 34, 48)
    for across, up in (
        (0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, 1), (1, -1), (-1, -1),
        (0.3, 1), (-0.3, 1), (0.3, -1), (-0.3, -1), (1, 0.3), (-1, 0.3), (1, -0.3), (-1, -0.3),
    )
)  # fmt: skip
"""Where a name may be placed, in printer's points from its point: at a corner of it, or else further away with a
line."""

ACROSS, UP = {-1: "right", 0: "center", 1: "left"}, {-1: "top", 0: "center", 1: "bottom"}
"""The part of a name that is nearest to its point, by the direction in which the name is placed."""

NEAR, MARKER = 7, 4
"""Distance in pixels from another policy's point within which a name could be taken for that policy's, and a line would
touch the point."""

NO_ROOM = "names that find no room are in the table"

AXES = {
    REFERENCE: "success in the true simulator, by its state",
    REAL: "success of the real robot",
    CONTROL: "success in the control: actions of other episodes, by the head",
}
"""Labels of the horizontal axis."""


def draw_scatter(summary: dict[str, Any], path: Path) -> None:
    """Success in the learned world, and in the control, against the reference (the true simulator or the real robot), a
    point for each policy; without a reference, against each other."""
    across = summary["compared with"] or CONTROL
    titles = {MODEL: "learned model", CONTROL: "control: actions of other episodes"}
    upwards = [column for column in titles if column != across]
    kinds = {name: "own" if name in summary["own"] else kind_of(name) for name in summary["policies"]}
    kinds = {name: kind if kind in COLOURS else "" for name, kind in kinds.items()}
    legend = ", ".join(words for kind, (words, _) in COLOURS.items() if kind in kinds.values())
    caption = f"lines: 95 % intervals; {legend}"
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            1, len(upwards), figsize=(4.8 * len(upwards), 4.7), sharex=True, sharey=True, squeeze=False
        )
        named: list[list[Annotation]] = []
        for panel, column in zip(panels[0], upwards, strict=True):
            panel.plot([0, 1], [0, 1], color=MUTED, linewidth=1, zorder=1)
            points = {}
            for name, rates in summary["policies"].items():
                x, y = rates[across], rates[column]
                if x["mean"] is None:  # not counted on the real robot
                    continue
                across_error, up_error = (
                    np.maximum([[r["mean"] - r["low"]], [r["high"] - r["mean"]]], 0) for r in (x, y)
                )
                look = {"fmt": "o", "color": COLOURS[kinds[name]][1], "elinewidth": 0.8, "markersize": 5}
                panel.errorbar(x["mean"], y["mean"], xerr=across_error, yerr=up_error, **look)
                points[name] = x["mean"], y["mean"]
            panel.set(xlim=(-0.03, 1.03), ylim=(-0.03, 1.03), title=titles[column], xlabel=AXES[across])
            named.append(name_points(panel, points, summary["own"]))
        panels[0, 0].set_ylabel("success in the model, by the head")
        for said in (caption, f"{caption}; {NO_ROOM}"):
            show_caption(figure, said)
            figure.tight_layout()
            figure.canvas.draw()
            placed = [place(words, panel) for panel, words in zip(panels[0], named, strict=True)]
            if all(placed):
                break
        save(figure, path)


def name_points(panel: Axes, points: Mapping[str, tuple[float, float]], first: Sequence[str]) -> list[Annotation]:
    """The names of policies at (x, y), one text for those whose points coincide; those of `first` come first."""
    at: dict[tuple[float, float], list[str]] = {}
    for name in sorted(points, key=lambda name: name not in first):
        at.setdefault(points[name], []).append(name)
    return [
        panel.annotate(
            ", ".join(names), point, BESIDE[0], textcoords="offset points", fontsize=7, color=INK, in_layout=False,
            path_effects=[withStroke(linewidth=2, foreground="white")],  # interval lines run below it
            arrowprops={"arrowstyle": "-", "color": MUTED, "linewidth": 0.6, "shrinkA": 0, "shrinkB": 3},
        )
        for point, names in at.items()
    ]  # fmt: skip


def place(words: Sequence[Annotation], panel: Axes) -> bool:
    """Moves each name to a place where neither it nor the line to its point comes near another point or covers an
    earlier name. Hides names without such a place; returns whether all have one."""
    points_N2 = panel.transData.transform([word.xy for word in words])
    names_K4, pixels = np.empty((0, 4)), panel.figure.dpi / 72
    for word, own in zip(words, points_N2, strict=True):
        others = points_N2[(points_N2 != own).any(1)]
        word.set_visible(True)  # hidden names have no size
        size = Text.get_window_extent(word).size  # without the line
        for offset in BESIDE + AWAY:
            towards = np.sign(offset)
            low = own + np.multiply(offset, pixels) + (towards - 1) / 2 * size
            high = low + size
            line_L2 = own + np.linspace(0, 1, 40)[:, None] * ((low + high) / 2 - own)  # drawn as far as the name
            inside = (low >= panel.bbox.min).all() and (high <= panel.bbox.max).all()
            near, crossed = _boxes(others, NEAR), np.concatenate([names_K4, _boxes(others, MARKER)])
            if inside and not (_meet(low, high, np.concatenate([names_K4, near])) or _cross(line_L2, crossed)):
                names_K4 = np.concatenate([names_K4, [[*low, *high]]])
                word.xyann = offset
                word.set(ha=ACROSS[towards[0]], va=UP[towards[1]])
                word.arrow_patch.set_visible(offset in AWAY)
                break
        else:
            word.set_visible(False)
    return len(names_K4) == len(words)


def _boxes(points_N2: np.ndarray, half: float) -> np.ndarray:
    """[N, 4] squares around points: left, bottom, right, top."""
    return np.concatenate([points_N2 - half, points_N2 + half], 1)


def _meet(low: np.ndarray, high: np.ndarray, boxes_N4: np.ndarray) -> bool:
    return bool(((low < boxes_N4[:, 2:]) & (high > boxes_N4[:, :2])).all(1).any())


def _cross(line_L2: np.ndarray, boxes_N4: np.ndarray) -> bool:
    return any(_meet(point, point, boxes_N4) for point in line_L2)
