"""Whole rollouts in one compiled call, as evaluation and simulation ask for them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from experiments.bench.models import Subject
from experiments.bench.record import Stage, make_stages
from experiments.bench.timing import Compiled, compile_call, time_by_turns
from hma_jax.config import DecodeConfig
from hma_jax.generation import rollout, rollout_naive
from hma_jax.generation.flops import rollout_flops


def time_rollouts(
    subject: Subject, rows: int, frames: int, prompt: int, decode: DecodeConfig, repeats: int, naive: bool
) -> list[Stage]:
    """Stages `rollout` and, with `naive`, `recompute`: `rows` prompts of `prompt` frames continued
    to `frames` frames."""
    weights = subject.inference_params
    ways = {"rollout": False} | ({"recompute": True} if naive else {})
    compiled = {name: compile_rollout(subject, rows, frames, prompt, decode, naive=way) for name, way in ways.items()}
    timings = time_by_turns({n: lambda c=c: c(weights) for n, c in compiled.items()}, repeats)
    flops = {
        name: rows * rollout_flops(subject.config, subject.table, decode, frames, prompt, naive=way)
        for name, way in ways.items()
    }
    frames_made = dict.fromkeys(compiled, rows * (frames - prompt))
    return make_stages(rows, compiled, timings, frames=frames_made, flops=flops)


def compile_rollout(
    subject: Subject, rows: int, frames: int, prompt: int, decode: DecodeConfig, naive: bool = False
) -> Compiled:
    """params -> the frames after `rows` prompts; `naive` by recomputation."""
    declared, batch = subject.declared, subject.batch(rows, frames)
    keys, start = jax.random.split(jax.random.key(subject.seed), rows), batch["tokens"][:, :prompt]
    rest = (batch["embodiment"], keys, decode)

    def cached(params: Any) -> jax.Array:
        return rollout(declared.merge(params), start, batch["actions"][:, None], *rest)[:, 0]

    def recompute(params: Any) -> jax.Array:
        return rollout_naive(declared.merge(params), start, batch["actions"], *rest)

    return compile_call(recompute if naive else cached, subject.inference_params)


def agreement(subject: Subject, rows: int, frames: int, prompt: int, decode: DecodeConfig) -> float:
    """Share of tokens on which `rollout` and `rollout_naive` agree (1: exact), or for latents the
    largest difference."""
    ways = (compile_rollout(subject, rows, frames, prompt, decode, naive=way) for way in (False, True))
    got, want = (way(subject.inference_params) for way in ways)
    if subject.config.diffusion:
        return float(jnp.abs(got - want).max())
    return float((got == want).mean())
