"""Curves over time, a line per variant, and pictures of the true simulator above the model's."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

from experiments.applications.endurance.films import SHOWN, Film
from experiments.applications.endurance.tables import Row, over_robots
from experiments.report.plot_style import CONTROL_LINE, STYLE, save, show_caption, show_legend
from hma_jax.runtime.files import write_file


class Panel(NamedTuple):
    title: str
    reference: str = ""
    """Measure of `REFERENCE` in the same panel."""
    ends: tuple[float, float] = (0.0, 1.0)
    """Range of the measure."""


PANELS = {
    "psnr": Panel("PSNR against the truth (dB)", "psnr_still", (-np.inf, np.inf)),
    "tool_close": Panel("tools found where they are (share)", "true_tool_close"),
    "object_found": Panel("objects found at all (share)"),
    "object_close": Panel("objects found where they are (share)", "true_object_close"),
    "follows": Panel("motion follows commands (correlation)", "true_follows", (-1.0, 1.0)),
    "histogram": Panel("colours differ from the truth's (share)"),
}
"""By measure. High values are good, but for colours."""

REFERENCE = "true simulator (PSNR: a still picture)"

CAPTION = (
    "bands: 95 % intervals over robots, by Student's t, cut where shares and correlations end; high values are good, but "
    "low ones for colours"
)


def draw_curves(rows: Sequence[Row], path: Path) -> None:
    """Means over robots with 95 % intervals, by minute."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(2, 3, figsize=(11, 6), layout="constrained")
        variants = list(dict.fromkeys(str(row["variant"]) for row in rows))
        for panel, (name, of) in zip(panels.flat, PANELS.items(), strict=True):
            lowest = 0.0
            for variant in variants:
                t, mean, half = _curve([row for row in rows if row["variant"] == variant], name)
                low, high = (np.clip(end, *of.ends) for end in (mean - half, mean + half))
                (line,) = panel.plot(t, mean, marker="o", markersize=3, label=variant)
                panel.fill_between(t, low, high, color=line.get_color(), alpha=0.12, linewidth=0)
                lowest = np.nanmin([lowest, *low, *mean])
            if of.reference:
                t, mean, _ = _curve([row for row in rows if row["variant"] == variants[0]], of.reference)
                panel.plot(t, mean, **CONTROL_LINE, label=REFERENCE)
            panel.set(title=of.title, xlabel="minutes of simulated time", xlim=(0, None))
            if np.isfinite(of.ends).all():
                panel.set_ylim(lowest - 0.02 * (lowest < 0), 1.02)
        show_caption(figure, CAPTION)
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
    content = io.BytesIO()
    sheet.save(content, "PNG", optimize=True)
    write_file(path, content.getvalue())


def shown_frames(films: Mapping[str, Film]) -> tuple[int, ...]:
    """The frames that the columns of a sheet show."""
    return SHOWN[: min(film.shown.shape[1] for film in films.values())]
