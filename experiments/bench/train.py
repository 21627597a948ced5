"""Training throughput: the whole optimiser step against forward passes of the same batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax

from experiments.bench.models import Subject
from experiments.bench.record import Stage, make_stages
from experiments.bench.timing import compile_call, time_by_turns
from hma_jax.config import TrainConfig
from hma_jax.model.flops import pass_flops, train_flops_per_step
from hma_jax.model.hma import HMA, declare_model
from hma_jax.model.params import Declared, Params
from hma_jax.objective.masking import mask_batch
from hma_jax.training.state import init_state
from hma_jax.training.step import make_train_step


def time_training(subject: Subject, rows: int, repeats: int) -> list[Stage]:
    """Stages `forward` (a pass over the batch, to the loss's inputs), `plain` (the same, with attention over
    all frames at once) and `step`.
    """
    declared, table, config = subject.declared, subject.table, subject.config
    settings = TrainConfig(batch=rows, seed=subject.seed)
    batch = subject.batch(rows)

    def passes(declared: Declared[HMA]) -> Callable[[Params, dict[str, jax.Array]], jax.Array]:
        def forward(params: Params, batch: dict[str, jax.Array]) -> jax.Array:
            model, key = declared.merge(params), jax.random.key(subject.seed)
            masked = mask_batch(key, batch["tokens"], batch["embodiment"], config, settings.masking, table)
            return model(masked.inputs, masked.masked, model.align(batch["actions"]), batch["embodiment"]).token_outputs

        return forward

    plain = declare_model(config, table, replace(subject.execution, attention="plain"))
    state = init_state(declared, table, subject.seed)
    compiled = {
        "forward": compile_call(passes(declared), state.params, batch),
        "plain": compile_call(passes(plain), state.params, batch),
        "step": compile_call(make_train_step(declared, table, config, settings), state, batch, donate=(0,)),
    }
    kept = [state]

    def one_step() -> dict[str, jax.Array]:
        kept[0], metrics = compiled["step"](kept[0], batch)
        return metrics

    calls: dict[str, Callable[[], Any]] = {
        name: lambda c=compiled[name]: c(kept[0].params, batch) for name in ("forward", "plain")
    }
    timings = time_by_turns(calls | {"step": one_step}, repeats)
    one_pass = rows * pass_flops(config, table, config.frames, config.frames / 2)
    flops = {"forward": one_pass, "plain": one_pass, "step": train_flops_per_step(config, table, settings)}
    return make_stages(rows, compiled, timings, frames=dict.fromkeys(flops, rows * config.frames), flops=flops)
