"""Whether activations keep their size as the model widens: the coordinate check of muP.

Models of several widths take the same few training steps on one fixed batch. Before every step the sizes (root mean
square) of activations are recorded. Under muP no size grows with width, and no change by training grows or fades with
it (Tensor Programs V, appendix D.1). The check needs a large learning rate: a small one hides errors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from hma_jax.config import ModelConfig, TrainConfig, require
from hma_jax.kernels.random import key_of
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.hma import HMA, declare_model
from hma_jax.objective.losses import draw_noise
from hma_jax.objective.masking import Masked, mask_batch
from hma_jax.training.state import TrainState, init_state
from hma_jax.training.step import Batch, make_train_step


class Size(NamedTuple):
    """The size of `quantity` after `step` training steps, and of its change since step 0, as root mean squares."""

    quantity: str
    width: int
    seed: int
    step: int
    size: float
    change: float


class Slope(NamedTuple):
    """The powers of the width with which the size of a quantity and of its change since step 0 grow."""

    size: float
    change: float


# --- Measuring -------------------------------------------------------------------------------


class _RecordingTrunk:
    """Replaces a trunk: runs its blocks one by one, not in a scan, and records their activations."""

    def __init__(self, model: HMA, record: Callable[[str, jax.Array], None]):
        self.blocks, self.layers, self.record = model.trunk.blocks, model.config.layers, record

    def __call__(self, x: jax.Array, *rest: Any) -> tuple[jax.Array, None]:
        block_def, layers = nnx.split(self.blocks)
        logits = []

        def record_logits(scale: float, pairs: str, qkv: jax.Array) -> None:
            logits.append(scale * jnp.einsum(pairs, qkv[..., 0, :, :], qkv[..., 1, :, :]))

        for index in range(self.layers):
            block = nnx.merge(block_def, jax.tree.map(lambda p, i=index: p[i], layers))
            for attention, pairs in ((block.space, "btphi,btshi->bthps"), (block.time, "btphi,bsphi->bphts")):
                _record_outputs(attention, "project", partial(record_logits, attention.scale, pairs))
            x, _ = block(x, *rest[:3], None)
        self.record("attention logits", jnp.concatenate([y.ravel() for y in logits]))
        self.record("residual stream", x)
        return x, None


def _record_outputs(module: Any, name: str, record: Callable[[Any], None]) -> None:
    """Wraps the method `name` of `module`: `record` is called with every result."""
    inner = getattr(module, name)

    def recorded(*args: Any) -> Any:
        result = inner(*args)
        record(result)
        return result

    setattr(module, name, recorded)


def observe(model: HMA, masked: Masked, batch: Batch) -> dict[str, jax.Array]:
    """Activations of one pass over a batch masked as in training, by name.

    "attention logits" (all of them, also those of invisible keys), "residual stream" after the last block, "logits" or
    "conditions" of the frames, then "denoiser condition" and "denoiser" (fixed noise and times) in the continuous
    variant, and "actions" where there is an action head.
    """
    activations: dict[str, jax.Array] = {}
    record = activations.__setitem__
    model.trunk = _RecordingTrunk(model, record)
    hidden = model.align_hidden(masked.action_hidden_T, masked.action_hidden_T.shape)
    embodiment_B = batch["embodiment"]
    out = model(masked.inputs, masked.masked, model.align(batch["actions"]), embodiment_B, action_hidden_BT=hidden)
    diffusion = model.config.diffusion
    if diffusion:
        record("conditions", out.token_outputs)
        key = key_of(0)
        time, noise = draw_noise(key, batch["tokens"].shape, diffusion.steps)
        _record_outputs(model.denoiser, "condition", lambda y: record("denoiser condition", y))
        record("denoiser", model.denoiser(noise, time, out.token_outputs))
    else:
        record("logits", model.logits(out.token_outputs, batch["tokens"]))
    if model.action_head is not None and out.action_features_BTD is not None:
        args = draw_noise(key, batch["actions"].shape, diffusion.steps)[::-1] if diffusion else ()
        record("actions", model.action_head(*args, out.action_features_BTD, embodiment_B))
    return activations


def measure(
    model: ModelConfig,
    train: TrainConfig,
    table: EmbodimentTable,
    batch: Batch,
    widths: Sequence[int],
    seeds: Sequence[int] = (0,),
    compiler_options: dict[str, Any] | None = None,
) -> list[Size]:
    """The table of sizes for `model` at each of `widths`, over `train.steps` steps from 0.

    `seeds` draw only the parameters; masks, noise and the batch are the same for all. Rows are in the order width,
    seed, step. `compiler_options` are passed to `jax.jit`: for tiny models compiling takes nearly all the time.
    """
    mask = jax.jit(lambda key: mask_batch(key, batch["tokens"], batch["embodiment"], model, train.masking, table))
    masked = mask(key_of(train.seed))
    rows = []
    for width in widths:
        config = replace(model, width=width)
        declared = declare_model(config, table)
        train_step = make_train_step(declared, table, config, train)

        def body(state: TrainState, _: None) -> tuple[TrainState, dict[str, jax.Array]]:
            return train_step(state, batch)[0], observe(declared.merge(state.params), masked, batch)

        run = jax.jit(
            lambda state: jax.lax.scan(body, state, length=train.steps + 1)[1],
            compiler_options=compiler_options,
        )
        for seed in seeds:
            activations = jax.device_get(run(init_state(declared, table, seed)))
            rows += [
                Size(quantity, width, seed, step, _rms(values[step]), _rms(values[step] - values[0]))
                for step in range(train.steps + 1)
                for quantity, values in activations.items()
            ]
    return rows


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x, dtype=np.float64))))


# --- Judging ---------------------------------------------------------------------------------


def slopes(rows: Sequence[Size]) -> dict[str, Slope]:
    """Every quantity's slopes of log size over log width, fitted to the second half of the steps.

    In the first half, what training adds is small beside the random start, which may fade with width. A slope is not a
    number where a size is zero or not finite.
    """
    widths = {row.width for row in rows}
    require(len(widths) > 1, f"a coordinate check needs at least two widths, got {sorted(widths)}")
    last = max(row.step for row in rows)
    late = [row for row in rows if row.step > last / 2]
    fitted = {}
    for quantity in dict.fromkeys(row.quantity for row in late):
        own = [row for row in late if row.quantity == quantity]
        x = np.log([row.width for row in own])
        x -= x.mean()
        with np.errstate(all="ignore"):
            sizes = np.log([[row.size, row.change] for row in own])
            fitted[quantity] = Slope(*map(float, x @ sizes / (x @ x)))
    return fitted


GROW, FADE = 0.2, 0.4
"""The largest exponents of the width with which sizes may grow, and with which changes by training may fade
(`check_coordinates`)."""


def check_coordinates(rows: Sequence[Size]) -> list[str]:
    """What is wrong, one line per finding; empty where width transfer can be expected.

    Neither a size nor its change by training may grow faster than width^GROW, nor the change fade
    faster than width^-FADE. Fading has more room: until learning has outgrown it, the contribution of the random start
    fades as width^-0.5 even in a correct model. Passing is necessary for transfer, not sufficient.
    """
    findings = []
    for quantity, slope in slopes(rows).items():
        if not np.isfinite(slope).all():
            findings.append(f"{quantity}: zero or not finite at some width")
            continue
        if slope.size > GROW:
            findings.append(f"{quantity}: grows as width^{slope.size:.2f}")
        if slope.change > GROW or slope.change < -FADE:
            verb = "grows" if slope.change > 0 else "fades"
            findings.append(f"{quantity}: its change in training {verb} as width^{slope.change:.2f}")
    return findings
