"""Figures of generated trajectories and of what policies learn from them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from experiments.analysis.intervals import Interval
from experiments.report.plot_style import COLOURS, INK, MUTED, STYLE, plt, save

SHOWN = 7
"""Frames of a trajectory, from its first to its last."""


def draw_conditions(
    found: Mapping[str, Interval],
    seeds: Sequence[Sequence[float]],
    control: Collection[int],
    ends: Collection[int],
    path: Path,
    what: str,
) -> None:
    """Success or action error by condition: a bar with its interval, a dot for every seed. `control` and `ends`: places
    of those that are not trained on generated trajectories."""
    most, label = {"success": (1, "success in the true simulator"), "error": (None, "action error, held out")}[what]
    with plt.rc_context(STYLE):
        figure, panel = plt.subplots(figsize=(1.1 * max(len(found), 6.5), 3.4), layout="constrained")
        places, mean = np.arange(len(found)), np.array([r.mean for r in found.values()])
        low, high = (np.clip([getattr(r, end) for r in found.values()], 0, most) for end in ("low", "high"))
        colours = [
            COLOURS["delta_psnr"] if i in control else MUTED if i in ends else COLOURS["perplexity"] for i in places
        ]
        panel.bar(places, mean, color=colours, width=0.62)
        panel.errorbar(places, mean, [mean - low, high - mean], fmt="none", color=INK, capsize=3)
        for i, means in zip(places, seeds, strict=True):
            panel.plot(np.full(len(means), i + 0.2), means, "o", color=INK, markersize=3)
        panel.set_xticks(places, [wrapped(name) for name in found])
        panel.set(ylim=(0, most), ylabel=label)
        panel.grid(False, axis="x")
        save(figure, path)


def wrapped(name: str) -> str:
    for words in (" generated", " without", " first", " only"):
        name = name.replace(words, "\n" + words[1:])
    return name.replace(", ", ",\n")


def draw_strips(images: Sequence[np.ndarray], names: Sequence[str], path: Path) -> None:
    """Some frames of N trajectories uint8 [N, L, H, W, 3], of each as several kinds show it."""
    count, frames = images[0].shape[:2]
    chosen = np.linspace(0, frames - 1, min(SHOWN, frames)).round().astype(int)
    with plt.rc_context(STYLE | {"axes.grid": False}):
        size = (0.9 * len(chosen) + 0.9, 0.9 * count * len(names))
        figure, panels = plt.subplots(count * len(names), 1, figsize=size, layout="constrained", squeeze=False)
        for i, panel in enumerate(panels[:, 0]):
            kind = i % len(names)
            panel.imshow(np.concatenate(images[kind][i // len(names), chosen], axis=1), interpolation="nearest")
            panel.set_xticks([])
            panel.set_yticks([])
            panel.set_ylabel(names[kind], rotation=0, ha="right", va="center")
        save(figure, path)
