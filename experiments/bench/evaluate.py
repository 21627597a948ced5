"""Evaluation of a model: the protocol in one compiled call, compared with the literal protocol.

Literal means a pass over the whole window for every frame, unmasking step and action sequence. If every frame follows
recorded ones, as in the official release's evaluation, that is M (T - 1) passes for each of the 1 + draws sequences,
including the likelihood; if frames follow generated ones, T - 1 for the likelihood and M (T - prompt) for each
sequence. Both give the same numbers, which is checked.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from experiments.bench.models import Subject
from experiments.bench.record import Stage, make_stages
from experiments.bench.timing import compile_call, time_by_turns
from hma_jax.config import DecodeConfig, EvalConfig, require
from hma_jax.evaluation.evaluate import in_groups, plan_groups
from hma_jax.evaluation.metrics import factored_cross_entropy
from hma_jax.evaluation.protocol import evaluation_inputs, make_predictor
from hma_jax.generation import rollout_naive
from hma_jax.generation.decoding import Frame, blank_frame, decode_frame
from hma_jax.model.flops import forward_flops_per_window
from hma_jax.model.hma import HMA


def time_evaluation(subject: Subject, rows: int, config: EvalConfig, repeats: int) -> list[Stage]:
    """Stages `protocol` and `literal`, on `rows` windows. Raises ConfigError if their numbers differ."""
    model, table, declared = subject.config, subject.table, subject.declared
    require(model.diffusion is None, "hma bench eval compares likelihoods of ids: choose a discrete model")
    number = jnp.arange(rows, dtype=jnp.int32)
    batch = subject.batch(rows) | {"episode": number, "start": jnp.zeros_like(number)}
    weights = subject.inference_params
    sequences, keys = evaluation_inputs(batch, table, config)

    def literal(params: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Cross-entropy [B], frames under the true actions, the last ones under the others."""
        hma = declared.merge(params)

        def under(actions_BTU: jax.Array) -> tuple[jax.Array, jax.Array]:
            one = batch | {"actions": actions_BTU}
            if config.context == "recorded":
                return _every_frame(hma, one, keys, config.decode)
            start = batch["tokens"][:, : config.prompt_frames]
            frames = rollout_naive(hma, start, actions_BTU, batch["embodiment"], keys, config.decode)
            return jnp.zeros(rows), frames

        entropy, frames = under(batch["actions"])
        if config.context == "generated":
            entropy, _ = _every_frame(hma, batch, keys, DecodeConfig(unmask_steps=1))
        last = [under(sequences[:, r])[1][:, -1] for r in range(1, sequences.shape[1])]
        return entropy, frames, jnp.stack(last, axis=1)

    predict = make_predictor(model, table, config, execution=subject.execution)
    groups, _ = plan_groups(rows, subject.execution.windows_at_once, ways=1)
    groups = groups if rows % groups == 0 else 1

    def protocol(params: Any, batch: dict[str, jax.Array]) -> Any:
        return in_groups(lambda group: predict(params, group), batch, groups)

    fast = compile_call(protocol, weights, batch)
    slow = compile_call(literal, weights)
    calls = {"protocol": lambda: fast(weights, batch), "literal": lambda: slow(weights)}
    (metrics, predicted), (entropy, frames, last) = (call() for call in calls.values())
    gap = float(jnp.abs(metrics["cross_entropy"] - entropy).max())
    same = float(jnp.minimum((predicted.tokens == frames).mean(), (predicted.random_last == last).mean()))
    require(
        gap < 1e-3 and same == 1 or subject.execution.dtype != "float32",
        f"the fast protocol differs from the literal one: cross-entropy by {gap:g}, {1 - same:.2%} of tokens",
    )
    timings = time_by_turns(calls, repeats)
    flops = rows * forward_flops_per_window(model, table) * _literal_passes(model.frames, sequences.shape[1], config)
    compiled, windows = {"protocol": fast, "literal": slow}, {"protocol": rows, "literal": rows}
    return make_stages(rows, compiled, timings, frames=windows, flops={"protocol": 0.0, "literal": flops})


def _every_frame(
    hma: HMA, batch: dict[str, jax.Array], key_B: jax.Array, decode: DecodeConfig
) -> tuple[jax.Array, jax.Array]:
    """(cross-entropy [B], frames 1 .. T-1) each predicted from recorded ones, by passes over the window."""
    tokens, robots = batch["tokens"], batch["embodiment"]
    aligned = hma.align(batch["actions"])
    hidden = hma.align_hidden(None, tokens.shape[:2])

    def one(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        def predict(frame: Frame) -> jax.Array:
            later = jnp.broadcast_to((jnp.arange(tokens.shape[1]) >= t)[None, :, None], tokens.shape)
            values, masked = tokens.at[:, t].set(frame.values), later.at[:, t].set(frame.masked)
            return hma(values, masked, aligned, robots, action_hidden_BT=hidden).token_outputs[:, t]

        first = predict(blank_frame(hma.config, len(tokens)))
        keys = jax.vmap(lambda k: jax.random.fold_in(k, t))(key_B)
        entropy = factored_cross_entropy(hma.logits(first, tokens[:, t]), tokens[:, t]).mean(-1)
        return entropy, decode_frame(hma, first, predict, keys, decode)

    entropies, frames = jax.lax.map(one, jnp.arange(1, tokens.shape[1]))
    return entropies.mean(0), jnp.moveaxis(frames, 0, 1)


def _literal_passes(frames: int, sequences: int, config: EvalConfig) -> int:
    if config.context == "recorded":
        return (frames - 1) * config.decode.unmask_steps * sequences
    return (frames - 1) + sequences * config.decode.unmask_steps * (frames - config.prompt_frames)
