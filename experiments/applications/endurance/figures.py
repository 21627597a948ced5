"""Curves over time, a line per variant, and pictures of the true simulator above the model's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from experiments.applications.endurance.films import SHOWN, Film
from experiments.applications.endurance.tables import Row, over_robots
from experiments.report.plot_style import CONTROL_LINE, MUTED, STYLE, save, show_legend

PANELS = {
    "psnr": ("PSNR against the truth (dB)", "psnr_still", "PSNR of a still picture"),
    "tool_close": ("tools found where they are (share)", "true_tool_close", "true simulator"),
    "object_found": ("objects found at all (share)", "", ""),
    "object_close": ("objects found where they are (share)", "true_object_close", "true simulator"),
    "follows": ("motion follows commands (correlation)", "true_follows", "true simulator"),
    "histogram": ("colours differ from the truth's (share)", "", ""),
}
"""Measure -> title, and the reference measure in the same panel with its label."""


def draw_curves(rows: Sequence[Row], path: Path) -> None:
    """Means over robots with 95 % intervals, by minute."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(2, 3, figsize=(11, 6), layout="constrained")
        variants = list(dict.fromkeys(str(row["variant"]) for row in rows))
        for panel, (name, (title, reference, reference_label)) in zip(panels.flat, PANELS.items(), strict=True):
            for variant in variants:
                t, mean, half = _curve([row for row in rows if row["variant"] == variant], name)
                (line,) = panel.plot(t, mean, marker="o", markersize=3, label=variant)
                panel.fill_between(t, mean - half, mean + half, color=line.get_color(), alpha=0.12, linewidth=0)
            if reference:
                t, mean, _ = _curve([row for row in rows if row["variant"] == variants[0]], reference)
                panel.plot(t, mean, **CONTROL_LINE, label=reference_label)
            panel.set(title=title, xlabel="minutes of simulated time", xlim=(0, None))
            if name != "psnr":
                panel.set_ylim(0, 1.02)
        words = "bands: 95 % intervals over robots, by Student's t, cut where shares and correlations end"
        figure.supxlabel(words, fontsize=8.5, color=MUTED)
        show_legend(figure, panels.flat)
        path.parent.mkdir(parents=True, exist_ok=True)
        save(figure, path)


def _curve(rows: Sequence[Row], name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(minutes, mean, half of the interval) at the end of each part that all robots have."""
    robots = {row["robot"] for row in rows}
    parts = [p for p in sorted({row["part"] for row in rows}) if {r["robot"] for r in rows if r["part"] == p} == robots]
    found = [over_robots([row for row in rows if row["part"] == p], name)[:2] for p in parts]
    minutes = np.array(parts, float) * float(rows[0]["seconds"]) / 60
    return minutes, *np.array(found).T


def draw_sheet(films: Mapping[str, Film], path: Path) -> None:
    """Two rows per robot, the truth above; columns at the same frames, `SHOWN`, of all."""
    columns = min(film.shown.shape[1] for film in films.values())
    rows = [np.concatenate(list(kind[:columns]), axis=1) for film in films.values() for kind in film.shown]
    sheet = Image.fromarray(np.concatenate(rows)).quantize(128, dither=Image.Dither.NONE)
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_suffix(".tmp.png")
    sheet.save(aside, optimize=True)
    aside.replace(path)


def shown_frames(films: Mapping[str, Film]) -> tuple[int, ...]:
    """Which frames the columns of a sheet are."""
    return SHOWN[: min(film.shown.shape[1] for film in films.values())]
