"""What `hma bench` does: runs a benchmark, shows it, writes its record. Heavy imports happen here."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from rich.text import Text

from experiments.program import PROGRAM, command_line
from experiments.progress import console, step, tidy_table
from hma_jax.config import ConfigError, require

if TYPE_CHECKING:
    from experiments.bench.models import Subject
    from experiments.bench.record import BenchRecord, Stage
    from experiments.cli.bench import Bench, Decode
    from experiments.setting import Setting
    from hma_jax.config import DecodeConfig
    from hma_jax.config.execution import Remat


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


def train(bench: Bench, remat: Remat) -> None:
    from experiments.bench.train import time_training

    subject = _subject(bench, remat=remat)
    stages = _over_batches(
        bench, "training steps", lambda rows: time_training(subject, rows, bench.repeats)
    )
    found = _ratios(bench, stages, "step", "forward") | _ratios(bench, stages, "step", "plain")
    _finish("train", bench, subject, stages, found, {})


def products(bench: Bench, program: str) -> None:
    from experiments.bench.products import time_products

    subject = _subject(bench, remat="none" if bench.model.startswith("cpu") else "products")
    stages = _over_batches(
        bench, f"the products of {program}", lambda rows: time_products(subject, program, rows, bench.repeats)
    )
    found = {}
    for rows in bench.batch:
        whole, *parts = [s.timing.median for s in stages if s.batch == rows]
        found[f"{program} / the sum of its products alone, batch {rows}"] = whole / sum(parts)
    _finish(f"products-{program}", bench, subject, stages, found, {})


def evaluate(bench: Bench, context: Literal["recorded", "generated"], draws: int) -> None:
    from experiments.bench.evaluate import time_evaluation
    from hma_jax.config import EvalConfig

    subject, config = _subject(bench), EvalConfig(context=context, random_actions=draws)
    stages = _over_batches(
        bench, "evaluation", lambda rows: time_evaluation(subject, rows, config, bench.repeats)
    )
    found = _ratios(bench, stages, "literal", "protocol")
    _finish(f"eval-{context}", bench, subject, stages, found, {"eval": config})


def quality(setting: Setting, run: Path, frames: int | None, windows: int, repeats: int) -> None:
    from dataclasses import replace

    from data_pipelines.windows.evalset import eval_batches, freeze_manifest
    from experiments.bench.quality import Judged, decodings, judge, plot_quality, subject_of
    from experiments.commands.model import check_fits, require_prepared
    from experiments.rows import write_csv
    from experiments.trial import open_materials
    from hma_jax.training.runs import load_model

    trained = load_model(run).run
    require_prepared(setting)
    materials = open_materials(setting.workspace)
    check_fits(trained, materials)
    subject, config = subject_of(trained), setting.study.eval
    config = replace(config, batch=min(config.batch, windows))  # no rows of padding
    frames = frames or trained.model.frames
    if frames < trained.model.frames:
        raise ConfigError(f"--frames must be at least the model's window of {trained.model.frames}, got {frames}")
    names = [d.dataset for d in materials.manifest.datasets if d.dataset in trained.table.names]
    # Whole windows: what is timed are frames, all of them.
    frozen = freeze_manifest(
        materials.store, names, frames, windows, materials.manifest.seed, rate=materials.manifest.rate
    )
    settings = decodings(trained.model, config, frames)

    def batches():
        return eval_batches(materials.store, trained.table, frozen, config.batch, frozen.names)

    with step(f"judge {len(settings)} decodings on windows of {len(frozen.names)} datasets") as update:
        rows, stages = judge(
            subject, materials.tokenizer, batches, settings, frames, repeats,
            lambda name, done: update(done, len(settings), name),
        )  # fmt: skip
    table = tidy_table(
        f"{run}, {frames} frames from a prompt of {config.prompt_frames}, {rows[0].windows} windows",
        "decoding", "PSNR", "SSIM", "delta PSNR", "ms/frame", "cost",
    )  # fmt: skip
    for r in rows:
        means = (f"{r.psnr:.2f} ± {r.psnr_sem:.2f}", f"{r.ssim:.3f}", f"{r.delta_psnr:.3f} ± {r.delta_psnr_sem:.3f}")
        table.add_row(r.decoding, *means, f"{r.milliseconds_per_frame:.2f}", f"{r.cost:.3f}")
    console.print(table)
    out = run / "quality"
    out.mkdir(exist_ok=True)
    stem = out / f"quality-{frames}"
    write_csv(stem.with_suffix(".csv"), Judged, rows)
    plot_quality(rows, stem.with_suffix(".png"))
    gaps = {f"PSNR of {r.decoding} over {rows[0].decoding}, dB": r.psnr_gap for r in rows[1:]}
    facts = {"model": trained.model, "eval": replace(config, batch=1), "frames": frames, "windows": rows[0].windows}
    _write("quality", f"{frames}-frames", subject.execution.dtype, 0, facts, stages, gaps, (), out)
    console.print(f"wrote {stem}.csv and {stem}.png", soft_wrap=True)


def tokenize(name: str, piece: int | None, repeats: int, dtype: str, seed: int, out: Path) -> None:
    from experiments.bench.tokenize import make_tokenizer, time_tokenizer

    with step(f"make {name}"):
        tokenizer = make_tokenizer(name, dtype, piece, seed)
    with step(f"time {name} on {tokenizer.at_once} image(s) at a time"):
        stages = time_tokenizer(tokenizer, repeats, seed)
    settings = {"tokenizer": tokenizer.config, "piece": tokenizer.at_once}
    _write("tokenize", Path(name).name, dtype, seed, settings, stages, {}, (), out)


def load(
    store: Path | None,
    data: Sequence[str],
    windows: int,
    batch: int,
    frames: int,
    size: int,
    threads: Sequence[int],
    out: Path,
) -> None:
    import tempfile

    from data_pipelines.tokens.store import TokenStore
    from experiments.bench.load import MemoryPoint, make_store, plot_memory, time_shards, time_windows
    from experiments.rows import write_csv

    with tempfile.TemporaryDirectory() as scratch:
        with step("open the token store"):
            opened = make_store(Path(scratch), 0) if store is None else TokenStore(store)
        with step(f"draw windows of {len(opened.names)} datasets"):
            drained = [time_windows(opened, windows, batch, frames, n) for n in threads]
    if data:
        from data_pipelines.registry import get_spec
        from experiments.preparing.sources import name_datasets

        sources = [(get_spec(n), Path(d)) for n, d in zip(name_datasets(data), data, strict=True)]
        with step(f"draw frames of {len(sources)} RLDS directories"):
            drained += [time_shards(sources, windows * frames // 10, 4 * batch, size, n) for n in threads]
    settings = {"frames": frames, "threads": threads, "datasets": len(opened.names), "size": size}
    stages, notes = [d.stage for d in drained], tuple(d.describe() for d in drained)
    name = "store" if store is None else store.name
    _write("load", name, "none", 0, settings, stages, {}, notes, out)
    write_csv(out / f"load-{name}-memory.csv", MemoryPoint, [p for d in drained for p in d.memory])
    plot_memory(drained, out / f"load-{name}-memory.png")
    console.print(f"wrote {out / f'load-{name}-memory'}.csv and .png", soft_wrap=True)


def release(checkout: Path, python: Path, stages: Sequence[str], turns: int, out: Path) -> None:
    from experiments.bench.beside import RELEASED, time_beside

    names = stages or tuple(RELEASED)
    with step(f"time {len(names)} stages beside the release") as update:
        found, ratios = time_beside(checkout, python, names, turns, lambda what, turn: update(turn, turns, what))
    _write("release", "base", "float32", 0, {"stages": list(names)}, found, ratios, (), out)


def report(records: Sequence[Path], figure: Path | None) -> None:
    from experiments.bench.record import read_record
    from experiments.bench.report import markdown, plot_records

    files = [f for path in records for f in (sorted(path.glob("*.json")) if path.is_dir() else [path])]
    require(len(files) > 0, "no records there; make one with `hma bench generate`")
    found = [read_record(file) for file in files]
    print(markdown(found))
    if figure is not None:
        plot_records(found, figure)
        console.print(f"wrote {figure}", soft_wrap=True)


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


def _subject(bench: Bench, remat: Remat = "products") -> Subject:
    from experiments.bench.models import make_subject
    from hma_jax.config import ExecutionConfig

    if bench.repeats < 1 or min(bench.batch, default=0) < 1:
        raise ConfigError("--repeats and --batch must be at least 1")
    with step(f"draw the weights of {bench.model}"):
        sizes = {"layers": bench.layers, "width": bench.width}
        execution = ExecutionConfig(bench.dtype, remat)
        return make_subject(bench.model, execution, bench.robots, bench.seed, **sizes)


def _decode(decode: Decode) -> DecodeConfig:
    from hma_jax.config import DecodeConfig, SamplerConfig

    return DecodeConfig(decode.unmask_steps, sampler=SamplerConfig(decode.sampler, decode.sampler_steps))


def _finish(
    kind: str,
    bench: Bench,
    subject: Subject,
    stages: Sequence[Stage],
    ratios: dict[str, float],
    settings: dict[str, Any],
    notes: tuple[str, ...] = (),
) -> None:
    settings = settings | {"model": subject.config, "execution": subject.execution, "robots": bench.robots}
    sizes = {"layers": bench.layers, "width": bench.width}
    name = "-".join([bench.model, *(f"{what}-{size}" for what, size in sizes.items() if size)])
    _write(kind, name, bench.dtype, bench.seed, settings, stages, ratios, notes, bench.out)


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
