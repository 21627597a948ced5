"""The evaluation protocol: which images and logits are compared, over which windows.

Paper section 4 (Metrics), reference section 6. For every window of a frozen manifest:

* likelihood: cross-entropy (continuous: diffusion loss) of each frame, wholly masked, given the
  true frames before it;
* fidelity: PSNR and SSIM of an autoregressive rollout from the prompt against the recorded
  frames (not their reconstruction by the tokenizer); windows longer than the model's are
  continued past it, and their likelihood is that of the first T frames;
* controllability: delta PSNR = PSNR of the last frame under the true actions minus its mean
  under random action sequences, unmasking with the same random numbers;
* policy, where the model was trained to predict actions: squared error of every chunk after the
  prompt, given the true frames and actions before it (inverse dynamics: all frames and no
  action), against that of the mean action.

A model trained on passive video is shown no action anywhere.

With `eval.context` "recorded" every frame is predicted from recorded ones and random actions
replace all of a window's, as the release does: for comparison with published figures.
DIFFERS: random and true actions share their random numbers (reference section 6.3). The
release's own autoregressive mode replaces one context frame only (reference section 6.2); ours is a rollout.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from hma_jax.config import EvalConfig, ExecutionConfig, ModelConfig, Setting, require
from hma_jax.evaluation.metrics import (
    Stat,
    corpus_perplexity,
    factored_cross_entropy,
    mean_and_sem,
    perplexity,
    psnr,
    ssim,
    stratified,
)
from hma_jax.generation import next_frame_outputs, next_frames, predict_actions, predict_next_actions, rollout
from hma_jax.model.embodiments import EmbodimentTable
from hma_jax.model.frames import compose
from hma_jax.model.hma import HMA, declare_model
from hma_jax.model.params import Params
from hma_jax.objective.losses import frame_diffusion_loss


class Decoder(Protocol):
    """The half of a tokenizer that evaluation needs."""

    def decode(self, tokens: np.ndarray) -> np.ndarray:
        """Ids [B, S] or latents [B, S, C] -> uint8 [B, height, width, 3]."""
        ...


@dataclass
class Evaluation:
    """Every metric per dataset, with standard errors over windows, and a few clips to look at."""

    datasets: dict[str, dict[str, Stat]] = field(default_factory=dict)
    samples: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)

    def over(self, names: Iterable[str]) -> dict[str, Stat]:
        """Each metric averaged over the named datasets, all counting equally."""
        chosen = [self.datasets[name] for name in names]
        require(len(chosen) > 0, "no datasets to average an evaluation over")
        return {metric: stratified(d[metric] for d in chosen) for metric in chosen[0]}

    @property
    def overall(self) -> dict[str, Stat]:
        return self.over(self.datasets)

    def to_dict(self) -> dict[str, Any]:
        return {n: {m: dataclasses.asdict(s) for m, s in d.items()} for n, d in self.datasets.items()}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Evaluation:
        return cls({n: {m: Stat(**s) for m, s in d.items()} for n, d in values.items()})


def random_actions(
    seed: int, window_B: jax.Array, embodiment_B: jax.Array, table: EmbodimentTable, shape: tuple[int, int]
) -> jax.Array:
    """[B, draws, T, U] with `shape` = (draws, T): N(mean, std) of each robot's own actions.

    A function of (seed, window number): every trial sees the same draws.
    """
    mean_EU, std_EU = (jnp.asarray(x) for x in table.statistics())

    def draw(window: jax.Array) -> jax.Array:
        key = jax.random.fold_in(jax.random.key(seed), window)
        return jax.random.normal(key, (*shape, table.action_width))

    noise = jax.vmap(draw)(window_B)
    return mean_EU[embodiment_B][:, None, None] + std_EU[embodiment_B][:, None, None] * noise


def evaluation_inputs(
    batch: dict[str, jax.Array], table: EmbodimentTable, config: EvalConfig
) -> tuple[jax.Array, jax.Array]:
    """(chunks [B, 1 + draws, T, U], keys [B]): the recorded actions, then the random ones, which
    differ from them from the first chunk that leads to a predicted frame."""
    actions, window = batch["actions"], batch["window"]
    shape, first_free = (config.random_actions, actions.shape[1]), config.first_predicted - 1
    other = random_actions(config.seed, window, batch["embodiment"], table, shape)
    other = other.at[:, :, :first_free].set(actions[:, None, :first_free])
    key = jax.random.key(config.seed + 1)
    keys = jax.vmap(lambda w: jax.random.fold_in(key, w))(window)
    return jnp.concatenate([actions[:, None], other], axis=1), keys


def predicts_actions(model: ModelConfig, setting: Setting) -> bool:
    """Whether a model so trained has a policy to evaluate."""
    return model.action_heads and setting in ("full", "policy", "inverse")


class Predicted(NamedTuple):
    """Tokens of the frames that are compared: [B, n, S (, C)] from `EvalConfig.first_predicted` on."""

    frames: jax.Array  # under the recorded actions
    last_random: jax.Array  # the last one under each random sequence [B, draws, S (, C)]
    random: jax.Array | None  # all of them under the first; None where only the last was made


@functools.lru_cache(maxsize=4)  # a second evaluation of the same shapes compiles nothing
def make_evaluator(
    model: ModelConfig,
    table: EmbodimentTable,
    config: EvalConfig,
    setting: Setting = "forward",
    execution: ExecutionConfig = ExecutionConfig(),
) -> Callable:
    """A jitted f(params, batch) -> (metrics {name: [B]}, Predicted)."""
    require(
        config.first_predicted < model.frames,
        f"eval.prompt_frames {config.prompt_frames} leaves nothing to predict in a window of "
        f"{model.frames} frames",
    )
    declared = declare_model(model, table, execution)

    def hidden(actions_BTU: jax.Array, embodiment_B: jax.Array) -> jax.Array | None:
        shape = actions_BTU.shape[:2]
        if setting == "passive":
            return jnp.ones(shape, bool)
        if all(table.chunks):
            return None
        return jnp.broadcast_to(jnp.asarray(table.chunks == 0)[embodiment_B][:, None], shape)

    def evaluate_batch(params: Params, batch: dict[str, jax.Array]) -> tuple[dict[str, jax.Array], Predicted]:
        hma = declared.merge(params)
        embodiment, not_shown = batch["embodiment"], hidden(batch["actions"], batch["embodiment"])
        sequences, keys = evaluation_inputs(batch, table, config)
        first = lambda x: None if x is None else x[:, : model.frames]  # noqa: E731
        window = first(batch["tokens"]), first(batch["actions"]), embodiment
        if config.context == "recorded":
            require(
                batch["tokens"].shape[1] == model.frames,
                f"with eval.context 'recorded' windows have the model's {model.frames} frames, "
                f"got {batch['tokens'].shape[1]}",
            )
            out, predicted = _after_recorded(hma, window, sequences, keys, config, not_shown)
        else:
            out = next_frame_outputs(hma, *window, first(not_shown))
            prompt = batch["tokens"][:, : config.prompt_frames]
            made = rollout(hma, prompt, sequences, embodiment, keys, config.decode, hidden_BT=not_shown)
            predicted = Predicted(made[:, 0], made[:, 1:, -1], made[:, 1])
        metrics = _likelihood(hma, out, window[0][:, 1:], keys)
        if predicts_actions(model, setting):
            metrics |= _policy_errors(hma, *window, keys, config, causally=setting != "inverse")
        return metrics, predicted

    return jax.jit(evaluate_batch)


def _after_recorded(
    model: HMA,
    window: tuple[jax.Array, jax.Array, jax.Array],
    sequences: jax.Array,
    key_B: jax.Array,
    config: EvalConfig,
    hidden_BT: jax.Array | None,
) -> tuple[jax.Array, Predicted]:
    """(outputs, Predicted) where every frame follows recorded ones."""
    tokens, actions, embodiment = window
    out, frames = next_frames(model, tokens, actions, embodiment, key_B, config.decode, hidden_BT)
    draws = sequences.shape[1] - 1
    each = lambda x: None if x is None else jnp.repeat(x, draws, axis=0)  # noqa: E731  [B, ...] -> [B draws, ...]
    # The sequences differ from the first chunk on, so that nothing of the past can be shared.
    last = rollout(
        model,
        each(tokens[:, :-1]),
        sequences[:, 1:].reshape(-1, 1, *actions.shape[1:]),
        each(embodiment),
        each(key_B),
        config.decode,
        hidden_BT=each(hidden_BT),
    )
    return out, Predicted(frames, last.reshape(len(tokens), draws, *tokens.shape[2:]), None)


def _likelihood(model: HMA, out: jax.Array, truth: jax.Array, key_B: jax.Array) -> dict[str, jax.Array]:
    """Per window [B]: what `out` says of the true frames."""
    if model.config.diffusion:
        return {"diffusion_loss": frame_diffusion_loss(model, out, truth, key_B).mean((1, 2))}
    guess = compose(jnp.argmax(out, -1), model.config.factor_vocab)
    return {
        "cross_entropy": factored_cross_entropy(out, truth).mean((1, 2)),
        "accuracy": (guess == truth).astype(jnp.float32).mean((1, 2)),
    }


def _policy_errors(
    model: HMA,
    frames: jax.Array,
    actions_BTU: jax.Array,
    embodiment_B: jax.Array,
    key_B: jax.Array,
    config: EvalConfig,
    causally: bool,
) -> dict[str, jax.Array]:
    """Per window [B]: mean squared error of the chunks after the prompt, in variances of each live
    action value, of the model and of always giving the mean."""
    decode, first = config.decode, config.prompt_frames - 1
    if causally:
        predicted = predict_next_actions(model, frames, actions_BTU, embodiment_B, key_B, decode)
    else:
        hidden = jnp.ones(frames.shape[:2], bool)
        predicted = predict_actions(
            model, frames, actions_BTU, embodiment_B, hidden, key_B, decode, causally=False
        )
    table = model.table
    alive_BU = jnp.asarray(table.alive())[embodiment_B]
    truth, guess = (table.normalise(x, embodiment_B)[:, first:] for x in (actions_BTU, predicted))
    mean = lambda error: jnp.sum(error.mean(1) * alive_BU, -1) / jnp.maximum(alive_BU.sum(-1), 1)  # noqa: E731
    error, of_mean = mean((guess - truth) ** 2), mean(truth**2)
    return {"action_error": error, "action_error_of_mean": of_mean, "action_gain": of_mean - error}


def evaluate(
    params: Params,
    model: ModelConfig,
    table: EmbodimentTable,
    tokenizer: Decoder,
    batches: Iterator[dict[str, Any]],
    config: EvalConfig,
    *,
    setting: Setting = "forward",
    execution: ExecutionConfig = ExecutionConfig(),
    samples_per_dataset: int = 1,
    progress: Callable[[int], None] | None = None,
) -> Evaluation:
    """Applies the protocol to `batches` (each of one dataset, its name under "dataset").

    A batch holds tokens, actions, embodiment, window (numbers), frames (uint8, recorded) and
    valid (bool [B]: rows that are not padding). `setting` is what the model was trained for.
    `progress` is told the windows done so far.
    """
    evaluator = make_evaluator(model, table, config, setting, execution)
    columns: dict[str, dict[str, list[np.ndarray]]] = {}
    result = Evaluation()
    done = 0
    for batch in batches:
        name, valid = batch["dataset"], batch["valid"]
        arrays = {k: batch[k] for k in ("tokens", "actions", "embodiment", "window")}
        values, tokens = jax.tree.map(lambda x: np.asarray(x)[valid], evaluator(params, arrays))
        truth = batch["frames"][valid]
        predicted, last_random = (_decode(tokenizer, x) for x in (tokens.frames, tokens.last_random))
        values |= _compare(truth, predicted, last_random, config)
        for metric, column in values.items():
            columns.setdefault(name, {}).setdefault(metric, []).append(column)
        if name not in result.samples and samples_per_dataset > 0:
            few = slice(samples_per_dataset)
            random = None if tokens.random is None else tokens.random[few]
            result.samples[name] = _clips(tokenizer, truth[few], predicted[few], random)
        done += int(valid.sum())
        if progress is not None:
            progress(done)
    require(len(columns) > 0, "the evaluation has no windows; freeze a manifest over other datasets")
    for name, metrics in columns.items():
        joined = {metric: np.concatenate(parts) for metric, parts in metrics.items()}
        stats = {metric: mean_and_sem(values) for metric, values in joined.items()}
        if not model.diffusion:
            stats["perplexity"] = perplexity(joined["cross_entropy"], config.perplexity_group)
            stats["perplexity_corpus"] = corpus_perplexity(joined["cross_entropy"])
        result.datasets[name] = stats
    return result


def _decode(tokenizer: Decoder, tokens: np.ndarray) -> np.ndarray:
    """tokens [B, n, S (, C)] -> uint8 [B, n, height, width, 3]."""
    images = tokenizer.decode(tokens.reshape(-1, *tokens.shape[2:]))
    return images.reshape(*tokens.shape[:2], *images.shape[1:])


def _compare(
    truth: np.ndarray, predicted: np.ndarray, last_random: np.ndarray, config: EvalConfig
) -> dict[str, np.ndarray]:
    """Image metrics per window; frames are uint8 [B, T, height, width, 3]."""
    first = config.first_predicted
    future, last = truth[:, first:], truth[:, -1]
    seen = truth[:, first - 1 : -1] if config.context == "recorded" else truth[:, first - 1 : first]
    psnr_last = psnr(predicted[:, -1], last)
    psnr_random = psnr(last_random, np.broadcast_to(last[:, None], last_random.shape)).mean(1)
    return {
        "psnr": psnr(predicted, future).mean(1),
        "psnr_last": psnr_last,
        "psnr_random": psnr_random,
        "delta_psnr": psnr_last - psnr_random,
        # What a model scores that repeats the last frame it is given.
        "psnr_copy": psnr(np.broadcast_to(seen, future.shape), future).mean(1),
        "ssim": ssim(predicted, future).mean(1),
    }


def _clips(
    tokenizer: Decoder, truth: np.ndarray, predicted: np.ndarray, random: np.ndarray | None
) -> dict[str, np.ndarray]:
    """Clips to look at: true, predicted and, where made, under the first random actions, all [n, T, ...]."""
    start = truth[:, : truth.shape[1] - predicted.shape[1]]
    clips = {"true": truth, "predicted": np.concatenate([start, predicted], axis=1)}
    if random is not None:
        clips["random"] = np.concatenate([start, _decode(tokenizer, random)], axis=1)
    return clips
