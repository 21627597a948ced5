"""Whole rollouts in one compiled call, as evaluation and simulation ask for them."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from experiments.bench.models import Subject
from experiments.bench.record import Stage, make_stages
from experiments.bench.timing import compile_call, time_by_turns
from hma_jax.config import DecodeConfig
from hma_jax.flops import forward_flops_per_window
from hma_jax.generation import rollout, rollout_naive


def time_rollouts(
    subject: Subject, rows: int, frames: int, prompt: int, decode: DecodeConfig, repeats: int, naive: bool
) -> list[Stage]:
    """Stages `rollout` and, with `naive`, `recompute`: `rows` prompts of `prompt` frames continued
    to `frames` frames."""
    declared, batch, weights = subject.declared, subject.batch(rows, frames), subject.inference_params
    keys, start = jax.random.split(jax.random.key(subject.seed), rows), batch["tokens"][:, :prompt]
    rest = (batch["embodiment"], keys, decode)

    def cached(params: Any) -> jax.Array:
        return rollout(declared.merge(params), start, batch["actions"][:, None], *rest)[:, 0]

    def recompute(params: Any) -> jax.Array:
        return rollout_naive(declared.merge(params), start, batch["actions"], *rest)

    functions = {"rollout": cached} | ({"recompute": recompute} if naive else {})
    compiled = {name: compile_call(f, weights) for name, f in functions.items()}
    timings = time_by_turns({n: lambda c=c: c(weights) for n, c in compiled.items()}, repeats)
    per_window = rows * forward_flops_per_window(subject.config, subject.table)
    flops = {
        "rollout": _passes(frames, prompt, subject.config.frames, decode) * per_window,
        "recompute": (frames - prompt) * decode.unmask_steps * per_window,
    }
    frames_made = dict.fromkeys(compiled, rows * (frames - prompt))
    return make_stages(rows, compiled, timings, frames=frames_made, flops=flops)


def _passes(frames: int, prompt: int, window: int, decode: DecodeConfig) -> float:
    """Window passes that `rollout` amounts to."""
    looks = decode.unmask_steps
    filled = min(frames, window) - prompt
    slid = max(frames - window, 0)
    one = (1 + (looks - 1) / window) if decode.slide == "exact" else (looks + 1) / window
    return ((prompt - 1) + filled * (looks + 1)) / window + slid * one


def agreement(subject: Subject, rows: int, frames: int, prompt: int, decode: DecodeConfig) -> float:
    """Share of tokens on which `rollout` and `rollout_naive` agree (1: exact), or for latents the
    largest difference."""
    declared, batch = subject.declared, subject.batch(rows, frames)
    keys, start = jax.random.split(jax.random.key(subject.seed), rows), batch["tokens"][:, :prompt]
    rest = (batch["embodiment"], keys, decode)
    fast = jax.jit(lambda p: rollout(declared.merge(p), start, batch["actions"][:, None], *rest)[:, 0])
    slow = jax.jit(lambda p: rollout_naive(declared.merge(p), start, batch["actions"], *rest))
    got, want = fast(subject.inference_params), slow(subject.inference_params)
    if subject.config.diffusion:
        return float(jnp.abs(got - want).max())
    return float((got == want).mean())
