"""The discrete model against numbers made by running the official release."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import MaskingConfig, ModelConfig, OptimizerConfig
from hma_jax.generation import masked_counts, unmask
from hma_jax.objectives import Masked, MaskingDraws, corrupt_and_mask, masked_loss
from hma_jax.params import is_spec
from hma_jax.training.optimizer import (
    apply_adamw,
    clip_by_global_norm,
    init_adam,
    learning_rate_multiplier,
)
from tests.golden.official import Case, to_our_layout


def channels_first(logits_BTSQV: jax.Array, side: int) -> np.ndarray:
    """Our logits in the release's layout: batch, channel (factor-major), time, height, width."""
    b, t, s, q, v = logits_BTSQV.shape
    flat = np.asarray(logits_BTSQV).reshape(b, t, side, s // side, q * v)
    return flat.transpose(0, 4, 1, 2, 3)


@pytest.mark.parametrize("name", ["01b_discrete_concat_modulate_mup", "06a_discrete_qk_norm"])
def test_logits(name: str):
    case = Case(name)
    config, table, declared, params = case.load()
    tokens = jnp.asarray(case.inputs["tokens"].reshape(2, config.frames, config.tokens))
    apply = jax.jit(lambda p, *args: declared.merge(p)(*args)[0])
    for index, robot in enumerate(table.names):
        actions = case.pad(case.inputs[f"actions__{robot}"], table)
        logits = apply(params, tokens, actions, jnp.full(2, index))
        case.check(f"logits__{robot}", channels_first(logits, 4))
        if "logits_short_window" in case.outputs and index == 0:
            logits = apply(params, tokens[:, :3], actions[:, :3], jnp.full(2, index))
            case.check("logits_short_window", channels_first(logits, 4))
    logits = apply(params, tokens, None, jnp.zeros(2, jnp.int32))
    case.check("logits__no_action", channels_first(logits, 4))


def test_training_steps_move_every_parameter_as_the_release_does():
    """Five updates with absent robots, muP learning rates, clipping and decay."""
    case = Case("13_discrete_train_steps")
    config, table, declared, params = case.load()
    settings = case.info["optimizer"]
    optimizer = OptimizerConfig(
        learning_rate=settings["lr"],
        weight_decay=settings["weight_decay"],
        beta1=settings["beta1"],
        beta2=settings["beta2"],
        epsilon=settings["eps"],
        clip_norm=settings["max_grad_norm"],
    )
    multipliers = jax.tree.map(
        lambda spec: learning_rate_multiplier(spec, config), declared.specs, is_leaf=is_spec
    )

    def step(params, state, inputs, labels, actions, embodiment):
        def mean_loss(p):
            masked = Masked(inputs, inputs == config.mask_id)
            sums = masked_loss(declared.merge(p), masked, labels, actions, embodiment, 0.01)
            return sums.loss / sums.count

        loss, grads = jax.value_and_grad(mean_loss)(params)
        grads, norm = clip_by_global_norm(grads, optimizer.clip_norm)
        present = jnp.zeros(table.size, bool).at[embodiment].set(True)
        rate = jnp.float32(optimizer.learning_rate)
        new = apply_adamw(
            grads, state, params, declared.specs, multipliers, present, rate, optimizer
        )
        return *new, loss, norm

    step = jax.jit(step)
    state = init_adam(params, table.size)
    losses, norms = [], []
    shape = (2, config.frames, config.tokens)
    for s, robot in enumerate(case.info["step_domains"]):
        inputs = jnp.asarray(case.inputs["input_ids"][s].reshape(shape))
        labels = jnp.asarray(case.inputs["labels"][s].reshape(shape))
        actions = case.pad(case.inputs[f"actions__step{s}"], table)
        embodiment = jnp.full(2, table.index(robot))
        params, state, loss, norm = step(params, state, inputs, labels, actions, embodiment)
        losses.append(float(loss))
        norms.append(float(norm))
    case.check("loss_per_step", np.array(losses, np.float32))
    case.check("grad_norm_before_clip_per_step", np.array(norms, np.float32))

    final = {k.removeprefix("final::"): v for k, v in case.outputs.items() if k.startswith("final::")}
    tolerance = {k.removeprefix("final::"): v for k, v in case.info["tolerance"].items()}
    want = to_our_layout(final, config, table)
    atol = max(tolerance[name]["atol"] for name in final)
    flat = {
        "/".join(str(k.key) for k in path): np.asarray(leaf)
        for path, leaf in jax.tree.leaves_with_path(params)
    }
    assert set(flat) == set(want)
    for path, array in want.items():
        np.testing.assert_allclose(flat[path], array, rtol=1e-4, atol=atol, err_msg=path)


def test_unmasking_keeps_and_fills_what_the_release_does():
    """Whole frames decoded greedily with recorded numbers deciding the order."""
    case = Case("05_discrete_generation")
    config, table, declared, params = case.load()
    out_t = case.info["out_t"]
    actions = jnp.asarray(case.pad(case.inputs["actions__arm7"], table))
    tokens = jnp.asarray(case.inputs["tokens"].reshape(2, config.frames, config.tokens))
    window = tokens.at[:, out_t:].set(config.mask_id)

    @jax.jit
    def look(frame):
        logits, _ = declared.merge(params)(window.at[:, out_t].set(frame), actions, jnp.zeros(2, int))
        ids = jnp.argmax(logits[:, out_t], -1)
        powers = config.factor_vocab ** jnp.arange(config.factors)
        return logits[:, out_t], jnp.sum(ids * powers, -1)

    for run, steps in (("m1", 1), ("m2_random", 2), ("m3_random", 3)):
        frame = window[:, out_t]
        states = []
        for k, keep in enumerate([*masked_counts(steps, config.tokens), 0]):
            logits, ids = look(frame)
            if k == 0:
                # batch, class, factor, height, width
                first = np.asarray(logits).transpose(0, 3, 2, 1).reshape(2, -1, 2, 4, 4)
                case.check(f"{run}_first_logits", first)
            score = case.inputs.get(f"rand__{run}__{k}", np.zeros((2, 4, 4), np.float32))
            frame = unmask(frame, ids, jnp.asarray(score.reshape(2, -1)), keep, config.mask_id)
            states.append(np.asarray(frame).reshape(2, 4, 4))
        case.check(f"{run}_tokens", states[-1].astype(case.outputs[f"{run}_tokens"].dtype))
        if f"{run}_states" in case.outputs:
            want = case.outputs[f"{run}_states"]
            case.check(f"{run}_states", np.stack(states, axis=1).astype(want.dtype))


@pytest.mark.parametrize("mode", ["mlm", "prompt"])
def test_masking_of_recorded_random_numbers(mode: str):
    case = Case("14_collators")
    settings, inputs = case.settings["discrete"], case.inputs
    frames, side = case.inputs["tokens"].shape[1:3]
    config = ModelConfig(
        frames=frames,
        tokens=side * side,
        factors=settings["num_factored_vocabs"],
        factor_vocab=settings["factored_vocab_size"],
    )
    masking = MaskingConfig(
        max_corrupt_rate=settings["max_corrupt_rate"],
        clean_rate_min=settings["dataloader_mask_ratio_min"],
    )
    first = case.info["first_masked_frame"] if mode == "prompt" else 1
    entries = (frames, side * side, 2)

    def from_first(recorded: np.ndarray) -> jax.Array:
        """Numbers are recorded from the first masked frame on; earlier ones do not matter."""
        return jnp.asarray(np.concatenate([np.ones((first, *recorded.shape[1:])), recorded]), jnp.float32)

    for b in range(2):
        u_clean, u_decay = np.float32(1), np.ones(frames - first)
        degrade = np.zeros((frames - first, *entries[1:]))
        if mode == "prompt":
            u_clean, u_decay = inputs["prompt__uniform"][0], inputs["prompt__uniform"][1:]
            degrade = inputs["prompt__frame_r"][:, b].reshape(degrade.shape)
        draws = MaskingDraws(
            u_corrupt=jnp.float32(inputs[f"{mode}__corrupt_u"]),
            u_replace_TSQ=jnp.asarray(inputs[f"{mode}__corrupt_r"][b].reshape(entries)),
            noise_TSQ=jnp.asarray(inputs[f"{mode}__random_values"][b].reshape(entries)),
            first_masked=jnp.int32(first),
            u_clean=jnp.float32(u_clean),
            u_decay_T=from_first(u_decay),
            u_degrade_TSQ=from_first(degrade),
            u_rate_T=from_first(inputs[f"{mode}__mask_prob_u"][b].reshape(-1)),
            u_mask_TS=from_first(inputs[f"{mode}__mask_r"][b].reshape(frames - first, -1)),
        )
        tokens = jnp.asarray(inputs["tokens"][b].reshape(frames, -1).astype(np.int32))
        got = corrupt_and_mask(tokens, draws, config, masking)
        want = case.outputs[f"{mode}__input_ids"][b].reshape(frames, -1)
        np.testing.assert_array_equal(np.asarray(got.inputs_TS), want)
