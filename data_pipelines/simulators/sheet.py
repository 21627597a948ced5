"""Contact sheets of datasets.

Frames are read back through `RldsDataset`, as in training.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from data_pipelines.registry import get_spec
from data_pipelines.sources.rlds.dataset import RldsDataset

COLUMNS = 8
GAP = 4  # pixels
TITLE = 14  # pixels


def draw_sheet(directories: Sequence[Path], path: Path, episodes: int = 1) -> None:
    """Writes a PNG: `episodes` rows for each dataset, frames from the first to the last of each."""
    rows = []
    for directory in directories:
        dataset = RldsDataset(directory)
        key = get_spec(dataset.name).image_key
        for i in range(min(episodes, len(dataset))):
            frames = dataset.frames(i, key, lambda n: np.linspace(0, n - 1, COLUMNS).round().astype(int))
            rows.append((f"{dataset.name}, episode {i}", frames))
    height = max(frames[0].shape[0] for _, frames in rows)
    width = max(frames[0].shape[1] for _, frames in rows)
    pitch = height + TITLE + GAP
    sheet = Image.new("RGB", (COLUMNS * (width + GAP), len(rows) * pitch), "white")
    pen = ImageDraw.Draw(sheet)
    for row, (title, frames) in enumerate(rows):
        pen.text((2, row * pitch), title, fill="black")
        for column, frame in enumerate(frames):
            sheet.paste(Image.fromarray(frame), (column * (width + GAP), row * pitch + TITLE))
    sheet.save(path)
