"""Records as Markdown tables and bars, for the README and for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from experiments.bench.record import BenchRecord, Stage


def markdown(records: Sequence[BenchRecord]) -> str:
    """One table per record, under a line that says where and how it was made."""
    return "\n\n".join(_one(record) for record in records)


def _one(record: BenchRecord) -> str:
    device = ", ".join(record.machine["devices"]) or record.machine["processor"]
    title = (
        f"**{record.kind} {record.subject}** ({record.dtype}; {device}, {record.machine['cores']} cores of "
        f"{record.machine['processor']}; commit `{record.machine['commit']}`, {record.date}; "
        f"`{record.command}`)"
    )
    lines = ["| stage | batch | median | p90 | frames/s | utilisation |", "|---|---|---|---|---|---|"]
    lines += [_row(stage, record) for stage in record.stages]
    facts = [f"{name}: {value:.2f}" for name, value in record.ratios.items()]
    return "\n".join([title, "", *lines, "", "; ".join([*facts, *record.notes])])


def _row(stage: Stage, record: BenchRecord) -> str:
    peak = record.peak_flops_per_second or record.matmul_flops_per_second
    used = f"{stage.flops / stage.timing.median / peak:.1%}" if stage.flops and peak else ""
    frames = f"{stage.frames_per_second:,.2f}" if stage.frames else ""
    median, p90 = (f"{x * 1e3:,.1f} ms" for x in (stage.timing.median, stage.timing.p90))
    return f"| {stage.name} | {stage.batch} | {median} | {p90} | {frames} | {used} |"


def plot_records(records: Sequence[BenchRecord], path: Path) -> None:
    """A panel per record: the median of every stage as a bar, up to its p90 as a line."""
    from experiments.report.plot_style import COLOURS, INK, MUTED, STYLE, plt, save

    heights = [0.9 + 0.3 * len(record.stages) for record in records]
    with plt.rc_context(STYLE | {"axes.grid": False}):
        figure, panels = plt.subplots(
            len(records), 1, figsize=(7.2, sum(heights)), height_ratios=heights, layout="constrained", squeeze=False
        )
        for panel, record in zip(panels[:, 0], records, strict=True):
            names = [f"{s.name} (batch {s.batch})" for s in record.stages]
            median, p90 = ([1e3 * getattr(s.timing, kind) for s in record.stages] for kind in ("median", "p90"))
            panel.barh(names, median, color=COLOURS["perplexity"], height=0.6)
            panel.hlines(names, median, p90, color=MUTED, linewidth=1.5)
            for row, (value, end) in enumerate(zip(median, p90, strict=True)):
                text = f" {value:,.1f}"
                panel.annotate(text, (max(value, end), row), va="center", fontsize=8, color=INK)
            panel.invert_yaxis()
            panel.set_xlim(0, 1.15 * max(p90))
            device = ", ".join(record.machine["devices"])
            panel.set_title(f"{record.kind} {record.subject}, {record.dtype}, {device}", fontsize=9, loc="left")
            panel.set_xlabel("milliseconds")
        save(figure, path)
