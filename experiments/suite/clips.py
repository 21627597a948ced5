"""What the suite looks like: an HTML page of clips that play, and a sheet of stills.
Command: python -m experiments.suite.clips --out DIR
Cost: about half a minute of one core.

`clips.html` holds everything it shows; `sheet.jpg` has a row per family, a few frames per robot.
Both are drawn in the simulator itself, at the size of the recorded frames.
"""

from __future__ import annotations

import base64
import io
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from PIL import Image, ImageDraw
from tyro.conf import arg

from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.embodiments import EMBODIMENTS, UNSEEN
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.rollout import episode_seeds, simulate
from data_pipelines.suite.spec import EmbodimentSpec
from experiments.analysis.explained_share import read_shares
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of

SECONDS = 8.0
STILLS = 3
"""Frames per robot on the sheet, a second apart."""

ZOOM = 2
GAP, TITLE = 6, 14  # pixels

HEAD = """<!doctype html><meta charset="utf-8"><title>The embedded suite</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>body{font:15px/1.4 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em}
.row{display:flex;flex-wrap:wrap;gap:12px}figure{margin:0;width:170px}
img{width:100%;image-rendering:pixelated;border-radius:6px}figcaption{font-size:12px;color:#555}</style>
<h1>The embedded suite: ten families of five siblings</h1>
"""


def clip(spec: EmbodimentSpec, seconds: float = SECONDS) -> np.ndarray:
    """uint8 [T, H, W, 3]: the longest of a few validation episodes at its native rate, cut to `seconds`."""
    rollout = simulate(spec, episode_seeds(spec, 6, 0, "val"))
    i = int(rollout.lengths.argmax())
    steps = np.arange(min(rollout.lengths[i], round(seconds * spec.hz)))
    looks = draw_appearance(spec, rollout.seeds[i : i + 1])
    return render_frames(
        spec, looks, rollout.goals[i : i + 1], rollout.q[i, steps], rollout.objects[i, steps], np.zeros(len(steps), int)
    )


def animation(frames: np.ndarray, hz: int) -> str:
    """An <img> that plays the frames at their rate, in an endless loop."""
    images = [Image.fromarray(f) for f in frames]
    file = io.BytesIO()
    images[0].save(file, "webp", save_all=True, append_images=images[1:], duration=round(1000 / hz), loop=0, quality=80)
    return f'<img alt="" src="data:image/webp;base64,{base64.b64encode(file.getvalue()).decode()}">'


def caption(spec: EmbodimentSpec) -> str:
    """What a reader wants to know about a robot, in one line."""
    actions = "video alone" if spec.video_only else f"{spec.action_dim} values, {spec.convention}"
    delay = f", delayed {spec.delay}" if spec.delay else ""
    return f"{actions}{delay}; {spec.hz} Hz; {spec.episodes} episodes"


def draw(out: Annotated[Path, arg(metavar="DIR")]) -> None:
    """Draws the page and the sheet.

    Args:
        out: Directory for both.
    """
    out.mkdir(parents=True, exist_ok=True)
    shares, page = read_shares(), [HEAD]
    families = {
        s.family: [t for t in EMBODIMENTS if t.family == s.family]
        for s in sorted(EMBODIMENTS, key=lambda s: s in UNSEEN)
    }
    cell = 64 * ZOOM + 2
    sheet = Image.new("RGB", (5 * (STILLS * cell + GAP), len(families) * (cell + TITLE + GAP)), "white")
    pen = ImageDraw.Draw(sheet)
    for row, (family, robots) in enumerate(families.items()):
        note = " (never trained on by default)" if robots[0] in UNSEEN else ""
        page.append(f"<h2>{family}{note}</h2><p>{robots[0].instruction}</p><div class=row>")
        for column, spec in enumerate(robots):
            frames = clip(spec)
            page.append(
                f"<figure>{animation(frames, spec.hz)}<figcaption><b>{spec.name}</b><br>{caption(spec)}; actions explain "
                f"{100 * shares[spec.name].share:.0f} %</figcaption></figure>"
            )
            left, top = column * (STILLS * cell + GAP), row * (cell + TITLE + GAP)
            pen.text((left, top), spec.name, fill="black")
            for k in range(STILLS):
                still = Image.fromarray(frames[min(k * spec.hz, len(frames) - 1)])
                still = still.resize((64 * ZOOM, 64 * ZOOM), Image.Resampling.LANCZOS)
                sheet.paste(still, (left + k * cell, top + TITLE))
        page.append("</div>")
    (out / "clips.html").write_text("\n".join(page))
    sheet.save(out / "sheet.jpg", quality=80)
    print(f"wrote {out / 'clips.html'} and {out / 'sheet.jpg'}")


def main() -> None:
    run_module(draw, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main, resumes=False))
