"""HMA itself as a policy: its action head predicts the next chunk from the frames it sees, for any number of frames.

Past the model's window the oldest frame and its action are forgotten. Needs a run that was trained to predict actions;
the models of this repository were not (`experiments.applications.own_policy` trains one further for this).
"""

from __future__ import annotations

import jax
import numpy as np

from experiments.applications.policies.policy import Counts
from hma_jax.config import DecodeConfig, require
from hma_jax.evaluation.protocol import predicts_actions
from hma_jax.generation import predict_next_actions
from hma_jax.kernels.random import key_of
from hma_jax.simulator.folder import DEFAULT_DECODE
from hma_jax.simulator.interface import WholeNumbers
from hma_jax.simulator.robots import Robot
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.training.runs import Model


class OwnHeadPolicy:
    """Acts by the action head of a model: gives whole chunks, as the head predicts them, within the robot's range."""

    def __init__(self, model: Model, tokenizer: Tokenizer, robot: Robot, decode: DecodeConfig = DEFAULT_DECODE):
        """The sampler of `decode` draws the actions of a model on latents; one on ids draws nothing. Raises ConfigError
        for a model that predicts no actions."""
        setting = model.run.train.masking.setting
        require(
            predicts_actions(model.config, setting) and setting != "inverse",
            f"the model was trained with train.masking.setting {setting!r}, so it cannot act as a policy; train one "
            "with setting policy or full and model.action_heads=true",
        )
        self.tokenizer, self.robot, self.frames = tokenizer, robot, model.config.frames
        self.width = model.table.action_width
        self._embodiment, self._params, self._counts = model.table.index(robot.name), model.params, Counts()
        self._tokens: list[list[np.ndarray]] = []  # frames of each episode, at most T
        self._chunks: list[list[np.ndarray]] = []  # actions between them

        def predict(params, frames, actions_BTU, embodiment_B, seed_B):
            keys = jax.vmap(key_of)(seed_B)
            return predict_next_actions(model.declared.merge(params), frames, actions_BTU, embodiment_B, keys, decode)

        self._predict = jax.jit(predict)

    def reset(self, episodes: WholeNumbers | None = None, *, seeds: WholeNumbers | None = None) -> None:
        which = self._counts.reset(episodes, seeds)
        if episodes is None or not self._tokens:
            self._tokens, self._chunks = [], []
            return
        for b in which:
            self._tokens[b], self._chunks[b] = [], []

    def act(self, images: np.ndarray) -> np.ndarray:
        count = len(images)
        if len(self._tokens) != count:
            self._tokens, self._chunks = [[] for _ in images], [[] for _ in images]
        tokens = self.tokenizer.encode(images)
        # What follows the newest frame is padding: no frame sees those after it.
        frames = np.zeros((count, self.frames, *tokens.shape[1:]), tokens.dtype)
        actions_BTU = np.zeros((count, self.frames, self.width), np.float32)
        for b in range(count):
            seen, done = self._tokens[b], self._chunks[b]
            seen.append(tokens[b])
            del seen[: -self.frames], done[: len(done) + 1 - len(seen)]
            frames[b, : len(seen)] = seen
            if done:
                actions_BTU[b, : len(done)] = done
        drawn = [np.random.default_rng([*pair, 16]).integers(2**32) for pair in self._counts.next(count)]
        seeds = np.array(drawn, np.uint32)
        which = np.full(count, self._embodiment, np.int32)
        out = np.asarray(self._predict(self._params, frames, actions_BTU, which, seeds))
        newest = out[np.arange(count), [len(seen) - 1 for seen in self._tokens]]
        stride, dim = self.robot.stride, self.robot.action_dim
        predicted = newest[:, : stride * dim].reshape(count, stride, dim)
        chunks = self.robot.clip_to_range(predicted, "clip")[0].astype(np.float32)
        for done, chunk in zip(self._chunks, chunks, strict=True):
            done.append(np.pad(chunk.ravel(), (0, self.width - chunk.size)))
        return chunks
