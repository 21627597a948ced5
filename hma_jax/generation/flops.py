"""Floating-point operations of generation by formula, counted as in `hma_jax.model.flops`.

A frame costs passes of the trunk, most of them over one frame thanks to the cache. With latents it also costs
evaluations of the denoiser: one per sampler step, on every token that is drawn. For the base model with 100 steps these
are nine tenths of the cost.
"""

from __future__ import annotations

from typing import Literal

from hma_jax.config import DecodeConfig, ModelConfig
from hma_jax.generation.decoding import masked_counts
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.flops import denoiser_flops, pass_flops

Way = Literal["fill", "slide", "stream", "recompute"]
"""How a frame is made: as in `hma_jax.generation.steps`, or (`recompute`) with a pass over the whole window in every
unmasking step."""


def frame_flops(
    config: ModelConfig, table: EmbodimentTable, decode: DecodeConfig, way: Way, earlier: int | None = None
) -> float:
    """One new frame of one example.

    `earlier`: the number of finished frames before it, by default all that fit in a window, T - 1. `recompute` passes
    over a window of `earlier` + 1 frames; `slide` and `stream` always have T - 1 frames before.
    """
    whole, steps = config.frames, decode.unmask_steps
    earlier = whole - 1 if earlier is None else earlier

    def one(seen: int, predicted: int = 1) -> float:
        return pass_flops(config, table, 1, seen, predicted)

    # The finished frame that enters the cache in the first step is not read out.
    if way == "fill":
        trunk = one(earlier, predicted=0) + steps * one(earlier + 1)
    elif way == "stream":
        trunk = one(whole, predicted=0) + steps * one(whole)
    elif way == "slide":
        trunk = pass_flops(config, table, whole, whole / 2, predicted=1) + (steps - 1) * one(whole)
    else:
        trunk = steps * pass_flops(config, table, earlier + 1, (earlier + 1) / 2)
    return trunk + sampler_flops(config, decode)


def sampler_flops(config: ModelConfig, decode: DecodeConfig) -> float:
    """The denoiser's part of one frame; 0 for ids.

    Every token is drawn once or, with `resample`, again in each step after the one that unmasked it. Every kind of
    sampler evaluates the denoiser once per step.
    """
    if config.diffusion is None:
        return 0.0
    drawn = config.tokens
    if decode.resample:
        drawn = sum(config.tokens - masked for masked in masked_counts(config, decode.unmask_steps))
    return decode.sampler.steps * denoiser_flops(config, drawn, own_steps=False)


def rollout_flops(
    config: ModelConfig,
    table: EmbodimentTable,
    decode: DecodeConfig,
    frames: int,
    prompt: int,
    sequences: int = 1,
    naive: bool = False,
) -> float:
    """`rollout` of one example from `prompt` to `frames` frames under `sequences` action sequences; with `naive`,
    `rollout_naive`.

    Only the last T - 1 frames of a longer prompt are seen. The prompt is read once for all sequences.
    """
    old = max(prompt - (config.frames - 1), 0)
    frames, prompt = frames - old, prompt - old
    window = min(frames, config.frames)
    if naive:
        return sequences * (frames - prompt) * frame_flops(config, table, decode, "recompute", window - 1)
    past = pass_flops(config, table, prompt - 1, (prompt - 1) / 2, predicted=0)
    filled = sum(frame_flops(config, table, decode, "fill", t) for t in range(prompt, window))
    slide: Way = "slide" if decode.slide == "exact" else "stream"
    slid = (frames - window) * frame_flops(config, table, decode, slide)
    return past + sequences * (filled + slid)
