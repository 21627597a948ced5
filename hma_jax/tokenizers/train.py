"""Training the tokenizer: its loss and step, run by the project's one training loop.

Where the images come from is the caller's business.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from hma_jax.config import TokenizerConfig, TokenizerTrainConfig, to_dict
from hma_jax.params import Declared, Params
from hma_jax.tokenizers.io import save_tokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer, declare_tokenizer
from hma_jax.tokenizers.network import normalise
from hma_jax.tokenizers.quantizer import commitment, entropies, quantize
from hma_jax.training.loop import LoopOptions, Progress, fit
from hma_jax.training.state import TrainState


def train_tokenizer(
    config: TokenizerConfig,
    train: TokenizerTrainConfig,
    make_batches: Callable[[int], Iterator[np.ndarray]],
    run_dir: Path,
    *,
    provenance: dict[str, Any] | None = None,
    options: LoopOptions = LoopOptions(),
    progress: Progress | None = None,
) -> LfqTokenizer:
    """Trains, or goes on training, in `run_dir`; saves the tokenizer there and returns it.

    `make_batches(start)` yields uint8 images [B, image_size, image_size, 3] from step `start`
    on; `provenance` says where they come from. Raises DivergedError, Interrupted, and
    CheckpointError when `run_dir` holds a run of another configuration or other images.
    """
    declared = declare_tokenizer(config)
    params = declared.init(train.seed)
    state = TrainState(jnp.zeros((), jnp.int32), params, make_optimizer(train, declared).init(params))
    meta = {"tokenizer": to_dict(config), "train": to_dict(train), "provenance": provenance or {}}
    result = fit(
        jax.jit(make_train_step(config, train, declared), donate_argnums=0),
        state,
        make_batches,
        steps=train.steps,
        run_dir=run_dir,
        meta=meta,
        options=options,
        progress=progress,
    )
    tokenizer = LfqTokenizer(config, result.state.params)
    save_tokenizer(tokenizer, run_dir)
    return tokenizer


def make_optimizer(train: TokenizerTrainConfig, declared: Declared) -> optax.GradientTransformation:
    """AdamW, clipped, with linear warm-up and a cosine down to `final_fraction`."""
    rate = train.learning_rate
    # A run shorter than its warm-up still reaches the end of its cosine.
    warmup = min(train.warmup_steps, train.steps // 2)
    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, warmup, train.steps, rate * train.final_fraction)
    decay = jax.tree.map(lambda spec: spec.decay, declared.specs, is_leaf=lambda s: hasattr(s, "decay"))
    return optax.chain(
        optax.clip_by_global_norm(train.clip_norm),
        optax.adamw(schedule, b2=0.99, weight_decay=train.weight_decay, mask=decay),
    )


def tokenizer_loss(
    declared: Declared, params: Params, images: jax.Array, config: TokenizerConfig
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """(loss, metrics) of images [B, H, W, 3] in 0..255: squared error plus the quantiser's terms."""
    model = declared.merge(params)
    target = normalise(images)
    z = model.encoder(target)
    error = jnp.mean((model.decoder(quantize(z)) - target) ** 2)
    uncertainty, diversity = entropies(z, config.factors, config.entropy_temperature)
    commit = commitment(z)
    loss = error + config.entropy_weight * (uncertainty - diversity) + config.commitment_weight * commit
    return loss, {
        "loss": loss,
        "psnr": -10.0 * jnp.log10(error / 4.0),  # of the mean error; images span -1..1
        "uncertainty": uncertainty,
        "diversity": diversity,
        "commitment": commit,
    }


def make_train_step(
    config: TokenizerConfig, train: TokenizerTrainConfig, declared: Declared
) -> Callable[[TrainState, jax.Array], tuple[TrainState, dict[str, jax.Array]]]:
    """A pure step (state, images) -> (state, metrics)."""
    optimizer = make_optimizer(train, declared)

    def step(state: TrainState, images: jax.Array) -> tuple[TrainState, dict[str, jax.Array]]:
        gradient = jax.grad(lambda p: tokenizer_loss(declared, p, images, config), has_aux=True)
        grads, metrics = gradient(state.params)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        return TrainState(state.step + 1, params, opt_state), metrics

    return step
