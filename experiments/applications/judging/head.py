"""The success head: the probability that the goal is reached, from the present frame and the episode's first frame.

A model may lose the mark once something covers it; the first frame shows where it is. It is trained on recorded frames
with labels from the simulator's state; some of them are shown as the model's tokenizer would show them."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple
from weakref import WeakKeyDictionary

import jax
import jax.numpy as jnp
import numpy as np
import optax
from safetensors.numpy import save
from scipy.stats import rankdata

from experiments.applications.policies.demonstrations import Demonstrations
from experiments.applications.policies.files import named, read_network, unnamed
from experiments.applications.policies.learning import FitConfig, Report, fit
from experiments.applications.policies.network import (
    EncoderConfig,
    Params,
    as_floats,
    downsample_uint8,
    encode,
    init_encoder,
    init_mlp,
    jitter_colour,
    mlp,
    random_shift,
    require_images,
    stack_frames,
)
from experiments.applications.policies.tasks import Task, held
from hma_jax.config import require
from hma_jax.config.json import from_dict, to_dict
from hma_jax.kernels.random import key_of
from hma_jax.runtime.files import write_file
from hma_jax.simulator.interface import AnySimulator, whole_numbers

DESCRIPTION, WEIGHTS = "head.json", "head.safetensors"
PIECE = 256
"""Frames that are looked at in one call."""

RECONSTRUCTED = 4


@dataclass(frozen=True)
class HeadConfig:
    """A head and its training. An episode has succeeded when the probability is above `threshold` at `hold` frames in a
    row, the same number that the task requires of the state."""

    encoder: EncoderConfig = field(default_factory=EncoderConfig)
    fit: FitConfig = field(default_factory=lambda: FitConfig(steps=3000, learning_rate=2e-3))
    light: float = 0.03
    threshold: float = 0.5

    def __post_init__(self):
        require(0 < self.threshold < 1, f"a threshold must lie between 0 and 1, got {self.threshold}")


def init_head(config: HeadConfig, seed: int) -> Params:
    first, second = jax.random.split(key_of(seed))
    hidden = config.encoder.hidden
    return {
        "encoder": init_encoder(first, config.encoder, 2 * 3),
        "mlp": init_mlp(second, (config.encoder.features, hidden, hidden, 1)),
    }


def apply_head(params: Params, config: HeadConfig, frames: jax.Array) -> jax.Array:
    """Logits [B] of frames [B, 2, H, W, 3] in [-1, 1]: the first one of the episode, and the present one."""
    return mlp(params["mlp"], encode(params["encoder"], config.encoder, stack_frames(frames)))[:, 0]


class Head(ABC):
    """A success detector on frames. `measured` is its accuracy on recorded episodes that it was not trained on."""

    measured: dict[str, float]
    threshold: float

    @abstractmethod
    def probabilities(self, images: np.ndarray, first: np.ndarray) -> np.ndarray:
        """float32 [...] of images uint8 [..., H, W, 3]: that the goal is reached in each. `first`: the frames in which
        the episodes begin; an axis may have size 1 where `images` has frames of one episode."""

    def reached(self, images: np.ndarray, first: np.ndarray) -> np.ndarray:
        """bool [...]: whether the goal is taken to be reached."""
        return self.probabilities(images, first) > self.threshold


class SuccessHead(Head):
    """A trained network."""

    def __init__(self, config: HeadConfig, params: Params, measured: Mapping[str, float] | None = None):
        self.config, self.params, self.measured = config, params, dict(measured or {})
        self.threshold = config.threshold
        self._apply = jax.jit(lambda params, frames: jax.nn.sigmoid(apply_head(params, config, as_floats(frames))))

    def probabilities(self, images: np.ndarray, first: np.ndarray) -> np.ndarray:
        """See `Head`. Raises ConfigError for images of another kind."""
        require_images(images)
        require_images(first)
        size = self.config.encoder.size
        whole = (*images.shape[:-3], size, size, 3)
        small = [np.broadcast_to(downsample_uint8(x, size), whole) for x in (first, images)]
        return self.predict_pairs(np.stack(small, -4).reshape(-1, 2, size, size, 3)).reshape(images.shape[:-3])

    def predict_pairs(self, pairs: np.ndarray) -> np.ndarray:
        """float32 [n] of pairs uint8 [n, 2, size, size, 3], as heads are trained on."""
        parts, size = [], min(PIECE, 1 << (len(pairs) - 1).bit_length())  # few episodes are judged at every frame
        for at in range(0, len(pairs), PIECE):
            part = pairs[at : at + PIECE]
            padded = np.zeros((size, *part.shape[1:]), np.uint8)
            padded[: len(part)] = part
            parts.append(np.asarray(self._apply(self.params, padded))[: len(part)])
        return np.concatenate(parts)


def train_head(
    demos: Demonstrations,
    config: HeadConfig,
    seed: int,
    reconstruct: Callable[[np.ndarray], np.ndarray],
    report: Report,
) -> SuccessHead:
    """Trains a head; a pure function of its arguments. Positive and negative frames are drawn equally often.

    `reconstruct` returns frames uint8 [n, H, W, 3] as the model's tokenizer shows them: every `RECONSTRUCTED`-th frame
    is learnt in this form. Raises ConfigError if all frames have the same label.
    """
    episode, frame = demos.steps()
    images, first, labels = demos.images[episode, frame], demos.images[episode, 0], demos.reached[episode, frame]
    for frames in (images, first):
        frames[::RECONSTRUCTED] = reconstruct(frames[::RECONSTRUCTED])
    pairs = np.stack([downsample_uint8(x, config.encoder.size) for x in (first, images)], 1)
    return fit_heads(pairs, labels, config, seed, report)[config.fit.steps]


def fit_heads(
    pairs: np.ndarray,
    labels: np.ndarray,
    config: HeadConfig,
    seed: int,
    report: Report,
    shift: int = 0,
) -> dict[int, SuccessHead]:
    """{step: head} for every step of training that `config.fit` keeps, including the last.

    From n pairs of frames uint8 [n, 2, size, size, 3], the episode's first and the present one, and whether the goal is
    reached in the latter, bool [n]. Each time a pair is seen, both frames are shifted together by up to `shift` pixels:
    from few recordings the head would otherwise memorise where things were. Raises ConfigError if all have the same
    label."""
    require(bool(labels.any()) and not labels.all(), "a success head needs training frames with success and without")
    weight = np.where(labels, 0.5 / labels.mean(), 0.5 / (1 - labels.mean())).astype(np.float32)
    data = {"images": pairs, "label": labels.astype(np.float32), "weight": weight}

    def loss(params: Params, data, index: jax.Array, key: jax.Array) -> jax.Array:
        frames = jitter_colour(random_shift(as_floats(data["images"][index]), key, shift), key, config.light)
        errors = optax.sigmoid_binary_cross_entropy(apply_head(params, config, frames), data["label"][index])
        return jnp.mean(errors * data["weight"][index])

    kept = fit(init_head(config, seed), loss, data, len(pairs), config.fit, seed, report)
    return {step: SuccessHead(config, params) for step, params in kept.items()}


def measure_head(head: Head, demos: Demonstrations, task: Task) -> dict[str, float]:
    """Measures on recorded true frames: accuracy and AUROC of frames, and accuracy of whole episodes."""
    steps = demos.steps()
    score = head.probabilities(demos.images, demos.images[:, :1])
    by_head = held(score > head.threshold, task.hold).any(1)
    return worth_of(head, score[steps], demos.reached[steps], by_head, demos.successes)


def worth_of(
    head: Head, frames: np.ndarray, labels: np.ndarray, by_head: np.ndarray, successes: np.ndarray
) -> dict[str, float]:
    """Accuracies, from probabilities and labels [n] of frames, and from successes of episodes [N] by the head and true
    ones."""
    return {
        "frames": float(len(labels)),
        "positive": float(labels.mean()),
        "frame accuracy": float(((frames > head.threshold) == labels).mean()),
        "frame AUROC": auroc(frames, labels),
        "episodes": float(len(successes)),
        "episode accuracy": float((by_head == successes).mean()),
    }


def balanced_error(head: SuccessHead, pairs: np.ndarray, labels: np.ndarray) -> float:
    """Cross-entropy in nats of pairs [n, 2, size, size, 3], those with and those without success counted alike."""
    likelihood = np.clip(np.where(labels, p := head.predict_pairs(pairs), 1 - p), 1e-6, 1).astype(np.float64)
    return float(-(np.log(likelihood[labels]).mean() + np.log(likelihood[~labels]).mean()) / 2)


def auroc(score: np.ndarray, label: np.ndarray) -> float:
    """The probability that a positive scores higher than a negative, with ties counted half; nan if one kind is
    missing."""
    positive = label.astype(bool)
    n, m = int(positive.sum()), int((~positive).sum())
    if not n or not m:
        return float("nan")
    return float((rankdata(score)[positive].sum() - n * (n + 1) / 2) / (n * m))


def save_head(head: SuccessHead, directory: Path | str) -> None:
    """The description is written last: a directory holds a complete head or none."""
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    (directory / DESCRIPTION).unlink(missing_ok=True)
    write_file(directory / WEIGHTS, save(named(head.params)))
    write_file(
        directory / DESCRIPTION,
        json.dumps({"config": to_dict(head.config), "measured": head.measured}, indent=1) + "\n",
    )


def load_head(directory: Path | str) -> SuccessHead:
    """Loads a head. Raises ConfigError if there is none, or it is damaged."""
    directory = Path(directory)
    description, weights = read_network(directory / DESCRIPTION, directory / WEIGHTS, ("config", "measured"))
    config = from_dict(HeadConfig, description["config"], f"{directory}: config")
    like = jax.eval_shape(lambda: init_head(config, 0))
    return SuccessHead(config, unnamed(weights, like, directory), description["measured"])


class _EpisodeState(NamedTuple):
    """The B episodes of one simulator."""

    first: np.ndarray  # frames in which they began, uint8 [B, H, W, 3]
    count: np.ndarray  # int [B]: frames in a row with success


class HeadJudge:
    """A `Judge` for the simulators' Gymnasium environments: returns 1 and ends the episode once the head has seen
    success at `hold` frames in a row. The environment says when episodes begin. Environments may share a judge: it
    keeps separate state for each simulator."""

    def __init__(self, head: Head, hold: int = 1):
        """Raises ConfigError for a number of frames that is none."""
        [hold] = whole_numbers("hold", [hold])
        require(hold >= 1, f"hold, the number of frames in a row, must be at least 1, got {hold}")
        self.head, self.hold = head, hold
        self._states: WeakKeyDictionary[AnySimulator, _EpisodeState] = WeakKeyDictionary()

    def begin(self, simulator: AnySimulator, episodes: Sequence[int]) -> None:
        """These episodes begin with the simulator's present frames."""
        images, which = simulator.images, list(episodes)
        if simulator not in self._states:
            self._states[simulator] = _EpisodeState(images.copy(), np.zeros(len(images), int))
        state = self._states[simulator]
        state.first[which], state.count[which] = images[which], 0

    def __call__(self, simulator: AnySimulator) -> tuple[np.ndarray, np.ndarray]:
        """Raises ConfigError before the first `begin` of this simulator."""
        require(simulator in self._states, "no episode has begun: call `begin` after the simulator's reset")
        state = self._states[simulator]
        reached = self.head.reached(simulator.images, state.first)
        state.count[:] = np.where(reached, state.count + 1, 0)
        done = state.count >= self.hold
        return done.astype(float), done
