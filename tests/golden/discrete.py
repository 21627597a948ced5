"""Cases of the discrete model: logits, loss and gradients, generation."""

from __future__ import annotations

import re
from dataclasses import replace

import jax
import numpy as np

from hma_jax.config import DecodeConfig, MaskingConfig
from hma_jax.generation import rollout
from hma_jax.generation.decoding import Frame, masked_counts, sample_tokens, unmask
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.frames import factorise
from hma_jax.model.hma import declare_model
from hma_jax.objective.losses import masked_loss, smoothed_cross_entropy
from hma_jax.objective.masking import Masked
from tests.golden.case import Case, norms
from tests.golden.mup_table import check_mup_table

MASKING = MaskingConfig()


def check_channels_first(case: Case, output: str, logits_BTSQV: jax.Array) -> None:
    """Our logits in the release's layout: batch, channel (factor-major), time, height, width; without
    the time where only the last frame is recorded."""
    if output not in case.outputs:
        return
    want = case.outputs[output]
    b, t, _, q, v = logits_BTSQV.shape
    got = np.moveaxis(np.asarray(logits_BTSQV).reshape(b, t, *want.shape[-2:], q * v), -1, 1)
    case.check(output, got if got.ndim == want.ndim else got[:, :, -1])


def windows(case: Case, name: str) -> tuple[np.ndarray, np.ndarray]:
    """(ids [B, T, S], masked): official ids hold the vocabulary's size where masked."""
    ids = case.inputs[name].astype(np.int32)
    ids = ids.reshape(len(ids), -1, case.run.model.tokens)
    masked = ids == case.run.model.vocab_size
    return np.where(masked, 0, ids), masked


def applier(case: Case):
    """apply(tokens, masked, actions, robots, hidden=None) -> Outputs, compiled."""

    @jax.jit
    def apply(params, tokens, masked, actions, robots, hidden):
        return case.declared.merge(params)(tokens, masked, actions, robots, action_hidden_BT=hidden)

    return lambda tokens, masked, actions, robots, hidden=None: apply(
        case.params, tokens, masked, actions, robots, hidden
    )


def check_logits(case: Case) -> None:
    ids, masked = windows(case, "tokens")
    apply, batch = applier(case), len(ids)

    def check(output, actions, robot, frames=None):
        out = apply(ids[:, :frames], masked[:, :frames], actions, case.robot(robot, batch))
        check_channels_first(case, output, out.token_outputs)

    for robot in case.domains:
        check(f"logits__{robot}", case.actions(robot), robot)
    if "logits__no_action" in case.outputs:
        check("logits__no_action", None, case.domains[0])
    if "logits_short_window" in case.outputs:
        short = case.info["short_window"]
        check("logits_short_window", case.actions(case.domains[0])[:, :short], case.domains[0], short)
    if "logits_skip_normalization" in case.outputs:
        robot = case.domains[-1]
        plain = [replace(e, mean=(0.0,) * e.action_dim, std=(1.0,) * e.action_dim) for e in case.table.entries]
        declared = declare_model(case.run.model, EmbodimentTable(tuple(plain)))
        out = jax.jit(lambda p, *args: declared.merge(p)(*args).token_outputs)(
            case.params, ids, masked, case.actions(robot), case.robot(robot, batch)
        )
        check_channels_first(case, "logits_skip_normalization", out)


# --- Loss --------------------------------------------------------------------------------------


def as_masked(ids: np.ndarray, masked: np.ndarray, hidden: np.ndarray | None = None) -> Masked:
    """Recorded masks as our collator would give them: frame 0 is never a target."""
    targets = masked & (np.arange(ids.shape[1]) > 0)[None, :, None]
    if hidden is None:
        hidden = np.zeros(ids.shape[:2], bool)
    return Masked(ids, masked, targets, hidden, hidden)


def loss_and_accuracy(model, masked: Masked, labels, actions, robots, masking: MaskingConfig = MASKING):
    keys = jax.random.split(jax.random.key(0), len(labels))  # of no effect on ids
    sums = masked_loss(model, masked, labels, actions, robots, masking, keys, training=True)
    count = masked.targets_TS.sum()
    return sums.tokens / count, sums.correct / count


def check_loss(case: Case) -> None:
    ids, masked = windows(case, "input_ids")
    labels, _ = windows(case, "labels")
    recorded, apply, batch = as_masked(ids, masked), applier(case), len(ids)

    @jax.jit
    def gradient(params, actions, robots):
        def loss(p):
            return loss_and_accuracy(case.declared.merge(p), recorded, labels, actions, robots)

        return jax.value_and_grad(loss, has_aux=True)(params)

    for index, robot in enumerate(case.domains):
        actions, robots = case.actions(robot), case.robot(robot, batch)
        (loss, accuracy), grads = gradient(case.params, actions, robots)
        case.check(f"loss__{robot}", loss)
        case.check(f"acc__{robot}", accuracy)
        logits = apply(ids, masked, actions, robots).token_outputs
        check_channels_first(case, f"logits__{robot}", logits)
        check_channels_first(case, f"logits_last_frame__{robot}", logits)
        if index == 0:
            named = case.official(grads)
            case.check_group("grad", named)
            case.check_group("gradnorm", norms(named))
            case.check_zero(named, case.info["unused_parameters"])

    if "loss__no_action" in case.outputs:

        @jax.jit
        def loss_of(logits):
            digits = factorise(labels, case.run.model.factors, case.run.model.factor_vocab)
            weight = recorded.targets_TS / recorded.targets_TS.sum()
            per_token, _ = smoothed_cross_entropy(logits, digits, MASKING.label_smoothing)
            right = (logits.argmax(-1) == digits).all(-1)
            return (per_token * weight).sum(), (right * weight).sum()

        loss, accuracy = loss_of(apply(ids, masked, None, case.robot(case.domains[0], batch)).token_outputs)
        case.check("loss__no_action", loss)
        case.check("acc__no_action", accuracy)
    if (case.folder / "mup_table.json").exists():
        check_mup_table(case)


# --- Generation --------------------------------------------------------------------------------


def classes_first(logits_BSQV: np.ndarray, grid: tuple[int, int]) -> np.ndarray:
    """The release's layout of a frame's logits: batch, class, factor, height, width."""
    b, _, q, v = logits_BSQV.shape
    return logits_BSQV.transpose(0, 3, 2, 1).reshape(b, v, q, *grid)


def with_frame(window: np.ndarray, t: int, values: np.ndarray | jax.Array | bool) -> np.ndarray:
    """A copy of [B, T, ...] with `values` as frame t."""
    copy = np.array(window)
    copy[:, t] = values
    return copy


class Decoder:
    """The release's inner loop over one frame of a whole window, by our parts and recorded numbers."""

    def __init__(self, case: Case, actions: np.ndarray | None, hidden: np.ndarray | None = None):
        self.case, self.apply = case, applier(case)
        self.actions, self.hidden = actions, hidden
        head = case.declared.merge(case.params).frame_head
        self.draw = jax.jit(lambda logits, keys: sample_tokens(head, logits, keys, 0.0))
        self.unmask = jax.jit(unmask)

    def run(self, window: np.ndarray, unknown: np.ndarray, t: int, steps: int, scores: list[np.ndarray] | None):
        """(frame, first logits, frames after each step, the last pass). Without `scores` by confidence."""
        config, batch = self.case.run.model, len(window)
        robots, keys = (
            self.case.robot(self.case.domains[0], batch),
            jax.random.split(jax.random.key(0), batch),
        )
        frame = Frame(np.zeros_like(window[:, t]), np.ones(window[:, t].shape, bool))
        states, first = [], None
        for step, keep in enumerate(masked_counts(config, steps)):
            ids, masked = with_frame(window, t, frame.values), with_frame(unknown, t, frame.masked)
            out = self.apply(ids, masked, self.actions, robots, self.hidden)
            logits = np.asarray(out.token_outputs)[:, t]
            first = logits if first is None else first
            sampled, score = self.draw(logits, keys)
            if keep and scores is not None:
                score = scores[step].reshape(batch, -1)
            frame = self.unmask(frame, sampled, score, keep)
            states.append(np.where(frame.masked, config.vocab_size, frame.values))
        return np.asarray(frame.values), first, np.stack(states, axis=1), out

    def generate(self, tokens: np.ndarray, prompt: int, steps: int, scores: list[np.ndarray]):
        """(whole window [B, T, S], first logits of every new frame, the last pass)."""
        frames = tokens.shape[1]
        unknown = np.broadcast_to((np.arange(frames) >= prompt)[None, :, None], tokens.shape)
        window, firsts, out = tokens, [], None
        for new, t in enumerate(range(prompt, frames)):
            own = scores[new * (steps - 1) : (new + 1) * (steps - 1)]
            frame, first, _, out = self.run(window, unknown, t, steps, own)
            window, unknown = with_frame(window, t, frame), with_frame(unknown, t, False)
            firsts.append(first)
        return window, firsts, out


def recorded_scores(case: Case, run: str) -> list[np.ndarray]:
    count = sum(key.startswith(f"rand__{run}__") for key in case.inputs)
    return [case.inputs[f"rand__{run}__{k}"] for k in range(count)]


def check_generation(case: Case) -> None:
    tokens, _ = windows(case, "tokens")
    grid = case.inputs["tokens"].shape[-2:]
    robot, out_t, prompt = case.domains[0], case.info["out_t"], case.info["num_prompt"]
    actions = case.actions(robot)
    later = np.broadcast_to((np.arange(tokens.shape[1]) >= out_t)[None, :, None], tokens.shape)

    def as_frame(x):
        return np.asarray(x).reshape(*x.shape[:-1], *grid)

    with_actions, without = Decoder(case, actions), Decoder(case, None)
    runs = {m.group(1) for m in (re.fullmatch(r"(m\d+\w*?)_tokens", key) for key in case.outputs) if m}
    for run in sorted(runs):
        steps, kind = re.fullmatch(r"m(\d+)_?(.*)", run).groups()
        if kind not in ("", "random", "greedy", "no_action"):
            continue  # reported as not checked
        decoder = without if kind == "no_action" else with_actions
        scores = None if kind == "greedy" else recorded_scores(case, run)
        frame, first, states, _ = decoder.run(tokens, later, out_t, int(steps), scores)
        case.check(f"{run}_tokens", as_frame(frame))
        case.check(f"{run}_first_logits", classes_first(first, grid))
        case.check(f"{run}_states", as_frame(states))

    for key in [key for key in case.outputs if re.fullmatch(r"generate_m\d+_tokens", key)]:
        run = key.removesuffix("_tokens")
        steps = int(run.removeprefix("generate_m"))
        window, firsts, _ = with_actions.generate(tokens, prompt, steps, recorded_scores(case, run))
        case.check(key, window.reshape(len(window), -1))
        logits = np.stack([classes_first(first, grid) for first in firsts], axis=3)
        case.check(f"{run}_first_logits", logits)
        if steps == 1:  # nothing is drawn: the cached rollout must say the same
            whole = rolled_out(case, tokens, prompt, actions)
            case.check(key, whole.reshape(len(whole), -1), via="rollout")


def rolled_out(case: Case, tokens: np.ndarray, prompt: int, actions: np.ndarray) -> np.ndarray:
    """The window [B, T, S] as `rollout` continues its prompt, likeliest tokens at once."""
    keys = jax.random.split(jax.random.key(0), len(tokens))
    robots, decode = case.robot(case.domains[0], len(tokens)), DecodeConfig(unmask_steps=1)

    @jax.jit
    def run(params, start):
        return rollout(case.declared.merge(params), start, actions[:, None], robots, keys, decode)[:, 0]

    start = tokens[:, :prompt]
    return np.concatenate([start, run(case.params, start)], axis=1)
