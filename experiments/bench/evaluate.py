"""Evaluation of a model: the protocol in one compiled call against the protocol taken literally.

Literally means a window pass for every frame, look and action sequence, as the official release
computes them: (T - 1) passes for the likelihood, M (T - prompt) for each of the 1 + draws rollouts.
Both give the same numbers, which is checked.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.bench.models import Subject
from experiments.bench.record import Stage, make_stages
from experiments.bench.timing import compile_call, time_by_turns
from hma_jax.config import DecodeConfig, EvalConfig, require
from hma_jax.evaluation.metrics import factored_cross_entropy
from hma_jax.evaluation.protocol import evaluation_inputs, make_evaluator
from hma_jax.flops import forward_flops_per_window
from hma_jax.generation import rollout_naive


def time_evaluation(subject: Subject, rows: int, config: EvalConfig, repeats: int) -> list[Stage]:
    """Stages `protocol` and `literal`, on `rows` windows. Raises ConfigError if their numbers differ."""
    model, table, declared = subject.config, subject.table, subject.declared
    require(model.diffusion is None, "hma bench eval compares likelihoods of ids: choose a discrete model")
    batch = subject.batch(rows) | {"window": jnp.arange(rows, dtype=jnp.int32)}
    decode = DecodeConfig(unmask_steps=config.unmask_steps, sampler=config.sampler)
    weights = subject.inference_params
    sequences, keys = evaluation_inputs(batch, table, model, config)

    def literal(params: Any) -> tuple[jax.Array, jax.Array]:
        hma = declared.merge(params)
        tokens, robots = batch["tokens"], batch["embodiment"]
        aligned = hma.align(batch["actions"])
        hidden = hma.align_hidden(None, tokens.shape[:2])

        def likelihood(t: jax.Array) -> jax.Array:
            masked = jnp.broadcast_to((jnp.arange(model.frames) >= t)[None, :, None], tokens.shape)
            logits = hma(tokens, masked, aligned, robots, hidden_BT=hidden).frames[:, t]
            return factored_cross_entropy(logits, tokens[:, t]).mean(-1)

        start = tokens[:, : config.prompt_frames]
        frames = [
            rollout_naive(hma, start, sequences[:, r], robots, keys, decode) for r in range(sequences.shape[1])
        ]
        return jax.lax.map(likelihood, jnp.arange(1, model.frames)).mean(0), jnp.stack(frames, axis=1)

    fast = compile_call(make_evaluator(model, table, config), weights, batch)
    slow = compile_call(literal, weights)
    calls = {"protocol": lambda: fast(weights, batch), "literal": lambda: slow(weights)}
    (metrics, frames), (cross_entropy, literally) = (call() for call in calls.values())
    gap = float(jnp.abs(metrics["cross_entropy"] - cross_entropy).max())
    same = float(np.mean(np.asarray(frames) == np.asarray(literally)))
    require(
        gap < 1e-3 and same == 1 or model.compute_dtype != "float32",
        f"the fast protocol differs from the literal one: cross-entropy by {gap:g}, {1 - same:.2%} of tokens",
    )
    timings = time_by_turns(calls, repeats)
    passes = (model.frames - 1) + sequences.shape[1] * config.unmask_steps * (model.frames - config.prompt_frames)
    flops = rows * forward_flops_per_window(model, table) * passes
    compiled, windows = {"protocol": fast, "literal": slow}, {"protocol": rows, "literal": rows}
    return make_stages(rows, compiled, timings, frames=windows, flops={"protocol": 0.0, "literal": flops})
