"""Small drawings inside a page: clips that play, curves, histograms. Self-contained HTML; nothing is fetched."""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np
from PIL import Image

from experiments.report.pieces import animation, moving

WIDTH = 300
"""Units of a drawing's width; pages scale it."""


def clip(frames: Sequence[np.ndarray], seconds: float, height: int, title: str) -> str:
    """Frames uint8 [H, W, 3] as an animated WebP of `height` pixels that takes `seconds` and starts again."""
    width = max(round(frames[0].shape[1] * height / frames[0].shape[0]), 1)
    # Small images keep their pixels; large ones are averaged.
    way = Image.Resampling.NEAREST if frames[0].shape[0] < height else Image.Resampling.BOX
    pictures = [Image.fromarray(frame).resize((width, height), way) for frame in frames]
    film = animation(pictures, max(round(1000 * seconds / len(pictures)), 20), quality=60, method=3)
    return moving(film, title, f"class=clip width={width} height={height}", lossless=False)


def curves(rows: np.ndarray, lows: Sequence[float], highs: Sequence[float], names: Sequence[str]) -> str:
    """The columns of `rows` [N, A] over time, one below the other, each between its `lows` and `highs`."""
    line, left = (26 if len(names) <= 8 else 16), 22
    parts = []
    at = np.unique(np.linspace(0, len(rows) - 1, WIDTH - left).round().astype(int))
    x = left + (WIDTH - left) * at / max(len(rows) - 1, 1)
    for d, name in enumerate(names):
        top, span = d * line, highs[d] - lows[d]
        values = np.asarray(rows[at, d], np.float64)
        parts.append(f"<text x=0 y={top + line / 2 + 4:g}>{html.escape(name)}</text>")
        if not span > 0:  # constant, or no finite number
            middle = top + line / 2
            parts.append(f"<line class=still x1={left} x2={WIDTH} y1={middle:g} y2={middle:g} />")
            continue
        y = top + line - 2 - (line - 4) * (values - lows[d]) / span
        pieces, points = [], []
        for px, py in zip(x.tolist(), y.tolist(), strict=True):
            if np.isfinite(py):
                points.append(f"{px:.1f},{py:.1f}")
            elif points:  # a gap where there is no number
                pieces, points = [*pieces, points], []
        parts += [f'<polyline points="{" ".join(piece)}" />' for piece in (*pieces, points)]
    return _svg(len(names) * line, parts, "curves", f"values over time: {', '.join(names)}")


def histogram(counts: Sequence[int], width: int = 96, height: int = 20) -> str:
    """Bars of `counts`."""
    if not any(counts):
        return ""
    step, most = width / len(counts), max(counts)
    bars = []
    for i, count in enumerate(counts):
        tall = max(height * count / most, 0.8) if count else 0
        place = f"x={i * step:.1f} y={height - tall:.1f} width={max(step - 0.8, 0.5):.1f} height={tall:.1f}"
        bars.append(f"<rect {place} />")
    size = f'width={width} height={height} viewBox="0 0 {width} {height}"'
    return f'<svg class=bars {size} role=img aria-label="histogram">{"".join(bars)}</svg>'


def lengths(steps: Sequence[int], needed: int | None) -> str:
    """A histogram of episode lengths in steps, with a line where a window of `needed` steps begins to fit."""
    low, high = min(steps), max(steps)
    high = max(high, low + 1, needed or 0)
    low = min(low, needed or low)
    counts, edges = np.histogram(steps, bins=min(30, high - low + 1), range=(low, high))
    tall, base, step = 64, 80, WIDTH / len(counts)
    parts = []
    for i, count in enumerate(counts):
        size = tall * count / counts.max()
        fits = needed is None or edges[i + 1] >= needed
        kind = "" if fits else " class=short"
        place = f"x={i * step:.1f} y={base - size:.1f} width={max(step - 1, 1):.1f} height={size:.1f}"
        parts.append(f"<rect{kind} {place} />")
    first, last = edges[0], edges[-1]
    parts.append(f"<text x=0 y={base + 13}>{first:g}</text>")
    parts.append(f"<text x={WIDTH} y={base + 13} text-anchor=end>{last:g} steps</text>")
    if needed is not None:
        x = WIDTH * (needed - first) / (last - first)
        side = "end" if x > WIDTH / 2 else "start"
        parts.append(f"<line class=mark x1={x:.1f} x2={x:.1f} y1=0 y2={base} />")
        label_x = x + (-4 if side == "end" else 4)
        parts.append(f"<text class=mark x={label_x:.1f} y=9 text-anchor={side}>one window: {needed}</text>")
    return _svg(base + 18, parts, "lengths", f"histogram of the lengths of episodes, {low:g} to {high:g} steps")


def _svg(height: float, parts: Sequence[str], kind: str, label: str) -> str:
    named = f'role=img aria-label="{html.escape(label)}"'
    return f'<svg class={kind} viewBox="0 0 {WIDTH} {height:g}" {named}>{"".join(parts)}</svg>'
