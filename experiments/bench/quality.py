"""What cheaper decoding costs in quality: PSNR, SSIM and delta PSNR of a trained model's rollouts, and the time per
frame, for each decoding on the same held-out windows.

The first decoding is the reference. For latents the sampler's kind and steps vary, for ids the passes over each frame.
If windows are longer than the model's, the way of continuing past the model's window varies too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import jax

from experiments.bench.models import EXECUTION, Subject
from experiments.bench.record import Stage, make_stages
from experiments.bench.rollout import compile_rollout
from experiments.bench.timing import time_by_turns
from hma_jax.config import EvalConfig, MaskingSetting, ModelConfig
from hma_jax.config.evaluation import SamplerKind
from hma_jax.evaluation.evaluate import evaluate
from hma_jax.evaluation.summary import paired_difference
from hma_jax.model.hma import declare_model

SAMPLER_STEPS = (100, 50, 25, 12, 8, 4)
FEWER_STEPS = {"dpm++": (12, 10, 8)}
"""By sampler, in place of SAMPLER_STEPS."""
PASSES = (8, 4, 2, 1)


@dataclass(frozen=True)
class DecodingQuality:
    """The quality and cost of one decoding: a row of quality.csv. Quality is a mean over datasets with its standard
    error over episodes."""

    decoding: str
    frames: int  # frames of a rollout, including the prompt
    windows: int
    episodes: int
    psnr: float  # dB, mean over predicted frames
    psnr_sem: float
    psnr_last: float
    psnr_last_sem: float
    ssim: float
    ssim_sem: float
    delta_psnr: float  # dB, last frame
    delta_psnr_sem: float
    psnr_gap: float = 0.0  # difference from the reference's PSNR on the same windows, and its error
    psnr_gap_sem: float = 0.0
    milliseconds_per_frame: float = 0.0  # median, of one rollout at a time
    cost: float = 1.0  # time per frame relative to the reference's


def decodings(model: ModelConfig, config: EvalConfig, frames: int) -> dict[str, EvalConfig]:
    """Name -> settings, the reference first."""

    def changed(**changes: Any) -> EvalConfig:
        return replace(config, decode=replace(config.decode, **changes))

    if frames > model.frames:
        return {slide: changed(slide=slide) for slide in ("exact", "streaming")}
    if model.diffusion is None:
        return {f"M = {m}": changed(unmask_steps=m) for m in PASSES if m <= model.tokens}
    return {
        f"{kind} {steps}": changed(sampler=replace(config.decode.sampler, kind=kind, steps=steps))
        for kind in get_args(SamplerKind)
        for steps in FEWER_STEPS.get(kind, SAMPLER_STEPS)
        if steps <= model.diffusion.steps
    }


def judge(
    subject: Subject,
    tokenizer: Any,
    batches: Callable[[], Iterable[dict[str, Any]]],
    settings: dict[str, EvalConfig],
    frames: int,
    repeats: int,
    setting: MaskingSetting,
    progress: Callable[[str, int], None],
) -> tuple[list[DecodingQuality], list[Stage]]:
    """One row per decoding, and a stage of whole rollouts; `batches()` gives the same windows each time, `setting` is
    what the model was trained for."""
    rows, calls, reference = [], {}, None
    for done, (name, config) in enumerate(settings.items()):
        progress(name, done)
        evaluation = evaluate(
            subject.params, subject.config, subject.table, tokenizer, batches(), config,
            setting=setting, execution=subject.execution, samples_per_dataset=0,
        )  # fmt: skip
        found, windows = evaluation.summary.overall, evaluation.windows
        stats = {metric: found[metric] for metric in ("psnr", "psnr_last", "ssim", "delta_psnr")}
        if reference is None:
            reference = windows
        else:
            stats["psnr_gap"] = paired_difference(windows, reference, config.perplexity_group).overall["psnr"]
        values = {
            f"{metric}{end}": round(getattr(stat, kind), 5)
            for metric, stat in stats.items()
            for end, kind in (("", "mean"), ("_sem", "sem"))
        }
        rows.append(DecodingQuality(name, frames, found["psnr"].n, found["psnr"].episodes, **values))
        calls[name] = compile_rollout(subject, 1, frames, config.prompt_frames, config.decode)
    progress("timing", len(settings))
    weights = subject.inference_params
    timings = time_by_turns({n: lambda c=c: c(weights) for n, c in calls.items()}, repeats)
    made = frames - next(iter(settings.values())).prompt_frames
    first = next(iter(timings.values())).median
    timed = [
        replace(
            row,
            milliseconds_per_frame=round(1e3 * timings[row.decoding].median / made, 4),
            cost=round(timings[row.decoding].median / first, 5),
        )
        for row in rows
    ]
    made_by = dict.fromkeys(calls, float(made))
    return timed, make_stages(1, calls, timings, frames=made_by, flops=dict.fromkeys(calls, 0.0))


def plot_quality(rows: Sequence[DecodingQuality], path: Path) -> None:
    """PSNR and delta PSNR over the time per frame, every point named."""
    from experiments.report.plot_style import COLOURS, DEFAULT, MARKERS, STYLE, plain_log, plt, save

    cost = "milliseconds_per_frame"
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(1, 2, figsize=(8.6, 3.6), layout="constrained")
        for panel, metric, label in zip(
            panels, ("psnr", "delta_psnr"), ("PSNR (dB)", "ΔPSNR, last frame (dB)"), strict=True
        ):
            kinds = dict.fromkeys(row.decoding.split()[0] for row in rows)
            looks = [(COLOURS["perplexity"], 5), (COLOURS["delta_psnr"], -12), (DEFAULT, 12)]
            for number, kind in enumerate(kinds):
                colour, lift = looks[number % len(looks)]
                marker = MARKERS[number // len(looks)]
                points = [r for r in rows if r.decoding.split()[0] == kind]
                time, value, sem = ([getattr(r, f) for r in points] for f in (cost, metric, f"{metric}_sem"))
                panel.errorbar(
                    time, value, sem, color=colour, marker=marker, markersize=4, linewidth=1.2, capsize=2, label=kind
                )
                for row in points:
                    steps = row.decoding.split()[-1]
                    at = (getattr(row, cost), getattr(row, metric))
                    panel.annotate(steps, at, xytext=(4, lift), textcoords="offset points", fontsize=7.5)
            if len(rows) > len(kinds) > 1:
                panel.legend()
            plain_log(panel, panel.xaxis)
            panel.margins(x=0.2, y=0.2)
            panel.set_xlabel("milliseconds per frame, one rollout at a time")
            panel.set_ylabel(label)
        save(figure, path)


def subject_of(trained: Any) -> Subject:
    """A trained run as a `Subject`."""
    declared = declare_model(trained.model, trained.table, EXECUTION)
    return Subject(trained.model, EXECUTION, trained.table, declared, jax.device_put(trained.params), 0)
