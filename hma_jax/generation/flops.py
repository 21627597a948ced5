"""Floating-point operations of generation by formula, counted as in `hma_jax.model.flops`.

A frame costs passes of the trunk, which the window's caches make few, and with latents the evaluations of the
denoiser: one per sampler step, on every token that is drawn. For the base model with 100 steps these are nine
tenths of a frame.
"""

from __future__ import annotations

from typing import Literal

from hma_jax.config import DecodeConfig, ModelConfig
from hma_jax.generation.decoding import masked_counts
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.flops import denoiser_flops, pass_flops

Way = Literal["fill", "slide", "stream", "recompute"]
"""How a frame is made: as in `hma_jax.generation.steps`, or by passes over a whole window for every unmasking step."""


def frame_flops(
    config: ModelConfig, table: EmbodimentTable, decode: DecodeConfig, way: Way, earlier: int | None = None
) -> float:
    """One new frame of one example.

    `earlier`: finished frames before it, by default all that fit a window, T - 1. `recompute` takes a window of
    `earlier` + 1 frames; `slide` and `stream` come where T - 1 are there.
    """
    whole, steps = config.frames, decode.unmask_steps
    earlier = whole - 1 if earlier is None else earlier

    def one(seen: int, predicted: int = 1) -> float:
        return pass_flops(config, table, 1, seen, predicted)

    # A finished frame that enters the cache beside the first step is not read out.
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

    Every token is drawn once or, with `resample`, again at each step after the one that unmasked it. Every kind of
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
    """`rollout` of one example from `prompt` frames to `frames` under so many action sequences, or `rollout_naive`.

    Of a prompt longer than T - 1 only the last frames are seen, and the prompt is read once for all sequences.
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
