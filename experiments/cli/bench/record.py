"""How a benchmark ends: its record is shown and written."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from experiments.terminal.program import PROGRAM, command_line
from experiments.terminal.progress import console, tidy_table

if TYPE_CHECKING:
    from experiments.bench.record import BenchRecord, Stage


def write(
    kind: str,
    subject: str,
    dtype: str,
    seed: int,
    settings: dict[str, Any],
    stages: Sequence[Stage],
    ratios: dict[str, float],
    notes: tuple[str, ...],
    out: Path,
) -> None:
    from experiments.bench.record import make_record, write_record
    from experiments.bench.timing import matmul_rate
    from hma_jax.config.json import to_dict

    record = make_record(
        kind,
        subject,
        command_line(),
        dtype=dtype,
        seed=seed,
        settings=to_dict(settings),
        stages=tuple(stages),
        ratios={name: round(value, 3) for name, value in ratios.items()},
        notes=notes,
        matmul_flops_per_second=0.0 if dtype == "none" else matmul_rate(dtype),
    )
    show(record)
    path = write_record(record, out)
    console.print(Text(f"wrote {path}; tables: {shlex.join([PROGRAM, 'bench', 'report', str(out)])}"), soft_wrap=True)


def show(record: BenchRecord) -> None:
    table = tidy_table(
        f"{record.kind} {record.subject}, {record.dtype}, {', '.join(record.machine['devices'])}",
        "stage", "batch", "median", "p90", "frames/s", "GFLOP/s", "compile",
    )  # fmt: skip
    for s in record.stages:
        rate = f"{s.flops / s.timing.median / 1e9:,.1f}" if s.flops else ""
        frames = f"{s.frames_per_second:,.2f}" if s.frames else ""
        seconds = [f"{x * 1e3:,.1f} ms" for x in (s.timing.median, s.timing.p90)]
        table.add_row(s.name, f"{s.batch}", *seconds, frames, rate, f"{s.compile_seconds:.1f} s")
    console.print(table)
    for name, value in record.ratios.items():
        console.print(f"{name}: [bold]{value:.2f}[/]")
    for note in record.notes:
        console.print(note)
    if record.matmul_flops_per_second:
        console.print(f"[dim]a plain matrix product here: {record.matmul_flops_per_second / 1e9:,.1f} GFLOP/s[/]")
