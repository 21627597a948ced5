"""One HTML page on what datasets hold: clips with their actions, statistics, windows and possible issues.

Self-contained, readable on a phone. Owns the page; the facts are `data_pipelines.inspection`'s.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data_pipelines.inspection.inspect import ActionFacts, Facts, Sample
from data_pipelines.inspection.issues import Issue, chosen_actions
from data_pipelines.inspection.sample import ExampleEpisode
from data_pipelines.inspection.suggest import WindowFacts, window_facts
from data_pipelines.registry import DatasetSpec
from data_pipelines.sources.rlds.schema import field_slice
from data_pipelines.tokens.row_sample import QUANTILES
from experiments.report.drawings import clip, curves, histogram, lengths
from experiments.report.pieces import STILL, table
from experiments.report.style import CSS
from experiments.terminal.words import counted

FASTEST = 4.0
"""Clips play at the recorded speed, or faster (by at most this factor) if they would take longer than LONGEST."""

LONGEST = 6.0
"""Seconds of a clip, as long as FASTEST allows."""

UNKNOWN_HZ = 10.0
"""Speed of clips whose rate is unknown."""

OTHER_FRAMES = (2, 4, 8, 12, 16)
"""Windows of these numbers of frames are counted besides the one asked for."""

CLIP_FRAMES = 24
"""Frames of a clip."""

TALL, SMALL = 168, 84
"""Pixels of the clips of the camera in use, and of the others."""

CORRECTED = {"rotate_180": "turned by 180 degrees", "swap_red_blue": "red and blue exchanged"}
"""`DatasetSpec.image_corrections` in words."""

PAGE_CSS = """
.error, .warning { border-left: 4px solid var(--bad); background: var(--soft); border-radius: 4px;
  padding: .45rem .8rem; margin: .4rem 0; max-width: 52rem; overflow-wrap: anywhere; }
.warning { border-color: #d8902a; color: inherit; } .error b { color: var(--bad); } .fine { color: var(--good); }
.gallery { display: grid; grid-template-columns: repeat(auto-fill, minmax(300px, 1fr)); gap: 1rem; }
.episode { background: var(--soft); border-radius: 8px; padding: .7rem; min-width: 0; }
.episode p { margin: .35rem 0; font-size: .86rem; line-height: 1.35; overflow-wrap: anywhere; }
.clips { display: flex; flex-wrap: wrap; gap: 4px; margin-top: 4px; }
.clip { display: block; border-radius: 4px; max-width: 100%; height: auto; image-rendering: auto; background: #8884; }
svg { display: block; } svg.curves, svg.lengths { width: 100%; max-width: 460px; height: auto; }
svg text { font: 10px system-ui, sans-serif; fill: var(--muted); }
.curves polyline { fill: none; stroke: #3a78c2; stroke-width: 1.1; stroke-linejoin: round; }
.curves .still { stroke: var(--line); } .bars rect, .lengths rect { fill: #3a78c2; } .lengths .short { fill: #b9c0c7; }
.lengths line.mark { stroke: var(--bad); stroke-dasharray: 3 2; } svg text.mark { fill: var(--bad); }
td svg { margin-left: auto; } td:nth-child(3).text { min-width: 0; }
a { color: inherit; } .hint { color: var(--muted); font-size: .86rem; }
@media (max-width: 520px) { main { padding: 1.2rem .8rem 3rem; } h1 { font-size: 1.5rem; }
  .gallery { grid-template-columns: 1fr; } .cards { grid-template-columns: 1fr 1fr; } }
"""


@dataclass(frozen=True)
class DatasetView:
    """One dataset as the page shows it."""

    sample: Sample
    entry: DatasetSpec | None  # the entry by which it would be read
    registered: bool  # the entry is the registry's, not one suggested by the contents
    hz: float | None
    stride: int | None
    issues: tuple[Issue, ...]

    @property
    def facts(self) -> Facts:
        return self.sample.facts


def draw_page(datasets: Sequence[DatasetView], frames: int, command: str) -> str:
    """The page. `frames`: T of the windows that are counted; `command`: the command that makes the page again."""
    title = ", ".join(d.facts.name for d in datasets)
    body = [_summary(datasets, frames), STILL]
    body += [part for i, dataset in enumerate(datasets) for part in _dataset(i, dataset, frames)]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
        'content="width=device-width, initial-scale=1"><title>Robot data: '
        f"{html.escape(title)}</title><style>{CSS}{PAGE_CSS}</style></head>\n<body><main><header><h1>Robot data "
        f"<em>{html.escape(title)}</em></h1></header>{''.join(body)}<section><h2>Command that makes this "
        f"page</h2><pre>{html.escape(command)}</pre></section></main></body></html>\n"
    )


# --- parts ------------------------------------------------------------------------------------


def _summary(datasets: Sequence[DatasetView], frames: int) -> str:
    lines = []
    for i, d in enumerate(datasets):
        f, windows = d.facts, _windows(d, frames)
        errors, warnings = (sum(r.severity == severity for r in d.issues) for severity in ("error", "warning"))
        stands = [f'<span class="failed">{counted(errors, "error")}</span>'] * bool(errors)
        stands += [counted(warnings, "warning")] * bool(warnings)
        lines.append([
            f'<a href="#d{i}">{html.escape(f.name)}</a>',
            ", ".join(stands) or "<span class=fine>no issues found</span>",
            f"{f.episodes:,}",
            f"{f.lengths.median:g}",
            f"{d.hz:g}" if d.hz else "?",
            f"{d.hz / d.stride:.3g}" if d.hz and d.stride else "?",
            f"{windows.total:,.0f}" if windows else "?",
            f"{d.entry.action_dim}" if d.entry else "?",
        ])  # fmt: skip
    names = ["dataset", "issues", "episodes", "median steps", "Hz", "Hz of frames", f"windows, T = {frames}"]
    head = [*names, "action values"]
    return table(head, lines, text=2)


def _dataset(i: int, d: DatasetView, frames: int) -> list[str]:
    f = d.facts
    sampled = "all" if f.sampled == f.episodes else f"{f.sampled} of {f.episodes:,}"
    where = f"{f.version} · split {f.split} · {sampled} episodes read ({f.bytes_read / 1e6:,.1f} MB) · {f.directory}"
    issues = [f"<p class={r.severity}><b>{html.escape(r.title)}</b>: {html.escape(r.text)}.</p>" for r in d.issues] or [
        "<p class=fine>No issues found.</p>"
    ]
    if f.sampled < f.episodes:
        issues.append("<p class=fine>Duplicate recordings are searched only among the episodes that were read.</p>")
    return [
        f'<section id="d{i}"><h2>{html.escape(f.name)}</h2><p class=meta>{html.escape(where)}</p>{"".join(issues)}',
        _read_as(d),
        _part("Episodes", _gallery(d)),
        _part("Lengths and windows", _lengths(d, frames)),
        _part("Actions", *_actions(d)),
        _part("Cameras, splits and fields", _cameras(d), _splits(f), _fields(f)),
        "</section>",
    ]


def _part(title: str, *parts: str) -> str:
    return f"<h3>{html.escape(title)}</h3>{''.join(parts)}"


def _read_as(d: DatasetView) -> str:
    if d.entry is None:
        return "<p>It cannot be read, because its rate is unknown or it has no camera.</p>"
    whose = "The registry's entry" if d.registered else "Not in the registry; the suggested entry"
    action = " + ".join(d.entry.action_keys) or "no action: video only"
    form = ""
    if d.entry.angle_form != "as_recorded":
        numbers = ", ".join(map(str, d.entry.angles))
        form = f", values {numbers} {'as sine and cosine' if d.entry.angle_form == 'sine_cosine' else 'unwrapped'}"
    done = " and ".join(CORRECTED[one] for one in d.entry.image_corrections)
    return (
        f"<p>{whose} reads <code>{html.escape(d.entry.image_key)}</code>{f' ({done})' * bool(done)} and <code>{html.escape(action)}</code>"
        f" ({d.entry.action_dim} values{form}) at {d.entry.hz:g} Hz.</p>"
    )


def _windows(d: DatasetView, frames: int) -> WindowFacts | None:
    return window_facts(d.facts, d.stride, frames) if d.stride else None


def _gallery(d: DatasetView) -> str:
    return f"<div class=gallery>{''.join(_episode(d, example) for example in d.sample.examples)}</div>"


def _episode(d: DatasetView, example: ExampleEpisode) -> str:
    hz = d.hz or UNKNOWN_HZ
    seconds = example.steps / hz
    speed = min(max(seconds / LONGEST, 1.0), FASTEST)
    blank = {c.key for c in d.facts.cameras if c.is_blank}
    used = d.entry.image_key if d.entry else ""
    cameras = sorted((c for c in example.frames if c not in blank), key=lambda c: (c != used, c))
    clips = [
        clip(
            _corrected(d, c, example.frames[c]),
            seconds / speed,
            TALL if n == 0 else SMALL,
            f"{c} of episode {example.index}",
        )
        for n, c in enumerate(cameras)
    ]
    words = [f"<b>episode {example.index}</b>", f"{example.steps} steps"]
    if d.hz:
        words.append(f"{seconds:.1f} s" + (f", shown {speed:.2g} times as fast" if speed > 1.05 else ""))
    if example.success is not None:
        words.append("success" if example.success else "failure")
    text = " ".join(example.instruction.split())
    instruction = f"<p>“{html.escape(text[:160])}{'…' if len(text) > 160 else ''}”</p>" if text else ""
    shown = [field for field in chosen_actions(d.facts, d.entry) if field_slice(field.key)[0] in example.actions]
    drawn = "".join(_curves(field, example) for field in shown)
    pictures = "".join(clips[:1]) + f"<div class=clips>{''.join(clips[1:])}</div>"
    return f"<div class=episode>{pictures}<p>{' · '.join(words)}</p>{instruction}{drawn}</div>"


def _corrected(d: DatasetView, camera: str, frames: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    """Frames of the camera in use, as a model sees them."""
    used = d.entry is not None and camera == d.entry.image_key
    return [d.entry.correct(frame) for frame in frames] if used else frames


def _curves(field: ActionFacts, example: ExampleEpisode) -> str:
    key, part = field_slice(field.key)
    rows = example.actions[key][:, part]
    lows, highs = ([getattr(x, name) for x in field.dimensions] for name in ("minimum", "maximum"))
    names = [str(i) for i in range(len(field.dimensions))]
    return f"<p class=hint>{html.escape(field.key)}, as recorded</p>{curves(rows, lows, highs, names)}"


def _lengths(d: DatasetView, frames: int) -> str:
    f, windows = d.facts, _windows(d, frames)
    n = f.lengths
    words = (
        f"<p>{n.shortest} to {n.longest} steps, median {n.median:g}, 80 % between {n.lower:g} and {n.upper:g}"
        + (f"; the median is {n.median / d.hz:.1f} s at {d.hz:g} Hz" if d.hz else "")
        + ".</p>"
    )
    drawn = lengths(f.steps, windows.native if windows else None)
    if windows is None:
        return words + drawn
    lines = []
    rows = [(t, d.stride) for t in {frames, *OTHER_FRAMES}] + [(frames, 1)] * (d.stride > 1)
    for t, stride in sorted(rows, key=lambda row: (-row[1], row[0])):
        w = window_facts(f, stride, t)
        mark = ("<b>", "</b>") if (t, stride) == (frames, d.stride) else ("", "")
        cells = (
            f"{t}", f"{stride}", f"{d.hz / stride:.3g}", f"{w.native}", f"{w.native / d.hz:.3g}",
            f"{w.whole / f.sampled:.0%}", f"{w.long_enough / f.sampled:.0%}", f"{w.total:,.0f}",
        )  # fmt: skip
        lines.append([f"{mark[0]}{cell}{mark[1]}" for cell in cells])
    head = [
        "frames T", "stride", "Hz of frames", "steps", "seconds", "episodes with a full window", "with any",
        "windows in the split",
    ]  # fmt: skip
    return words + drawn + table(head, lines, text=0)


def _actions(d: DatasetView) -> list[str]:
    chosen = chosen_actions(d.facts, d.entry)
    taken = {field_slice(field.key)[0] for field in chosen}
    parts = [_action(field) for field in chosen]
    others = [field for field in d.facts.actions if field.key not in taken]
    if others:
        inside = "".join(_action(field) for field in others)
        parts.append(f"<details><summary>{len(others)} more fields, not in use</summary>{inside}</details>")
    return parts or ["<p>No numeric action field: video only.</p>"]


def _action(field: ActionFacts) -> str:
    lines = []
    for i, x in enumerate(field.dimensions):
        bad = f'<span class="failed">{x.not_finite} not finite</span> ' if x.not_finite else ""
        numbers = (x.mean, x.std, x.minimum, *x.quantiles, x.maximum)
        distinct = f"{x.distinct}" if x.distinct < 100 else "100+"
        lines.append([
            f"{i}", bad + html.escape(x.hint), histogram(x.histogram), *map(_number, numbers), distinct
        ])  # fmt: skip
    levels = [f"{q:.0%}" for q in QUANTILES]
    head = ["value", "looks like", "histogram", "mean", "deviation", "min", *levels, "max", "distinct"]
    return f"<p class=hint>{html.escape(field.key)}, as recorded</p>{table(head, lines, text=2)}"


def _number(value: float) -> str:
    return f"{value:.3g}".replace("-", "\u2212") if math.isfinite(value) else "–"


def _cameras(d: DatasetView) -> str:
    used = d.entry.image_key if d.entry else ""
    lines = []
    for c in d.facts.cameras:
        remark = "blank" if c.is_blank else "stands still" if c.still else "in use" if c.key == used else ""
        remark = remark if c.frames else "cannot be decoded"
        sizes = ", ".join(f"{h}x{w}" for h, w in c.sizes)
        lines.append([f"<code>{html.escape(c.key)}</code>", remark, sizes, f"{c.frames}", f"{c.blank}"])
    return table(["camera", "remark", "height x width", "frames read", "blank"], lines, text=2)


def _splits(f: Facts) -> str:
    lines = [[html.escape(s.name), f"{s.episodes:,}", f"{s.shards:,}", f"{s.bytes / 1e6:,.1f}"] for s in f.splits]
    return table(["split", "episodes", "shards", "MB"], lines)


def _fields(f: Facts) -> str:
    lines = []
    for x in f.fields:
        shape = "x".join("?" if n is None else str(n) for n in x.shape) or "one"
        lines.append([f"<code>{html.escape(x.key)}</code>", x.kind, shape, x.dtype])
    inside = table(["field", "kind", "shape", "type"], lines, text=2)
    return f"<details><summary>{len(lines)} fields</summary>{inside}</details>"
