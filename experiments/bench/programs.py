"""What is timed, as pure functions with arguments: an optimiser step, a pass over the window, one new frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from experiments.bench.models import Subject
from hma_jax.config import DecodeConfig, SamplerConfig, TrainConfig
from hma_jax.generation import steps
from hma_jax.generation.cache import Window
from hma_jax.training.state import init_state
from hma_jax.training.step import make_train_step

CARRIED = {"step": 0, "fill": 1}
"""The argument that a program returns, changed, as its first result."""

RELEASE_SAMPLER = ("ddpm", 100)
"""How the release samples latents."""


def program(
    subject: Subject, name: str, sampler: tuple[str, int] = RELEASE_SAMPLER, rows: int = 1
) -> tuple[Callable[..., Any], *tuple[Any, ...]]:
    """(a function to be jitted, its arguments) for step, forward, fill or slide. The last two make a frame with
    two passes over it, `fill` as the last of a window."""
    declared, batch, config = subject.declared, subject.batch(rows), subject.config
    if name == "step":
        step = make_train_step(declared, subject.table, config, TrainConfig(batch=rows, seed=subject.seed))
        return step, init_state(declared, subject.table, subject.seed), batch
    weights, keys = subject.inference_params, jax.random.split(jax.random.key(0), rows)
    decode = DecodeConfig(2, sampler=SamplerConfig(*sampler))
    past, newest = batch["tokens"][:, :-1], batch["tokens"][:, -2]

    def window(params: Any) -> Window:
        return Window.over(declared.merge(params), batch["actions"], None, batch["embodiment"])

    def forward(params: Any) -> jax.Array:
        model = declared.merge(params)
        return model(batch["tokens"], None, model.align(batch["actions"]), batch["embodiment"]).token_outputs

    def slide(params: Any) -> Any:
        return steps.slide(window(params), past, keys, decode)

    def fill(params: Any, cache: Any) -> Any:
        return steps.fill(window(params), cache, newest, jnp.int32(config.frames - 1), keys, decode)

    if name == "fill":
        return fill, weights, jax.jit(lambda p: window(p).start(past, config.frames - 1))(weights)
    return {"forward": forward, "slide": slide}[name], weights


def repeatable(
    subject: Subject, name: str, sampler: tuple[str, int] = RELEASE_SAMPLER, rows: int = 1
) -> Callable[[], Any]:
    """The program compiled, going on from where its last call ended."""
    function, *args = program(subject, name, sampler, rows)
    carried = CARRIED.get(name)
    compiled = jax.jit(function, donate_argnums=() if carried is None else carried)

    def once() -> Any:
        result = compiled(*args)
        if carried is not None:
            args[carried] = result[0]
        return result

    return once
