"""`hma bench generate|rollout|train|products|eval`: a model with random weights, computed the fast way and the naive
way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes

from experiments.cli.bench.arguments import Bench, Decode
from experiments.cli.bench.record import write
from experiments.study_setup import UNSET
from experiments.terminal.progress import step
from hma_jax.config import ConfigError
from hma_jax.config.execution import Remat

if TYPE_CHECKING:
    from experiments.bench.models import Subject
    from experiments.bench.record import Stage
    from hma_jax.config import DecodeConfig

Program = Literal["step", "forward", "fill", "slide"]


def generate(bench: OmitArgPrefixes[Bench], decode: OmitArgPrefixes[Decode]) -> None:
    """Time the generation of one frame: while the window fills, when it slides, and by recomputation."""
    from experiments.bench.generate import ratios, time_frames

    subject, how = _subject(bench), _decode(decode)
    stages = _over_batches(bench, "frames", lambda rows: time_frames(subject, rows, how, bench.repeats))
    time_ratios: dict[str, float] = {}
    for rows in bench.batch:
        time_ratios |= ratios(stages, rows)
    _finish("generate", bench, subject, stages, time_ratios, {"decode": how})


def rollout(
    bench: OmitArgPrefixes[Bench],
    decode: OmitArgPrefixes[Decode],
    frames: int = 12,
    prompt: int = 4,
    slide: Literal["exact", "streaming"] = "exact",
    naive: Annotated[bool, UNSET] = True,
) -> None:
    """Time whole rollouts in one compiled call, and compare them with recomputation.

    Args:
        bench: What is timed and how often.
        decode: How frames are generated.
        frames: Length of a rollout, prompt included; if it is longer than the model's window, the window slides.
        prompt: Frames it starts from.
        slide: How the window slides: exact computes it again for every frame, streaming does not.
        naive: Time recomputation too, and compare the frames. Default: yes.
    """
    from dataclasses import replace

    from experiments.bench.rollout import agreement, time_rollouts

    subject, how = _subject(bench), replace(_decode(decode), slide=slide)
    stages = _over_batches(
        bench, "rollouts", lambda rows: time_rollouts(subject, rows, frames, prompt, how, bench.repeats, naive)
    )
    notes, time_ratios = (), {}
    if naive:
        time_ratios = _ratios(bench, stages, "recompute", "rollout")
        with step("compare with recomputation"):
            value = agreement(subject, bench.batch[0], frames, prompt, how)
        what = "largest difference" if subject.config.diffusion else "share of equal tokens"
        notes = (f"against recomputation, {what}: {value:g}",)
    settings = {"decode": how, "frames": frames, "prompt": prompt}
    _finish("rollout", bench, subject, stages, time_ratios, settings, notes)


def train(bench: OmitArgPrefixes[Bench], remat: Remat = "products") -> None:
    """Time optimiser steps against forward passes of the same batch.

    Args:
        bench: What is timed and how often.
        remat: What the backward pass recomputes to save memory, see `hma plan --help`.
    """
    from experiments.bench.train import time_training

    subject = _subject(bench, remat=remat)
    stages = _over_batches(bench, "training steps", lambda rows: time_training(subject, rows, bench.repeats))
    time_ratios = _ratios(bench, stages, "step", "forward") | _ratios(bench, stages, "step", "plain")
    _finish("train", bench, subject, stages, time_ratios, {})


def products(bench: OmitArgPrefixes[Bench], program: Program = "step") -> None:
    """Time a program, and each of its matrix products separately, to see what could be gained and where.

    Args:
        bench: What is timed and how often.
        program: step: an optimiser step; forward: a pass over the window; fill: a frame while the window fills;
            slide: a frame when it slides.
    """
    from experiments.bench.products import time_products

    subject = _subject(bench, remat="none" if bench.model.startswith("cpu") else "products")
    stages = _over_batches(
        bench, f"the products of {program}", lambda rows: time_products(subject, program, rows, bench.repeats)
    )
    time_ratios = {}
    for rows in bench.batch:
        whole, *parts = [s.timing.median for s in stages if s.batch == rows]
        time_ratios[f"{program} / the sum of its products alone, batch {rows}"] = whole / sum(parts)
    _finish(f"products-{program}", bench, subject, stages, time_ratios, {})


def evaluate(
    bench: OmitArgPrefixes[Bench], context: Literal["recorded", "generated"] = "recorded", draws: int = 5
) -> None:
    """Time the fast implementation of the evaluation protocol and the literal one, and compare their results.

    Args:
        bench: What is timed and how often.
        context: The frames before a predicted frame: recorded ones, as in the release's evaluation, or
            generated ones.
        draws: Number of random action sequences for delta PSNR.
    """
    from experiments.bench.evaluate import time_evaluation
    from hma_jax.config import EvalConfig

    subject, config = _subject(bench), EvalConfig(context=context, random_actions=draws)
    stages = _over_batches(bench, "evaluation", lambda rows: time_evaluation(subject, rows, config, bench.repeats))
    time_ratios = _ratios(bench, stages, "literal", "protocol")
    _finish(f"eval-{context}", bench, subject, stages, time_ratios, {"eval": config})


def _over_batches(bench: Bench, what: str, measure: Callable[[int], list[Stage]]) -> list[Stage]:
    stages = []
    for rows in bench.batch:
        with step(f"time {what} at batch {rows}"):
            stages += measure(rows)
    return stages


def _ratios(bench: Bench, stages: Sequence[Stage], above: str, below: str) -> dict[str, float]:
    """How many times as long one stage takes as another, at each batch size."""
    median = {(s.name, s.batch): s.timing.median for s in stages}
    return {f"{above} / {below}, batch {rows}": median[above, rows] / median[below, rows] for rows in bench.batch}


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
    write(kind, name, bench.dtype, bench.seed, settings, stages, ratios, notes, bench.out)
