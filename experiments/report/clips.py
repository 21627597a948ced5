"""Clips that play: what was recorded, what was predicted, and what was predicted under other actions.

One animation per robot shows the three side by side, so that they stay in step, with a bar that fills as time passes:
grey while frames are given, coloured while they are predicted. On paper, where nothing plays, frames are shown in rows.
"""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from experiments.report.pieces import STILL, animation, frames, moving

KINDS = {"true": "recorded", "predicted": "predicted", "random": "other actions"}
"""Keys of samples.npz, with their captions."""

SHOWN, ON_PAPER = 12, 4
"""Number of robots whose clips are visible at once (the others unfold), and of those whose frames are printed."""

SHOW_MS, HOLD_MS = 260, 1100
"""Milliseconds of a frame, and of the last one."""

GIVEN, PREDICTED, REST = (150, 156, 163), (43, 92, 138), (228, 231, 234)
BAR = 2
"""Pixels of the bar's height; a line of white above it."""


def describe_clips(path: Path, prompt: int, order: Sequence[str]) -> str:
    """The first window of each dataset of samples.npz, in the given order. `prompt`: frames that are given."""
    with np.load(path) as samples:
        names = {key.split("/")[0] for key in samples.files}
        chosen = [n for n in order if n in names]
        clips = {n: {k: samples[f"{n}/{k}"][0] for k in KINDS if f"{n}/{k}" in samples.files} for n in chosen}
    figures = [_figure(name, kinds, prompt) for name, kinds in clips.items()]
    rest = "".join(figures[SHOWN:])
    more = f"<details class=more><summary>{len(figures) - SHOWN} more robots</summary><div class=trios>{rest}</div></details>"
    printed = ((name, {KINDS[k]: clip for k, clip in kinds.items()}) for name, kinds in list(clips.items())[:ON_PAPER])
    paper = "".join(strip(name, rows, prompt) for name, rows in printed)
    return (
        f"<p>The first validation window of each robot. Of its frames the first {prompt} are given (grey bar); the "
        "rest is predicted from actions alone: once from those that were recorded, once from others, drawn at random. "
        "Where the model listens, the right clip leaves the left one and the middle one stays with it.</p>"
        f"{STILL}<div class=trios>{''.join(figures[:SHOWN])}</div>{more if rest else ''}<div class=paper>{paper}</div>"
    )


def _figure(name: str, kinds: dict[str, np.ndarray], prompt: int) -> str:
    captions = "".join(f"<span>{KINDS[k]}</span>" for k in kinds)
    height, width = next(iter(kinds.values())).shape[1:3]
    size = f'style="aspect-ratio: {len(kinds) * width + (len(kinds) - 1) * _gap(width)} / {height + BAR + 1}"'
    alt = f"{name}, a window of validation, side by side: {', '.join(KINDS[k] for k in kinds)}"
    return (
        f"<figure class=trio><figcaption>{html.escape(name)}</figcaption>"
        f"{moving(animate(list(kinds.values()), prompt), alt, size)}<div>{captions}</div></figure>"
    )


def _gap(width: int) -> int:
    return max(width // 16, 1)


def animate(clips: Sequence[np.ndarray], prompt: int) -> bytes:
    """Clips uint8 [T, H, W, 3] side by side as a lossless animated WebP: small images are shown enlarged."""
    count, height, width, _ = clips[0].shape
    gap = _gap(width)
    whole = len(clips) * width + (len(clips) - 1) * gap
    pictures = []
    for t in range(count):
        picture = np.full((height + BAR + 1, whole, 3), 255, np.uint8)
        for i, clip in enumerate(clips):
            picture[:height, i * (width + gap) : i * (width + gap) + width] = clip[t]
        picture[-BAR:] = REST
        past, given = (round(whole * n / count) for n in (t + 1, min(t + 1, prompt)))
        picture[-BAR:, :past], picture[-BAR:, :given] = PREDICTED, GIVEN
        pictures.append(Image.fromarray(picture))
    return animation(pictures, [SHOW_MS] * (count - 1) + [HOLD_MS], lossless=True, method=4, quality=80)


def strip(title: str, rows: Mapping[str, np.ndarray], prompt: int) -> str:
    """Rows of frames, for paper: label -> clip."""
    lines = "".join(f"<div><span>{label}</span>{frames(clip, prompt)}</div>" for label, clip in rows.items())
    return f"<figure class=strip><figcaption>{html.escape(title)}</figcaption>{lines}</figure>"
