"""A process that runs one stage of our base models when told to: `python -m experiments.bench.stages`.

Reads a stage's name per line, runs it once and answers with the seconds it took; the first time includes
compilation. `experiments.bench.beside` lets it take turns with another program.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from functools import cache
from typing import Any

from experiments.bench.models import Subject, make_subject

RELEASED = ("ddpm", 100)
FEW = ("dpm++", 10)


def stages() -> dict[str, Callable[[], Any]]:
    """Name -> a call of it."""
    return {
        "forward": lambda: _frames("base")["forward"](),
        "fill": lambda: _frames("base")["fill"](),
        "slide": lambda: _frames("base")["slide"](),
        "step": lambda: _step()(),
        "continuous fill": lambda: _frames("base-continuous")["fill"](),
        "continuous slide": lambda: _frames("base-continuous")["slide"](),
        "continuous few": lambda: _frames("base-continuous", FEW)["fill"](),
    }


@cache
def _subject(name: str) -> Subject:
    return make_subject(name)


@cache
def _frames(name: str, sampler: tuple[str, int] = RELEASED) -> dict[str, Callable[[], Any]]:
    """A pass over the window, and one frame while the window fills and when it slides."""
    import jax
    import jax.numpy as jnp

    from hma_jax.config import DecodeConfig, SamplerConfig
    from hma_jax.generation import steps
    from hma_jax.generation.cache import Window

    subject = _subject(name)
    declared, batch, weights = subject.declared, subject.batch(1), subject.inference_params
    size, keys = subject.config.frames, jax.random.split(jax.random.key(0), 1)
    decode = DecodeConfig(2, sampler=SamplerConfig(*sampler))
    past, newest = batch["tokens"][:, :-1], batch["tokens"][:, -2]

    def window(params: Any) -> Window:
        return Window.over(declared.merge(params), batch["actions"], None, batch["embodiment"])

    def forward(params: Any) -> jax.Array:
        model = declared.merge(params)
        return model(batch["tokens"], None, model.align(batch["actions"]), batch["embodiment"]).said

    def fill(params: Any, cache: Any) -> Any:
        return steps.fill(window(params), cache, newest, jnp.int32(size - 1), keys, decode)

    whole, slid = jax.jit(forward), jax.jit(lambda p: steps.slide(window(p), past, keys, decode))
    filled = jax.jit(fill, donate_argnums=1)
    held = [jax.jit(lambda p: window(p).start(past, size - 1))(weights)]

    def next_frame() -> Any:
        held[0], frame = filled(weights, held[0])
        return frame

    return {"forward": lambda: whole(weights), "slide": lambda: slid(weights), "fill": next_frame}


@cache
def _step() -> Callable[[], Any]:
    """An optimiser step of the base model on one window."""
    import jax

    from hma_jax.config import TrainConfig
    from hma_jax.training.state import init_state
    from hma_jax.training.step import make_train_step

    subject = _subject("base")
    train, batch = TrainConfig(batch=1), subject.batch(1)
    step = make_train_step(subject.declared, subject.table, subject.config, train)
    compiled = jax.jit(step, donate_argnums=0)
    held = [init_state(subject.declared, subject.table, 0)]

    def once() -> Any:
        held[0], metrics = compiled(held[0], batch)
        return held[0], metrics

    return once


def serve(calls: dict[str, Callable[[], Any]]) -> None:
    """Answers on what was standard output; whatever else is printed goes to standard error."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        began = time.perf_counter()
        _wait(calls[line.strip()]())
        print(time.perf_counter() - began, file=answers, flush=True)


def _wait(result: Any) -> None:
    import jax

    jax.block_until_ready(result)


if __name__ == "__main__":
    serve(stages())
