"""`hma bench quality|tokenize|simulate|load|release|report`: trained models, tokenizers, data, the release, and the
tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from experiments.cli.arguments import StudyOptions
from experiments.cli.bench.record import write
from experiments.study_setup import UNSET, make_setup
from experiments.terminal.progress import console, step, tidy_table
from experiments.terminal.words import counted
from hma_jax.config import ConfigError, require
from hma_jax.config.execution import Dtype


def quality(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    arguments: StudyOptions,
    frames: Annotated[int | None, UNSET] = None,
    windows: int = 12,
    repeats: int = 30,
) -> None:
    """Measure quality and time per frame of a trained model's rollouts under cheaper and more expensive decoding.

    Models on latents: DDPM, DDIM and DPM++ with fewer sampler steps. Models on ids: more and fewer unmasking steps. If
    --frames is more than the model's window: the exact slide and streaming.

    Args:
        run: Directory of a trained model.
        arguments: The study whose held-out windows are used.
        frames: Length of a rollout, prompt included. Default: the model's window.
        windows: Held-out windows per dataset.
        repeats: Timed rollouts of every decoding.
    """
    from dataclasses import replace

    from data_pipelines.windows.evalset import eval_batches, freeze_manifest
    from experiments.analysis.rows import write_csv
    from experiments.bench.quality import DecodingQuality, decodings, judge, plot_quality, subject_of
    from experiments.cli.evaluate import check_fits, require_prepared
    from experiments.running.run_trial import open_prepared_data
    from hma_jax.training.runs import load_model, require_frames

    setup = make_setup(arguments)
    trained = load_model(run).run
    require_frames(trained, "judge")
    require_prepared(setup)
    prepared = open_prepared_data(setup.workspace)
    check_fits(trained, prepared)
    subject, config = subject_of(trained), setup.study.eval
    config = replace(config, batch=min(config.batch, windows))  # no rows of padding
    frames = frames or trained.model.frames
    if frames < trained.model.frames:
        raise ConfigError(f"--frames must be at least the model's window of {trained.model.frames}, got {frames}")
    names = [d.dataset for d in prepared.manifest.datasets if d.dataset in trained.table.names]
    # Windows of the rollout's whole length: every frame is timed.
    frozen = freeze_manifest(
        prepared.store, names, frames, windows, prepared.manifest.seed, rate=prepared.manifest.rate
    )
    settings = decodings(trained.model, config, frames)

    def batches():
        return eval_batches(prepared.store, trained.table, frozen, config.batch, frozen.names)

    with step(f"judge {len(settings)} decodings on windows of {len(frozen.names)} datasets") as update:
        rows, stages = judge(
            subject, prepared.tokenizer, batches, settings, frames, repeats, trained.train.masking.setting,
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
    write_csv(stem.with_suffix(".csv"), DecodingQuality, rows)
    plot_quality(rows, stem.with_suffix(".png"))
    gaps = {f"PSNR of {r.decoding} over {rows[0].decoding}, dB": r.psnr_gap for r in rows[1:]}
    facts = {"model": trained.model, "eval": replace(config, batch=1), "frames": frames, "windows": rows[0].windows}
    write("quality", f"{frames}-frames", subject.execution.dtype, 0, facts, stages, gaps, (), out)
    console.print(f"wrote {stem}.csv and {stem}.png", soft_wrap=True)


def tokenize(
    tokenizer: str = "magvit2",
    piece: Annotated[int | None, UNSET] = None,
    repeats: int = 30,
    dtype: Dtype = "float32",
    seed: int = 0,
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/bench"),
) -> None:
    """Time the encoding and decoding of a tokenizer.

    Args:
        tokenizer: magvit2 or svd-vae, with random weights at 256 pixels, or a tokenizer's directory.
        piece: Images per device at a time. Default: the tokenizer's own.
        repeats: Timed calls of every stage.
        dtype: Number format of the computation, for magvit2 and svd-vae.
        seed: Random seed of weights and images.
        out: Directory for the record.
    """
    from experiments.bench.tokenize import make_tokenizer, time_tokenizer

    with step(f"make {tokenizer}"):
        made = make_tokenizer(tokenizer, dtype, piece, seed)
    with step(f"time {tokenizer} on {counted(made.at_once, 'image')} at a time"):
        stages = time_tokenizer(made, repeats, seed)
    settings = {"tokenizer": made.config, "piece": made.at_once}
    write("tokenize", Path(tokenizer).name, dtype, seed, settings, stages, {}, (), out)


def simulate(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    batch: tuple[int, ...] = (1,),
    repeats: int = 60,
    dtype: Dtype = "float32",
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/bench"),
) -> None:
    """Time a trained model as a simulator: actions in, pixels out, past the model's window.

    Args:
        run: Directory of a trained model.
        batch: Number of episodes that are simulated together; several numbers give several measurements.
        repeats: Timed frames of each measurement.
        dtype: Number format of the computation.
        out: Directory for the record.
    """
    from experiments.bench.simulate import time_simulator
    from hma_jax.simulator.folder import find_decode

    require(repeats >= 1 and min(batch, default=0) >= 1, "--repeats and --batch must be at least 1")
    stages = []
    for episodes in batch:
        with step(f"time {episodes} episodes that advance together"):
            stages.append(time_simulator(run, episodes, repeats, dtype))
    settings = {"run": str(run), "decode": find_decode(run)}
    write("simulate", run.resolve().name, dtype, 0, settings, stages, {}, (), out)


def load(
    store: Annotated[Path | None, arg(metavar="DIR"), UNSET] = None,
    data: Annotated[tuple[str, ...], arg(metavar="[DIR ...]"), UNSET] = (),
    windows: int = 20_000,
    batch: int = 32,
    frames: int = 12,
    size: int = 64,
    threads: tuple[int, ...] = (1, 2),
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/bench"),
) -> None:
    """Time the loading of training windows from a token store and of frames from RLDS directories, and measure its
    memory.

    Args:
        store: Directory of a token store. Default: a temporary one of forty datasets with random tokens.
        data: RLDS directories, whose frames are decoded and resized.
        windows: Number of windows to load.
        batch: Windows per batch; batches of frames from RLDS directories have four times as many.
        frames: Frames per window.
        size: Side in pixels to which frames of RLDS directories are resized.
        threads: Number of threads that read ahead; several numbers give several measurements.
        out: Directory for the record.
    """
    import tempfile

    from data_pipelines.tokens.store import TokenStore
    from experiments.analysis.rows import write_csv
    from experiments.bench.load import MemoryPoint, make_store, plot_memory, time_shards, time_windows

    with tempfile.TemporaryDirectory() as scratch:
        with step("open the token store"):
            opened = make_store(Path(scratch), 0) if store is None else TokenStore(store)
        with step(f"draw windows of {len(opened.names)} datasets"):
            timings = [time_windows(opened, windows, batch, frames, n) for n in threads]
    if data:
        from experiments.preparing.sources import group_by_dataset, source_of

        sources = [source_of(name, places) for name, places in group_by_dataset(data).items()]
        with step(f"draw frames of {len(sources)} RLDS directories"):
            timings += [time_shards(sources, windows * frames // 10, 4 * batch, size, n) for n in threads]
    settings = {"frames": frames, "threads": threads, "datasets": len(opened.names), "size": size}
    stages, notes = [d.stage for d in timings], tuple(d.describe() for d in timings)
    name = "store" if store is None else store.name
    write("load", name, "none", 0, settings, stages, {}, notes, out)
    write_csv(out / f"load-{name}-memory.csv", MemoryPoint, [p for d in timings for p in d.memory])
    plot_memory(timings, out / f"load-{name}-memory.png")
    console.print(f"wrote {out / f'load-{name}-memory'}.csv and .png", soft_wrap=True)


def release(
    checkout: Annotated[Positional[Path], arg(metavar="CHECKOUT")],
    python: Annotated[Path, arg(metavar="FILE")],
    stages: Annotated[tuple[str, ...], arg(metavar="[STAGE ...]"), UNSET] = (),
    turns: int = 5,
    batch: int = 1,
    dtype: Dtype = "float32",
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/bench"),
) -> None:
    """Time the base models and those of the official PyTorch release alternately, in one process for each stage.

    If there is a GPU, both use it.

    Args:
        checkout: A clone of github.com/liruiw/HMA.
        python: A Python interpreter with the packages that the release imports: torch, einops, mup, transformers,
            huggingface_hub, scipy.
        stages: Some of: forward, fill, slide, step, "continuous fill", "continuous slide",
            "continuous few" (10 evaluations by dpm++; the release needs 100). Default: all.
        turns: Timed turns of every stage, after one untimed turn.
        batch: Batch size.
        dtype: Number format of the computation; in the release by torch's automatic mixed precision.
        out: Directory for the record.
    """
    from experiments.bench.against_release import RELEASE_STAGES, time_against_release

    require(min(turns, batch) >= 1, "--turns and --batch must be at least 1")
    names = stages or tuple(RELEASE_STAGES)
    with step(f"time {len(names)} stages beside the release") as update:
        timed_stages, ratios = time_against_release(
            checkout, python, names, turns, lambda what, turn: update(turn, turns, what), rows=batch, dtype=dtype
        )
    subject = "base" if batch == 1 else f"base-batch-{batch}"
    write("release", subject, dtype, 0, {"stages": list(names), "batch": batch}, timed_stages, ratios, (), out)


def report(
    records: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="RECORD [RECORD ...]", help_behavior_hint="(required)")
    ],
    figure: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
) -> None:
    """Print records as Markdown tables, and plot them.

    Args:
        records: Record files, or directories that contain them.
        figure: PNG file for a bar chart of all stages.
    """
    from experiments.bench.record import read_record
    from experiments.bench.report import markdown, plot_records

    files = [f for path in records for f in (sorted(path.glob("*.json")) if path.is_dir() else [path])]
    require(len(files) > 0, "no benchmark records found; make one with `hma bench generate`")
    loaded = [read_record(file) for file in files]
    print(markdown(loaded))
    if figure is not None:
        plot_records(loaded, figure)
        console.print(f"wrote {figure}", soft_wrap=True)
