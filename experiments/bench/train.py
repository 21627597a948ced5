"""Training throughput: the whole optimiser step against a forward pass of the same batch."""

from __future__ import annotations

import jax

from experiments.bench.models import Subject
from experiments.bench.record import Stage, make_stages
from experiments.bench.timing import compile_call, time_by_turns
from hma_jax.config import TrainConfig
from hma_jax.flops import forward_flops_per_window, train_flops_per_window
from hma_jax.masking import mask_batch
from hma_jax.training.step import init_state, make_train_step


def time_training(subject: Subject, rows: int, repeats: int) -> list[Stage]:
    """Stages `forward` (one clean pass over the batch, to the loss's inputs) and `step`."""
    declared, table, config = subject.declared, subject.table, subject.config
    settings = TrainConfig(batch=rows, seed=subject.seed)
    batch = subject.batch(rows)

    def forward(params, batch):
        model = declared.merge(params)
        key = jax.random.key(subject.seed)
        masked = mask_batch(key, batch["tokens"], batch["embodiment"], config, settings.masking, table)
        return model(
            masked.inputs, masked.masked, model.align(batch["actions"]), batch["embodiment"]
        ).frames

    state = init_state(declared, table, subject.seed)
    ahead = compile_call(forward, state.params, batch)
    step = compile_call(make_train_step(declared, table, config, settings), state, batch, donate=(0,))
    kept = [state]

    def one_step():
        kept[0], metrics = step(kept[0], batch)
        return metrics

    timings = time_by_turns({"forward": lambda: ahead(kept[0].params, batch), "step": one_step}, repeats)
    flops = {
        "forward": rows * forward_flops_per_window(config, table),
        "step": rows * train_flops_per_window(config, table),
    }
    frames = dict.fromkeys(flops, rows * config.frames)
    return make_stages(rows, {"forward": ahead, "step": step}, timings, frames=frames, flops=flops)
