"""Cases of the continuous model: forward pass and sampler, loss and gradients, generation, actions."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import SamplerConfig
from hma_jax.generation.decoding import Frame, choose_patches, commit, masked_counts
from hma_jax.model.frames import mask_cells, patchify, unpatchify
from hma_jax.objective.diffusion import diffusion_loss
from hma_jax.objective.process import make_process, sampling_process
from tests.golden.case import Case, norms
from tests.golden.discrete import applier, with_frame
from tests.sampling import sample_recorded, trajectory_of

_patchify, _unpatchify, _mask_cells = (
    jax.jit(function, static_argnums=fixed)
    for function, fixed in ((patchify, 1), (unpatchify, (1, 2)), (mask_cells, 3))
)
_choose_patches, _commit = jax.jit(choose_patches, static_argnums=(1, 2)), jax.jit(commit)


class Latents:
    """Recorded latents [B, T, h, w, c] as tokens [B, T, S, C], and back."""

    def __init__(self, case: Case):
        self.config = case.run.model.diffusion
        latents = case.inputs["latents"]
        self.batch, self.frames, h, w, _ = latents.shape
        self.grid = (h // self.config.patch, w // self.config.patch)
        self.tokens = np.asarray(_patchify(latents, self.config.patch))

    def masked(self, indicator: np.ndarray) -> np.ndarray:
        """bool [B, T, S, cells] from bool [B, T, h, w]."""
        return np.asarray(_patchify(indicator[..., None], self.config.patch))

    def on_grid(self, x: jax.Array) -> np.ndarray:
        """[..., S, n] -> [..., rows, columns, n]."""
        return np.asarray(x).reshape(*x.shape[:-2], *self.grid, x.shape[-1])

    def channels_first(self, z: jax.Array) -> np.ndarray:
        """[B, ..., S, D] -> batch, channel, ..., row, column."""
        return np.moveaxis(self.on_grid(z), -1, 1)

    def cells(self, tokens: np.ndarray) -> jax.Array:
        return _unpatchify(tokens, self.config.patch, self.grid[1])


def make_sampler(case: Case, head: Callable, temperature: float, run: Callable = sample_recorded) -> Callable:
    """sample(condition, noise_init, noise_steps): the release's sampler with recorded noise.

    head(model, x, t, condition) is a denoising network.
    """
    steps = int(case.settings["num_sampling_steps"])
    config = case.run.model.diffusion
    # As released, temperature multiplies the noise of the steps only.
    sampler = SamplerConfig(steps=steps, temperature=temperature, scale_initial_noise=False)
    process = sampling_process(make_process(config.steps), sampler)

    @jax.jit
    def sample(params, condition, start, noises):
        model = case.declared.merge(params)

        def network(x, t):
            return head(model, x, t, condition)

        noises = noises if sampler.noisy_steps else None
        return run(network, start, noises, process, sampler, config.clip)

    return functools.partial(sample, case.params)


def frame_head(model, x: jax.Array, t: jax.Array, condition: jax.Array) -> jax.Array:
    return model.denoiser(x, t, condition)


# --- Forward -----------------------------------------------------------------------------------


def check_forward(case: Case) -> None:
    latents, apply = Latents(case), applier(case)
    tokens, masked = latents.tokens, latents.masked(case.inputs["masked_tokens_indicator"])
    model = case.declared.merge(case.params)
    case.check("patches_of_latents", latents.on_grid(tokens))
    replaced = _mask_cells(tokens, masked, model.embed.mask.get_value(), case.run.model.diffusion)
    case.check("masked_patches", latents.on_grid(replaced))

    def check_z(output, actions, robot, frames=None):
        robots = case.robot(robot, latents.batch)
        z = apply(tokens[:, :frames], masked[:, :frames], actions, robots).token_outputs
        case.check(output, latents.channels_first(z))

    for robot in case.domains:
        check_z(f"z__{robot}", case.actions(robot), robot)
    if "z__no_action" in case.outputs:
        check_z("z__no_action", None, case.domains[0])
    if "z_short_window" in case.outputs:
        short = case.info["short_window"]
        check_z("z_short_window", case.actions(case.domains[0])[:, :short], case.domains[0], short)

    if "head_t" in case.inputs:
        time, condition = (case.inputs[f"head_{name}"] for name in "tc")
        denoise = jax.jit(lambda params, *inputs: frame_head(case.declared.merge(params), *inputs))
        case.check("head_output", denoise(case.params, case.inputs["head_x_t"], time, condition))
        for robot in [r for r in case.domains if f"action_head_x_t__{r}" in case.inputs]:
            case.check(f"action_head_output__{robot}", _action_head(case, robot, time, condition))
    if "sample_c" in case.inputs:
        _check_sampler(case)


def _check_sampler(case: Case) -> None:
    condition = case.inputs["sample_c"]
    noise = case.inputs["sample_noise_init"], case.inputs["sample_noise_steps"]
    case.check("sample_temperature1", make_sampler(case, frame_head, 1.0)(condition, *noise))
    visited = make_sampler(case, frame_head, 1.0, trajectory_of)(condition, *noise)
    case.check("sample_trajectory", visited.x)
    case.check("sample_pred_x0", visited.x0)
    case.check("sample_temperature0", make_sampler(case, frame_head, 0.0)(condition, *noise))


def _pad(case: Case, x: np.ndarray) -> np.ndarray:
    """[..., chunk] -> [..., U]."""
    return np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, case.table.action_width - x.shape[-1])])


def _action_head(case: Case, robot: str, time: np.ndarray, condition: np.ndarray) -> np.ndarray:
    """Rows [n, 2 chunk] of one robot's head."""
    x = case.inputs[f"action_head_x_t__{robot}"]
    head = jax.jit(lambda params, *inputs: case.declared.merge(params).action_head(*inputs))
    inputs = _pad(case, x)[None], time[None], condition[None], case.robot(robot, 1)
    out = np.asarray(head(case.params, *inputs))[0]
    return out.reshape(len(x), 2, -1)[..., : x.shape[-1]].reshape(len(x), -1)


# --- Loss --------------------------------------------------------------------------------------


def frame_loss(model, case: Case, tokens: jax.Array, z: jax.Array, masked: jax.Array):
    """(loss, mse, vb) with the recorded times and noises; rows are ordered repeat, sample, time, patch."""
    shape = (-1, *tokens.shape[:3])
    time = jnp.asarray(case.inputs["t"]).reshape(shape)
    noise = jnp.asarray(case.inputs["noise"]).reshape(*time.shape, -1)
    z, x0 = (jnp.broadcast_to(x, (*time.shape, x.shape[-1])) for x in (z, tokens))
    process = make_process(case.run.model.diffusion.steps)
    mse, vb = diffusion_loss(lambda x, t: model.denoiser(x, t, z), x0, time, noise, process)
    weight = jnp.broadcast_to(masked.any(-1), mse.shape)
    return jnp.sum((mse + vb) * weight) / jnp.sum(weight), mse, vb


def check_loss(case: Case) -> None:
    latents = Latents(case)
    tokens, masked = latents.tokens, latents.masked(case.inputs["masked_tokens_indicator"])
    case.check("patch_mask", np.asarray(masked.any(-1)).reshape(*tokens.shape[:2], *latents.grid))

    @jax.jit
    def gradient(params, actions, robots):
        def loss(p):
            model = case.declared.merge(p)
            z = model(tokens, masked, actions, robots).token_outputs
            total, *rows = frame_loss(model, case, tokens, z, masked)
            return total, rows

        return jax.value_and_grad(loss, has_aux=True)(params)

    for index, robot in enumerate(case.domains):
        robots = case.robot(robot, latents.batch)
        (loss, (mse, vb)), grads = gradient(case.params, case.actions(robot), robots)
        case.check(f"loss__{robot}", loss)
        case.check(f"per_token_mse__{robot}", mse.ravel())
        case.check(f"per_token_vb__{robot}", vb.ravel())
        if index == 0:
            named = case.official(grads)
            case.check_group("grad", named)
            case.check_group("gradnorm", norms(named))
            case.check_zero(named, case.info["unused_parameters"])


# --- Generation --------------------------------------------------------------------------------


def check_generation(case: Case) -> None:
    latents, apply = Latents(case), applier(case)
    robot, config = case.domains[0], case.run.model
    robots, actions = case.robot(robot, latents.batch), case.actions(robot)
    sampler = functools.cache(lambda temperature: make_sampler(case, frame_head, temperature))

    def decode(window, unknown, t, steps, temperature, order, noise_name):
        """(frame, first conditions, patches after each step), as released: nothing is marked as known."""
        frame = Frame(np.zeros_like(window[:, t]), np.ones(window[:, t].shape[:2], bool))
        states, first = [], None
        for step, keep in enumerate(masked_counts(config, steps)):
            ids, masked = with_frame(window, t, frame.values), with_frame(unknown, t, frame.masked)
            z = np.asarray(apply(ids, masked, actions[:, : window.shape[1]], robots).token_outputs)[:, t]
            first = z if first is None else first
            chosen = np.asarray(_choose_patches(order, order.shape[1], keep))
            condition = np.take_along_axis(z, chosen[..., None], axis=1)
            rows = condition.reshape(-1, condition.shape[-1])
            noise = [case.inputs[f"noise_{kind}__{noise_name}__{step}"] for kind in ("init", "steps")]
            new = np.asarray(sampler(temperature)(rows, *noise)).reshape(*chosen.shape, -1)
            frame = _commit(frame, chosen, new)
            vector = case.declared.merge(case.params).embed.mask.get_value()
            states.append(_mask_cells(frame.values, frame.masked, vector, config.diffusion))
        return np.asarray(frame.values), first, np.stack(states, axis=1)

    for run, settings in case.info["runs"].items():
        tokens = latents.tokens[:, : settings.get("window", latents.frames)]
        t = settings["out_t"]
        unknown = np.broadcast_to((np.arange(tokens.shape[1]) >= t)[None, :, None], tokens.shape[:3])
        order = case.inputs[f"order__{run}"]
        frame, first, states = decode(tokens, unknown, t, settings["M"], settings["temperature"], order, run)
        case.check(f"{run}_frame", latents.cells(frame))
        case.check(f"{run}_first_z", latents.channels_first(first))
        case.check(f"{run}_patch_states", latents.on_grid(states))

    settings, steps = case.info.get("generate"), case.settings["maskgit_steps"]
    if settings:
        window, prompt = latents.tokens, settings["num_prompt"]
        unknown = np.broadcast_to((np.arange(latents.frames) >= prompt)[None, :, None], window.shape[:3])
        for new, t in enumerate(range(prompt, latents.frames)):
            name = f"generate__{new}"
            order = case.inputs[f"order__{name}"]
            frame, _, _ = decode(window, unknown, t, steps, settings["temperature"], order, name)
            window, unknown = with_frame(window, t, frame), with_frame(unknown, t, False)
        flat = np.asarray(latents.cells(window))
        case.check("generate_latents", flat.reshape(latents.batch, -1, flat.shape[-1]))


# --- Actions -----------------------------------------------------------------------------------


def check_joint(case: Case) -> None:
    latents, apply = Latents(case), applier(case)
    tokens, masked = latents.tokens, latents.masked(case.inputs["masked_tokens_indicator"])
    for robot in case.domains:
        out = apply(tokens, masked, case.actions(robot), case.robot(robot, latents.batch))
        case.check(f"z_given__{robot}", latents.channels_first(out.token_outputs))
        case.check(f"action_z_given__{robot}", out.action_features_BTD)

    robot = case.domains[0]
    robots = case.robot(robot, latents.batch)
    everything = np.ones(tokens.shape[:2], bool)
    out = apply(tokens, masked, np.zeros_like(case.actions(robot)), robots, everything)
    case.check("z_policy", latents.channels_first(out.token_outputs))
    case.check("action_z_policy", out.action_features_BTD)

    rows = np.asarray(out.action_features_BTD).reshape(1, -1, out.action_features_BTD.shape[-1])

    def head(model, x, t, z):
        return model.action_head(x[None], t[None], z, robots[:1])[0]

    noise = [_pad(case, case.inputs[f"action_noise_{kind}"]) for kind in ("init", "steps")]
    chunk = case.table.entries[case.table.index(robot)].chunk
    case.check("action_sample_policy", np.asarray(make_sampler(case, head, 1.0)(rows, *noise))[:, :chunk])
    if "train_loss" in case.outputs:
        _check_joint_training(case, latents, robot)


def _check_joint_training(case: Case, latents: Latents, robot: str) -> None:
    """As released: actions are shown, raw ones are the target, and chunks from a random one on count."""
    tokens, masked = latents.tokens, latents.masked(case.inputs["masked_tokens_indicator"])
    robots, actions = case.robot(robot, latents.batch), case.actions(robot)
    shape = actions.shape[:2]
    time = case.inputs["action_t"].reshape(shape)
    noise = _pad(case, case.inputs["action_noise"]).reshape(*shape, -1)
    hidden = np.arange(shape[1])[None] >= case.inputs["action_mask_start"].reshape(-1, 1)
    chunk = case.table.entries[case.table.index(robot)].chunk
    own = np.broadcast_to(np.arange(actions.shape[-1]) < chunk, actions.shape)
    weight, process = case.settings["action_loss_weight"], make_process(case.run.model.diffusion.steps)

    @jax.jit
    def gradient(params):
        def total(p):
            model = case.declared.merge(p)
            out = model(tokens, masked, actions, robots, action_hidden_BT=hidden, leak="all")
            loss, _, _ = frame_loss(model, case, tokens, out.token_outputs, masked)

            def network(x, t):
                return model.action_head(x, t, out.action_features_BTD, robots)

            mse, vb = diffusion_loss(network, actions, time, noise, process, valid=own)
            action_loss = jnp.sum((mse + vb) * hidden) / jnp.sum(hidden)
            return loss + weight * action_loss, (loss, action_loss)

        return jax.grad(total, has_aux=True)(params)

    grads, (loss, action_loss) = gradient(case.params)
    case.check("train_loss", loss)
    case.check("train_action_loss", action_loss)
    named = case.official(grads)
    case.check_group("grad", named)
    case.check_group("gradnorm", norms(named))
    case.check_zero(named, case.info["unused_parameters"])
