"""Training the tokenizer: its loss and step, which the project's one training loop runs.

The caller provides the images.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from hma_jax.config import TokenizerConfig, TokenizerTrainConfig
from hma_jax.config.json import from_dict, to_dict
from hma_jax.kernels.random import key_of
from hma_jax.model.params import Declared, Params, is_spec
from hma_jax.runtime.devices import default_device
from hma_jax.tokenizers.autoencoder import AutoencoderTokenizer, declare_tokenizer
from hma_jax.tokenizers.base import require_images
from hma_jax.tokenizers.continuous import make_continuous
from hma_jax.tokenizers.io import save_tokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer
from hma_jax.tokenizers.network import from_pixels
from hma_jax.tokenizers.quantizer import commitment, entropies, quantize
from hma_jax.training.divergence import Records
from hma_jax.training.loop import LoopOptions, Progress, RunInfo, fit
from hma_jax.training.state import FINITE, TrainState, all_finite, with_sharding


def train_tokenizer(
    config: TokenizerConfig,
    train: TokenizerTrainConfig,
    make_batches: Callable[[int], Iterator[np.ndarray]],
    run_dir: str | Path,
    *,
    provenance: dict[str, Any] | None = None,
    options: LoopOptions = LoopOptions(),
    progress: Progress | None = None,
    records: Records = lambda index: (),
) -> AutoencoderTokenizer:
    """Trains, or continues training, in `run_dir`; saves the tokenizer there and returns it.

    `make_batches(start)` yields uint8 images [B, image_size, image_size, 3] from step `start`
    on; `provenance` says where they come from, `records` what a batch is made of. Raises DivergedError, Interrupted,
    CheckpointError if `run_dir` holds a run with another configuration or other images, and ConfigError for images of
    another shape or type.
    """
    declared = declare_tokenizer(config)
    optimizer = make_optimizer(train, declared)

    def make_state() -> TrainState:
        params = declared.init(train.seed)
        return TrainState(jnp.zeros((), jnp.int32), params, jax.jit(optimizer.init)(params))

    def put(images: np.ndarray) -> jax.Array:
        require_images(images, config.image_shape, "a tokenizer is trained on")
        return jax.device_put(images)

    device = jax.sharding.SingleDeviceSharding(default_device())
    shapes = declared.shapes()
    shapes = TrainState(jax.ShapeDtypeStruct((), jnp.int32), shapes, jax.eval_shape(optimizer.init, shapes))
    described = {"tokenizer": to_dict(config), "train": to_dict(train), "provenance": provenance or {}}
    result = fit(
        _jitted_step(make_train_step, config, train),
        with_sharding(shapes, device),
        make_state,
        make_batches,
        steps=train.steps,
        run_dir=run_dir,
        info=RunInfo(described, modernise=_modernise, records=records),
        put_batch=put,
        options=options,
        progress=progress,
    )
    tokenizer: AutoencoderTokenizer
    if config.quantise:
        tokenizer = LfqTokenizer(config, result.state.params)
    else:
        tokenizer = make_continuous(config, result.state.params, make_batches(0))
    save_tokenizer(tokenizer, run_dir)
    return tokenizer


def _modernise(described: dict[str, Any]) -> dict[str, Any]:
    """A description that an earlier version wrote, with the fields that came later (`config.base.later`)."""
    parts = {"tokenizer": TokenizerConfig, "train": TokenizerTrainConfig}
    return described | {name: to_dict(from_dict(kind, described[name])) for name, kind in parts.items()}


def make_optimizer(train: TokenizerTrainConfig, declared: Declared) -> optax.GradientTransformation:
    """AdamW with gradient clipping, a linear warm-up and a cosine decay to `final_fraction`."""
    rate = train.learning_rate
    # A run shorter than its warm-up still reaches the end of its cosine.
    warmup = min(train.warmup_steps, train.steps // 2)
    schedule = optax.warmup_cosine_decay_schedule(0.0, rate, warmup, train.steps, rate * train.final_fraction)
    decay = jax.tree.map(lambda spec: spec.decay, declared.specs, is_leaf=is_spec)
    return optax.chain(
        optax.clip_by_global_norm(train.clip_norm),
        optax.adamw(schedule, b2=0.99, weight_decay=train.weight_decay, mask=decay),
    )


def tokenizer_loss(
    declared: Declared, params: Params, images: jax.Array, config: TokenizerConfig, key: jax.Array
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """(loss, metrics) of images [B, H, W, 3] in 0..255: squared error of the images decoded from quantised or noisy
    latents, plus the quantiser's terms. `key` is for the noise."""
    model = declared.merge(params)
    target = from_pixels(images)
    z = model.encoder(target)
    if config.quantise:
        passed, (penalty, terms) = quantize(z), _regularisers(z, config)
    else:
        passed = z + config.latent_noise * jax.random.normal(key, z.shape, jnp.float32)
        penalty, terms = 0.0, {"latent_std": jnp.std(z)}
    error = jnp.mean((model.decoder(passed) - target) ** 2)
    loss = error + penalty
    psnr = -10.0 * jnp.log10(error / 4.0)  # of the mean error; images span -1..1
    return loss, {"loss": loss, "psnr": psnr, **terms}


def _regularisers(z: jax.Array, config: TokenizerConfig) -> tuple[jax.Array, dict[str, jax.Array]]:
    """(weighted sum, terms): losses that keep latents [B, S, bits] close to their codes, and all codes in use."""
    if not (config.entropy_weight or config.commitment_weight):
        z = jax.lax.stop_gradient(z)  # the terms are only measured: their gradient, all zeros, is not computed
    commit = commitment(z)
    if not config.has_entropies:
        return config.commitment_weight * commit, {"commitment": commit}
    uncertainty, diversity = entropies(z, config.factors, config.entropy_temperature)
    total = config.entropy_weight * (uncertainty - diversity) + config.commitment_weight * commit
    return total, {"uncertainty": uncertainty, "diversity": diversity, "commitment": commit}


@lru_cache(maxsize=4)
def _jitted_step(make: Callable[..., Callable], config: TokenizerConfig, train: TokenizerTrainConfig) -> Callable:
    """The compiled step of `make`, kept for the next training in this process, which is often the same one, resumed.
    `make` is `make_train_step`, or what a test puts in its place; it is an argument so that the two have separate cache
    entries."""
    return jax.jit(make(config, train, declare_tokenizer(config)), donate_argnums=0)


def make_train_step(
    config: TokenizerConfig, train: TokenizerTrainConfig, declared: Declared
) -> Callable[[TrainState, jax.Array], tuple[TrainState, dict[str, jax.Array]]]:
    """A pure step (state, images) -> (state, metrics)."""
    optimizer = make_optimizer(train, declared)

    def step(state: TrainState, images: jax.Array) -> tuple[TrainState, dict[str, jax.Array]]:
        key = jax.random.fold_in(key_of(train.seed), state.step)
        gradient = jax.grad(lambda p: tokenizer_loss(declared, p, images, config, key), has_aux=True)
        grads, metrics = gradient(state.params)
        updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
        params = optax.apply_updates(state.params, updates)
        metrics |= {FINITE + "gradient": all_finite(grads), FINITE + "update": all_finite(params)}
        return TrainState(state.step + 1, params, opt_state), metrics

    return step
