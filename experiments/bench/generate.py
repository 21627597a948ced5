"""Generation, frame by frame: every way of making the next frame, on one model, alternately.

`recompute` is what our oracle and the official release do: M passes over the whole window.
`fill` is a frame while the window fills (its commit fused with the next frame's first pass),
`slide` an exact frame past the window, `stream` an approximate one. `whole` is one pass over the
whole window, the unit that the others are compared with, and `plain` the same with attention over
all frames at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, get_args

import jax
import jax.numpy as jnp

from experiments.bench.models import Subject
from experiments.bench.programs import Frames, carrying
from experiments.bench.record import Stage, make_stages
from experiments.bench.timing import compile_call, time_by_turns
from hma_jax.config import DecodeConfig
from hma_jax.generation.flops import Way, frame_flops
from hma_jax.model.flops import pass_flops
from hma_jax.model.hma import declare_model


def time_frames(subject: Subject, rows: int, decode: DecodeConfig, repeats: int) -> list[Stage]:
    """One stage per way of making a frame, for `rows` examples at a time."""
    config, table, size, weights = subject.config, subject.table, subject.config.frames, subject.inference_params
    ways = Frames(subject, decode, rows)
    plain = declare_model(config, table, replace(subject.execution, attention="plain"))
    functions = {
        "whole": ways.forward,
        "plain": Frames(replace(subject, declared=plain), decode, rows).forward,
        "recompute": ways.recompute,
        "slide": ways.slide,
    }
    compiled = {name: compile_call(function, weights) for name, function in functions.items()}
    calls: dict[str, Callable[[], Any]] = {name: partial(call, weights) for name, call in compiled.items()}
    cache = jax.jit(ways.start)(weights)
    for name, function in (("fill", ways.fill), ("stream", ways.stream)):
        compiled[name] = compile_call(function, weights, cache, donate=(1,))
        calls[name] = carrying(compiled[name], [weights, jax.tree.map(jnp.copy, cache)], 1)
    timings = time_by_turns(calls, repeats)

    one_pass = rows * pass_flops(config, table, size, size / 2)
    flops = {"whole": one_pass, "plain": one_pass} | {
        way: rows * frame_flops(config, table, decode, way) for way in get_args(Way)
    }
    frames = dict.fromkeys(calls, rows) | {"whole": 0, "plain": 0}
    return make_stages(rows, compiled, timings, frames=frames, flops=flops)


def ratios(stages: list[Stage], rows: int) -> dict[str, float]:
    """What the caches gain, within this run."""
    median = {s.name: s.timing.median for s in stages if s.batch == rows}
    return {
        f"recompute / fill, batch {rows}": median["recompute"] / median["fill"],
        f"recompute / stream, batch {rows}": median["recompute"] / median["stream"],
        f"slide / whole window pass, batch {rows}": median["slide"] / median["whole"],
        f"plain / whole window pass, batch {rows}": median["plain"] / median["whole"],
    }
