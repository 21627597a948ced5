"""HTML elements of the report: sections, cards, tables, numbers with errors, pictures."""

from __future__ import annotations

import base64
import html
import io
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from experiments import words
from experiments.rows import CurvePoint


def section(title: str, *parts: str) -> str:
    return f"<section><h2>{html.escape(title)}</h2>{''.join(parts)}</section>"


def card(label: str, point: CurvePoint | None, note: str) -> str:
    value = pm(point.mean, point.sem) if point else "–"
    label, note = html.escape(label), html.escape(note)
    return f"<div class=card><small>{label}</small><b>{value}</b><small>{note}</small></div>"


def table(head: Sequence[str], lines: Iterable[Sequence[str]], text: int = 1) -> str:
    """Cells are HTML already, headings are not. The first `text` columns are words, the rest numbers."""

    def row(tag: str, cells: Sequence[str]) -> str:
        kinds = [" class=text" if i < text else "" for i in range(len(cells))]
        return "<tr>" + "".join(f"<{tag}{k}>{c}</{tag}>" for k, c in zip(kinds, cells, strict=True)) + "</tr>"

    heading = row("th", [html.escape(h) for h in head])
    body = "".join(row("td", line) for line in lines)
    return f"<div class=scroll><table><thead>{heading}</thead><tbody>{body}</tbody></table></div>"


def pm(mean: float, error: float) -> str:
    """Mean ± standard error, with the digits that the error leaves meaningful."""
    if not 0 < error < math.inf:  # also nan
        return f"{mean:.4g}".replace("-", "\u2212")
    return f"{number(mean, error)} <span class=sem>± {number(error, error)}</span>"


def number(value: float, error: float) -> str:
    """`words.number` with a minus sign as it is set in print."""
    return words.number(value, error).replace("-", "\u2212")


def picture(path: Path, title: str) -> str:
    if not path.exists():
        return ""
    source = data_uri(path.read_bytes())
    return f'<div class=scroll><img class=plot alt="{html.escape(title)}" src="{source}"></div>'


def frames(clip: np.ndarray, prompt: int) -> str:
    """One row of frames [T, height, width, 3] as an image; a wider gap follows the prompt."""
    count, height, width, _ = clip.shape
    gap, wide = max(width // 16, 1), max(width // 4, 2)
    starts = [t * (width + gap) + (wide if t >= prompt else 0) for t in range(count)]
    row = np.zeros((height, starts[-1] + width, 4), np.uint8)
    for start, frame in zip(starts, clip, strict=True):
        row[:, start : start + width, :3] = frame
        row[:, start : start + width, 3] = 255
    buffer = io.BytesIO()
    Image.fromarray(row).save(buffer, format="PNG", optimize=True)
    return f'<img alt="" src="{data_uri(buffer.getvalue())}">'


def data_uri(picture: bytes, kind: str = "png") -> str:
    return f"data:image/{kind};base64," + base64.b64encode(picture).decode()
