"""What `hma bench` does: runs a benchmark, shows it, writes its record. Heavy imports happen here."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from experiments.program import command_line
from experiments.progress import console, step, tidy_table
from hma_jax.config import ConfigError, require

if TYPE_CHECKING:
    from experiments.bench.models import Subject
    from experiments.bench.record import BenchRecord, Stage
    from experiments.cli.bench import Bench, Decode
    from hma_jax.config import DecodeConfig


def generate(bench: Bench, decode: Decode) -> None:
    from experiments.bench.generate import ratios, time_frames

    subject, how = _subject(bench), _decode(decode)
    stages = _over_batches(bench, "frames", lambda rows: time_frames(subject, rows, how, bench.repeats))
    found: dict[str, float] = {}
    for rows in bench.batch:
        found |= ratios(stages, rows)
    _finish("generate", bench, subject, stages, found, {"decode": how})


def rollouts(bench: Bench, decode: Decode, frames: int, prompt: int, slide: str, naive: bool) -> None:
    from dataclasses import replace

    from experiments.bench.rollout import agreement, time_rollouts

    subject, how = _subject(bench), replace(_decode(decode), slide=slide)
    stages = _over_batches(
        bench, "rollouts", lambda rows: time_rollouts(subject, rows, frames, prompt, how, bench.repeats, naive)
    )
    notes, found = (), {}
    if naive:
        found = _ratios(bench, stages, "recompute", "rollout")
        with step("compare with recomputation"):
            value = agreement(subject, bench.batch[0], frames, prompt, how)
        what = "largest difference" if subject.config.diffusion else "share of equal tokens"
        notes = (f"against recomputation, {what}: {value:g}",)
    settings = {"decode": how, "frames": frames, "prompt": prompt}
    _finish("rollout", bench, subject, stages, found, settings, notes)


def train(bench: Bench, remat: bool) -> None:
    from experiments.bench.train import time_training

    subject = _subject(bench, remat=remat)
    stages = _over_batches(
        bench, "training steps", lambda rows: time_training(subject, rows, bench.repeats)
    )
    _finish("train", bench, subject, stages, _ratios(bench, stages, "step", "forward"), {"remat": remat})


def evaluate(bench: Bench, context: Literal["recorded", "generated"], draws: int) -> None:
    from experiments.bench.evaluate import time_evaluation
    from hma_jax.config import EvalConfig

    subject, config = _subject(bench), EvalConfig(context=context, random_actions=draws)
    stages = _over_batches(
        bench, "evaluation", lambda rows: time_evaluation(subject, rows, config, bench.repeats)
    )
    found = _ratios(bench, stages, "literal", "protocol")
    _finish(f"eval-{context}", bench, subject, stages, found, {"eval": config})


def tokenize(name: str, piece: int | None, repeats: int, dtype: str, seed: int, out: Path) -> None:
    from experiments.bench.tokenize import make_tokenizer, time_tokenizer

    with step(f"make {name}"):
        tokenizer = make_tokenizer(name, dtype, piece, seed)
    with step(f"time {name} on {tokenizer.at_once} image(s) at a time"):
        stages = time_tokenizer(tokenizer, repeats, seed)
    settings = {"tokenizer": tokenizer.config, "piece": tokenizer.at_once}
    _write("tokenize", Path(name).name, dtype, seed, settings, stages, {}, (), out)


def load(
    store: Path | None, data: Sequence[str], windows: int, batch: int, frames: int, threads: int, out: Path
) -> None:
    import tempfile

    from data_pipelines.tokens.store import TokenStore
    from experiments.bench.load import make_store, time_shards, time_windows

    stages, notes = [], []
    with tempfile.TemporaryDirectory() as scratch:
        with step("open the token store"):
            opened = make_store(Path(scratch), 0) if store is None else TokenStore(store)
        with step(f"draw windows of {len(opened.names)} datasets"):
            stage, slope = time_windows(opened, windows, batch, frames, threads)
        stages.append(stage)
        notes.append(f"memory over {stage.timing.repeats * batch:,} windows: {slope / 1e3:+.1f} kB per thousand")
    if data:
        from data_pipelines.registry import get_spec
        from experiments.pipeline import name_datasets

        sources = [(get_spec(n), Path(d)) for n, d in zip(name_datasets(data), data, strict=True)]
        with step(f"draw frames of {len(sources)} RLDS directories"):
            stage, slope = time_shards(sources, windows * frames // 10, 4 * batch, 64, threads)
        stages.append(stage)
        notes.append(f"memory over {stage.timing.repeats * 4 * batch:,} frames: {slope / 1e3:+.1f} kB per thousand")
    settings = {"frames": frames, "threads": threads, "datasets": len(opened.names)}
    _write("load", "store" if store is None else store.name, "none", 0, settings, stages, {}, tuple(notes), out)


def report(records: Sequence[Path]) -> None:
    from experiments.bench.record import read_record
    from experiments.bench.report import markdown

    files = [f for path in records for f in (sorted(path.glob("*.json")) if path.is_dir() else [path])]
    require(len(files) > 0, "no records there; make one with `hma bench generate`")
    print(markdown([read_record(file) for file in files]))


def _over_batches(bench: Bench, what: str, measure: Callable[[int], list[Stage]]) -> list[Stage]:
    stages = []
    for rows in bench.batch:
        with step(f"time {what} at batch {rows}"):
            stages += measure(rows)
    return stages


def _ratios(bench: Bench, stages: Sequence[Stage], above: str, below: str) -> dict[str, float]:
    """How much longer one stage takes than another, at each batch."""
    median = {(s.name, s.batch): s.timing.median for s in stages}
    return {
        f"{above} / {below}, batch {rows}": median[above, rows] / median[below, rows] for rows in bench.batch
    }


def _subject(bench: Bench, **changes: Any) -> Subject:
    from experiments.bench.models import make_subject

    if bench.repeats < 1 or min(bench.batch, default=0) < 1:
        raise ConfigError("--repeats and --batch must be at least 1")
    with step(f"draw the weights of {bench.model}"):
        return make_subject(bench.model, bench.dtype, bench.robots, bench.seed, bench.layers, **changes)


def _decode(decode: Decode) -> DecodeConfig:
    from hma_jax.config import DecodeConfig, SamplerConfig

    return DecodeConfig(decode.unmask_steps, sampler=SamplerConfig(steps=decode.sampler_steps))


def _finish(
    kind: str,
    bench: Bench,
    subject: Subject,
    stages: Sequence[Stage],
    ratios: dict[str, float],
    settings: dict[str, Any],
    notes: tuple[str, ...] = (),
) -> None:
    settings = settings | {"model": subject.config, "robots": bench.robots}
    _write(kind, bench.model, bench.dtype, bench.seed, settings, stages, ratios, notes, bench.out)


def _write(
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
    from hma_jax.config import to_dict

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
    console.print(f"wrote {path}; tables: hma bench report {out}", soft_wrap=True)


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
