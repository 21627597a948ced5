"""A dataset at a glance: several episodes, several frames of each, every camera, with labels."""

from __future__ import annotations

import io
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from hma_jax.runtime.files import write_file

if TYPE_CHECKING:
    from data_pipelines.inspection.inspect import ExampleEpisode, Sample

TILE = 112
"""Height of a frame in pixels."""

GAP = 4
MARGIN = 12
INK, FAINT, ACCENT, PAPER = (32, 33, 36), (130, 134, 139), (26, 95, 180), (255, 255, 255)


def write_sheet(path: Path, sample: Sample) -> None:
    """A PNG of the example episodes of a dataset."""
    facts = sample.facts
    title = f"{facts.name} {facts.version}, split {facts.split}: {facts.episodes:,} episodes"
    drawn = io.BytesIO()
    draw_sheet(title, sample.examples, [c.key for c in facts.cameras if c.is_blank]).save(drawn, format="png")
    write_file(path, drawn.getvalue())


def draw_sheet(title: str, examples: Sequence[ExampleEpisode], blank: Collection[str] = ()) -> Image.Image:
    """One block per episode, one row per camera, one column per frame; `blank` cameras are marked."""
    plain, bold = ImageFont.load_default(13), ImageFont.load_default(17)
    tiles = [[(c, [_tile(f) for f in frames]) for c, frames in e.frames.items()] for e in examples]
    rows = [row for block in tiles for _, row in block]
    names = [camera.removeprefix("observation/") for block in tiles for camera, _ in block]
    labels = round(max((plain.getlength(name) for name in names), default=0)) + MARGIN
    widest = max((sum(t.width + GAP for t in row) for row in rows), default=0)
    block_heights = [46 + len(block) * (TILE + GAP) for block in tiles]
    size = (max(labels + widest, 600) + 2 * MARGIN, 2 * MARGIN + 30 + sum(block_heights))
    sheet = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN), title, INK, bold)
    top = MARGIN + 30
    for example, block, height in zip(examples, tiles, block_heights, strict=True):
        draw.text((MARGIN, top + 8), _caption(example), ACCENT, plain)
        for n, (camera, row) in enumerate(block):
            y, x = top + 46 + n * (TILE + GAP), MARGIN + labels
            draw.text((MARGIN, y), camera.removeprefix("observation/"), INK, plain)
            if camera in blank:
                draw.text((MARGIN, y + 16), "blank", FAINT, plain)
            for t, tile in zip(example.times, row, strict=True):
                if n == 0:
                    draw.text((x, top + 28), f"t = {t}", FAINT, plain)
                sheet.paste(tile, (x, y))
                draw.rectangle((x - 1, y - 1, x + tile.width, y + TILE), outline=(200, 203, 208))
                x += tile.width + GAP
        top += height
    return sheet


def _tile(frame: np.ndarray) -> Image.Image:
    image = Image.fromarray(frame)
    width = max(round(image.width * TILE / image.height), 1)
    # Small images keep their pixels; large ones are averaged.
    way = Image.Resampling.NEAREST if image.height <= TILE else Image.Resampling.BOX
    return image.resize((width, TILE), way)


def _caption(example: ExampleEpisode) -> str:
    words = [f"episode {example.index}", f"{example.steps} steps"]
    if example.success is not None:
        words.append("success" if example.success else "failure")
    if example.instruction:
        text = " ".join(example.instruction.split())
        words.append(f"“{text[:90]}{'…' if len(text) > 90 else ''}”")
    return "  ·  ".join(words)
