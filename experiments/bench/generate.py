"""Generation, frame by frame: every way of making the next frame, on one model, by turns.

`recompute` is what our oracle and the official release do: M passes over the whole window.
`fill` is a frame while the window fills (its commit fused with the next frame's first pass),
`slide` an exact frame past the window, `stream` an approximate one. `whole` is one pass over the
whole window, the unit that the others are compared with, and `plain` the same with attention over
all frames at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import jax
import jax.numpy as jnp

from experiments.bench.models import Subject
from experiments.bench.record import Stage, make_stages
from experiments.bench.timing import Compiled, compile_call, time_by_turns
from hma_jax.config import DecodeConfig
from hma_jax.generation import rollout_naive, steps
from hma_jax.generation.cache import Window
from hma_jax.generation.flops import Way, frame_flops
from hma_jax.model.flops import pass_flops
from hma_jax.model.hma import HMA, declare_model


def time_frames(subject: Subject, rows: int, decode: DecodeConfig, repeats: int) -> list[Stage]:
    """One stage per way of making a frame, for `rows` examples at a time."""
    config, declared = subject.config, subject.declared
    size, batch, weights = config.frames, subject.batch(rows), subject.inference_params
    keys = jax.random.split(jax.random.key(subject.seed), rows)
    past, newest = batch["tokens"][:, :-1], batch["tokens"][:, -2]

    def window(model: HMA) -> Window:
        return Window.over(model, batch["actions"], None, batch["embodiment"])

    cache = jax.jit(lambda p: window(declared.merge(p)).start(past, size - 1))(weights)

    def window_pass(model: HMA) -> jax.Array:
        return model(batch["tokens"], None, model.align(batch["actions"]), batch["embodiment"]).token_outputs

    def whole(params: Any) -> jax.Array:
        return window_pass(declared.merge(params))

    def plain(params: Any) -> jax.Array:
        execution = replace(subject.execution, attention="plain")
        model = declare_model(config, subject.table, execution).merge(params)
        return window_pass(model)

    def recompute(params: Any) -> jax.Array:
        return rollout_naive(declared.merge(params), past, batch["actions"], batch["embodiment"], keys, decode)

    def slide(params: Any) -> jax.Array:
        return steps.slide(window(declared.merge(params)), past, keys, decode)

    def fill(params: Any, cache: Any) -> Any:
        return steps.fill(window(declared.merge(params)), cache, newest, jnp.int32(size - 1), keys, decode)

    def stream(params: Any, cache: Any) -> Any:
        return steps.stream(window(declared.merge(params)), cache, newest, jnp.int32(size), keys, decode)

    compiled = {f.__name__: compile_call(f, weights) for f in (whole, plain, recompute, slide)}
    calls: dict[str, Callable[[], Any]] = {name: lambda c=call: c(weights) for name, call in compiled.items()}
    for function in (fill, stream):
        call = compile_call(function, weights, cache, donate=(1,))
        compiled[function.__name__] = call
        calls[function.__name__] = _with_own_cache(call, weights, cache)
    timings = time_by_turns(calls, repeats)

    one_pass = rows * pass_flops(config, subject.table, size, size / 2)
    flops = {"whole": one_pass, "plain": one_pass} | {
        way: rows * frame_flops(config, subject.table, decode, way) for way in get_args(Way)
    }
    frames = dict.fromkeys(calls, rows) | {"whole": 0, "plain": 0}
    return make_stages(rows, compiled, timings, frames=frames, flops=flops)


def _with_own_cache(call: Compiled, params: Any, cache: Any) -> Callable[[], Any]:
    """Calls that hand the donated cache on, as a rollout does."""
    kept = [jax.tree.map(jnp.copy, cache)]

    def step() -> Any:
        kept[0], frame = call(params, kept[0])
        return frame

    return step


def ratios(stages: list[Stage], rows: int) -> dict[str, float]:
    """What the caches buy, within this run."""
    median = {s.name: s.timing.median for s in stages if s.batch == rows}
    return {
        f"recompute / fill, batch {rows}": median["recompute"] / median["fill"],
        f"recompute / stream, batch {rows}": median["recompute"] / median["stream"],
        f"slide / whole window pass, batch {rows}": median["slide"] / median["whole"],
        f"plain / whole window pass, batch {rows}": median["plain"] / median["whole"],
    }
