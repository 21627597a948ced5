"""What is timed, as pure functions with arguments: an optimiser step, a pass over the window, one new frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from experiments.bench.models import Subject
from hma_jax.config import DecodeConfig, SamplerConfig, TrainConfig
from hma_jax.generation import rollout_naive, steps
from hma_jax.generation.cache import Window
from hma_jax.training.state import init_state
from hma_jax.training.step import make_train_step

CARRIED = {"step": 0, "fill": 1}
"""The argument that a program returns, changed, as its first result."""

RELEASE_SAMPLER = ("ddpm", 100)
"""How the release samples latents."""


class Frames:
    """A pass over `rows` windows, and every way of making their last frame or the next one, as functions of parameters
    to be jitted."""

    def __init__(self, subject: Subject, decode: DecodeConfig, rows: int):
        batch = subject.batch(rows)
        self._declared, self._decode, self._size = subject.declared, decode, subject.config.frames
        self._tokens, self._actions, self._embodiment = (batch[key] for key in ("tokens", "actions", "embodiment"))
        self._keys = jax.random.split(jax.random.key(subject.seed), rows)
        self._past, self._newest = self._tokens[:, :-1], self._tokens[:, -2]

    def _window(self, params: Any) -> Window:
        return Window.over(self._declared.merge(params), self._actions, None, self._embodiment)

    def start(self, params: Any) -> Any:
        """The cache of windows that lack their last frame, for `fill` and `stream`."""
        return self._window(params).start(self._past, self._size - 1)

    def forward(self, params: Any) -> jax.Array:
        model = self._declared.merge(params)
        return model(self._tokens, None, model.align(self._actions), self._embodiment).token_outputs

    def recompute(self, params: Any) -> jax.Array:
        model = self._declared.merge(params)
        return rollout_naive(model, self._past, self._actions, self._embodiment, self._keys, self._decode)

    def slide(self, params: Any) -> jax.Array:
        return steps.slide(self._window(params), self._past, self._keys, self._decode)

    def fill(self, params: Any, cache: Any) -> Any:
        last = jnp.int32(self._size - 1)
        return steps.fill(self._window(params), cache, self._newest, last, self._keys, self._decode)

    def stream(self, params: Any, cache: Any) -> Any:
        beyond = jnp.int32(self._size)
        return steps.stream(self._window(params), cache, self._newest, beyond, self._keys, self._decode)


def program(
    subject: Subject, name: str, sampler: tuple[str, int] = RELEASE_SAMPLER, rows: int = 1
) -> tuple[Callable[..., Any], *tuple[Any, ...]]:
    """(a function to be jitted, its arguments) for step, forward, fill or slide. The last two make a frame with
    two passes over it, `fill` as the last of a window."""
    if name == "step":
        settings = TrainConfig(batch=rows, seed=subject.seed)
        step = make_train_step(subject.declared, subject.table, subject.config, settings)
        return step, init_state(subject.declared, subject.table, subject.seed), subject.batch(rows)
    frames, weights = Frames(subject, DecodeConfig(2, sampler=SamplerConfig(*sampler)), rows), subject.inference_params
    if name == "fill":
        return frames.fill, weights, jax.jit(frames.start)(weights)
    return {"forward": frames.forward, "slide": frames.slide}[name], weights


def repeatable(
    subject: Subject, name: str, sampler: tuple[str, int] = RELEASE_SAMPLER, rows: int = 1
) -> Callable[[], Any]:
    """The compiled program; each call continues from where the last one ended."""
    function, *args = program(subject, name, sampler, rows)
    carried = CARRIED.get(name)
    compiled = jax.jit(function, donate_argnums=() if carried is None else carried)
    return carrying(compiled, args, carried)


def carrying(call: Callable[..., Any], args: list[Any], carried: int | None) -> Callable[[], Any]:
    """Calls with `args`, of which argument number `carried` is each time the first result of the call before."""

    def once() -> Any:
        result = call(*args)
        if carried is not None:
            args[carried] = result[0]
        return result

    return once
