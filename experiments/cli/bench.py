"""`hma bench`: arguments and help. What the commands do is in `commands.bench`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, arg
from tyro.extras import SubcommandApp

from experiments.commands import bench as commands
from experiments.setting import Where, make_setting
from hma_jax.config.evaluation import SamplerKind
from hma_jax.config.execution import Dtype, Remat

bench_app = SubcommandApp()

HELP = (
    "How fast it is, here. Every command times the fast path and the naive one by turns in one process, "
    "prints both, and writes a JSON record with commit, hardware and versions."
)

Program = Literal["step", "forward", "fill", "slide"]
Model = Literal["base", "xl", "base-continuous", "xl-continuous", "cpu", "cpu-continuous"]


@dataclass(frozen=True)
class Bench:
    """What is timed and how often."""

    model: Model = "base"
    """base: the released size, width 256, 32 layers, 12 frames of 256 + 64 tokens; xl: width 1024; cpu:
    the model of the cpu preset."""
    batch: tuple[int, ...] = (1,)
    """Examples at a time; several numbers give several measurements."""
    repeats: int = 30
    """Timed calls of every stage, after two untimed ones."""
    dtype: Dtype = "float32"
    """What is computed in."""
    robots: int = 1
    """Embodiments of the model; a batch mixes them."""
    layers: Annotated[int | None, arg(metavar="N")] = None
    """Another number of layers, for a quick look."""
    width: Annotated[int | None, arg(metavar="D")] = None
    """Another width."""
    seed: int = 0
    out: Path = Path("runs/bench")
    """Directory for the record."""


@dataclass(frozen=True)
class Decode:
    """How frames are filled."""

    unmask_steps: Annotated[int, arg(name="unmask-steps")] = 2
    """Looks at each frame, M."""
    sampler_steps: Annotated[int, arg(name="sampler-steps")] = 100
    """Continuous models: steps of the diffusion sampler."""
    sampler: SamplerKind = "ddpm"
    """Continuous models: the diffusion sampler. dpm++ needs 10 to 12 steps."""


@bench_app.command(name="generate")
def generate(bench: OmitArgPrefixes[Bench], decode: OmitArgPrefixes[Decode]) -> None:
    """Time the making of one frame: while the window fills, when it slides, and by recomputation."""
    commands.generate(bench, decode)


@bench_app.command(name="rollout")
def rollout(
    bench: OmitArgPrefixes[Bench],
    decode: OmitArgPrefixes[Decode],
    frames: int = 12,
    prompt: int = 4,
    slide: Literal["exact", "streaming"] = "exact",
    naive: bool = True,
) -> None:
    """Time whole rollouts in one compiled call, and check them against recomputation.

    Args:
        bench: What is timed and how often.
        decode: How frames are filled.
        frames: Length of a rollout, prompt included; past the model's window it slides.
        prompt: Frames it starts from.
        slide: What happens past the window.
        naive: Time recomputation too, and compare the frames.
    """
    commands.rollouts(bench, decode, frames, prompt, slide, naive)


@bench_app.command(name="train")
def train(bench: OmitArgPrefixes[Bench], remat: Remat = "products") -> None:
    """Time optimiser steps against forward passes of the same batch.

    Args:
        bench: What is timed and how often.
        remat: What a block keeps for the backward pass; the rest is computed again.
    """
    commands.train(bench, remat)


@bench_app.command(name="products")
def products(bench: OmitArgPrefixes[Bench], program: Program = "step") -> None:
    """Time a program, and every matrix product in it alone: what could be gained, and where.

    Args:
        bench: What is timed and how often.
        program: An optimiser step, a pass over the window, or a frame while the window fills or when it slides.
    """
    commands.products(bench, program)


@bench_app.command(name="eval")
def evaluate(
    bench: OmitArgPrefixes[Bench], context: Literal["recorded", "generated"] = "recorded", draws: int = 5
) -> None:
    """Time the evaluation protocol against the same protocol taken literally, and compare the numbers.

    Args:
        bench: What is timed and how often.
        context: What a predicted frame follows: recorded frames, as the release evaluates, or
            generated ones.
        draws: Random action sequences for delta PSNR.
    """
    commands.evaluate(bench, context, draws)


@bench_app.command(name="quality")
def quality(
    run: Positional[Path],
    where: OmitArgPrefixes[Where],
    frames: int | None = None,
    windows: int = 12,
    repeats: int = 30,
) -> None:
    """Judge a trained model's rollouts under cheaper and dearer decoding: quality beside time per frame.

    Latents: DDPM and DDIM with fewer steps, DPM++ with few. Ids: more and fewer looks at each frame. With --frames
    beyond the model's window: an exact slide against streaming.

    Args:
        run: Directory of a trained model.
        where: The study whose held-out windows are used.
        frames: Length of a rollout, prompt included; the model's window if not given.
        windows: Held-out windows per dataset.
        repeats: Timed rollouts of every decoding.
    """
    commands.quality(make_setting(where), run, frames, windows, repeats)


@bench_app.command(name="tokenize")
def tokenize(
    tokenizer: str = "magvit2",
    piece: int | None = None,
    repeats: int = 30,
    dtype: Dtype = "float32",
    seed: int = 0,
    out: Path = Path("runs/bench"),
) -> None:
    """Time a tokenizer both ways.

    Args:
        tokenizer: magvit2 or svd-vae, with drawn weights at 256 pixels, or a tokenizer's directory.
        piece: Images per device at a time; its own default if not given.
        repeats: Timed calls of every stage.
        dtype: What magvit2 and svd-vae compute in.
        seed: Of weights and images.
        out: Directory for the record.
    """
    commands.tokenize(tokenizer, piece, repeats, dtype, seed, out)


@bench_app.command(name="load")
def load(
    store: Path | None = None,
    data: Annotated[tuple[str, ...], arg(metavar="[DIR ...]")] = (),
    windows: int = 20_000,
    batch: int = 32,
    frames: int = 12,
    size: int = 64,
    threads: tuple[int, ...] = (1, 2),
    out: Path = Path("runs/bench"),
) -> None:
    """Time training windows from a token store, and frames from RLDS directories; watch the memory.

    Args:
        store: A token store; one of forty datasets with random tokens is made if not given.
        data: RLDS directories, whose frames are decoded and resized.
        windows: Windows to draw.
        batch: Windows per batch; four times as many frames of RLDS directories.
        frames: Frames per window.
        size: Pixels that frames of RLDS directories are resized to.
        threads: Threads that read ahead; several numbers are timed one after the other.
        out: Directory for the record.
    """
    commands.load(store, data, windows, batch, frames, size, threads, out)


@bench_app.command(name="release")
def release(
    checkout: Positional[Path],
    python: Path,
    stages: Annotated[tuple[str, ...], arg(metavar="[STAGE ...]")] = (),
    turns: int = 5,
    out: Path = Path("runs/bench"),
) -> None:
    """Time the base models beside the official PyTorch release: two processes that take turns.

    Args:
        checkout: A clone of github.com/liruiw/HMA.
        python: An interpreter with what the release imports: torch, einops, mup, transformers,
            huggingface_hub, scipy.
        stages: Some of: forward, fill, slide, step, "continuous fill", "continuous slide",
            "continuous few" (10 evaluations by dpm++ against the release's 100). All if not given.
        turns: Timed turns of every stage, after one untimed.
        out: Directory for the record.
    """
    commands.release(checkout, python, stages, turns, out)


@bench_app.command(name="report")
def report(records: Positional[tuple[Path, ...]], figure: Path | None = None) -> None:
    """Print records as Markdown tables, and draw them.

    Args:
        records: Record files, or directories of them.
        figure: PNG file for bars of every stage.
    """
    commands.report(records, figure)
