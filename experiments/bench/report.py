"""Records as Markdown tables, for the README and for people."""

from __future__ import annotations

from collections.abc import Sequence

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
