"""HTML elements of the report: sections, cards, tables, numbers with errors, pictures."""

from __future__ import annotations

import base64
import html
import io
import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from experiments.analysis.rows import CurvePoint
from experiments.terminal.words import number

STILL = (
    "<p class=pause><input type=checkbox id=pause> <label for=pause>clips stand still, at their last frame</label></p>"
)
"""The element that stops all clips of a page (`moving`); without it they stand still if the system asks for less
motion."""


def section(title: str, *parts: str) -> str:
    anchor = re.sub(r"\W+", "-", title.lower()).strip("-")
    return f'<section id="section-{anchor}"><h2>{html.escape(title)}</h2>{"".join(parts)}</section>'


def contents(page: str) -> str:
    """Links to the sections of a page."""
    found = re.findall(r'<section id="(section-[^"]*)"><h2>(.*?)</h2>', page)
    links = "".join(f'<li><a href="#{anchor}">{title}</a></li>' for anchor, title in found)
    return f'<nav aria-label="sections"><ul>{links}</ul></nav>'


def card(label: str, point: CurvePoint | None, note: str) -> str:
    value = pm(point.mean, point.sem) if point else "–"
    label, note = html.escape(label), html.escape(note)
    return f"<div class=card><small>{label}</small><b>{value}</b><small>{note}</small></div>"


def table(head: Sequence[str], lines: Iterable[Sequence[str]], text: int = 1) -> str:
    """Cells are HTML already, headings are not. The first `text` columns are words, the rest numbers. The first cell of
    a line is its heading."""

    def cell(tag: str, i: int, content: str, scope: str = "") -> str:
        return f"<{tag}{scope}{' class=text' if i < text else ''}>{content}</{tag}>"

    def row(line: Sequence[str]) -> str:
        first, *others = line
        return cell("th", 0, first, " scope=row") + "".join(cell("td", i, c) for i, c in enumerate(others, 1))

    heading = f"<tr>{''.join(cell('th', i, html.escape(h), ' scope=col') for i, h in enumerate(head))}</tr>"
    body = "".join(f"<tr>{row(line)}</tr>" for line in lines)
    return f"<div class=scroll><table><thead>{heading}</thead><tbody>{body}</tbody></table></div>"


def pm(mean: float, error: float) -> str:
    """Mean ± standard error, with the digits that the error leaves meaningful."""
    if not 0 < error < math.inf:  # also nan
        return f"{mean:.4g}".replace("-", "\u2212")
    value = number(mean, error).replace("-", "\u2212")
    return f"{value}\u00a0<span class=sem>±\u00a0{number(error, error)}</span>"


def picture(path: Path, alt: str) -> str:
    """A figure; '' without its file. `alt`: the text for readers who do not see it."""
    if not path.exists():
        return ""
    content = path.read_bytes()
    with Image.open(io.BytesIO(content)) as image:
        inches = image.width / image.info.get("dpi", (96,))[0]
    # On a phone a figure scrolls at three quarters of its size: its text of 10 points is 10 pixels high.
    wide = f"--wide: {72 * inches:.0f}px"
    alt = html.escape(alt)
    return f'<div class=scroll><img class=plot style="{wide}" alt="{alt}" src="{data_uri(content)}"></div>'


def animation(
    pictures: Sequence[Image.Image], milliseconds: int | Sequence[int], kind: str = "WEBP", **how: Any
) -> bytes:
    """Pictures that follow each other, over and over: all for the same time, or each for its own. `how`: Pillow's
    options for this `kind` of file."""
    buffer = io.BytesIO()
    pictures[0].save(buffer, kind, save_all=True, append_images=pictures[1:], loop=0, duration=milliseconds, **how)
    return buffer.getvalue()


def moving(film: bytes, alt: str, attributes: str, lossless: bool = True) -> str:
    """An animated WebP, and its last frame for readers who prefer less motion. `attributes`: those of both elements."""
    still = io.BytesIO()
    with Image.open(io.BytesIO(film)) as frame:
        frame.seek(frame.n_frames - 1)
        frame.convert("RGB").save(still, "WEBP", lossless=lossless, method=4, quality=80)
    pictures = {"moving": film, "still": still.getvalue()}
    return "".join(
        f'<span class={kind}><img {attributes} alt="{html.escape(alt)}" src="{data_uri(content, "webp")}"></span>'
        for kind, content in pictures.items()
    )


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
