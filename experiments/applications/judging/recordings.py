"""A robot without a true simulator: recordings that say whether they succeeded teach the head, and episodes begin as
the recordings did.

A recording counts from where a policy would take over, the last frame of a start. If its rewards say frame by frame
whether the goal is reached, all its frames teach the head. Otherwise frames with unknown label, between the first half
of a success and its last `hold` frames, are left out.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any

import numpy as np

from data_pipelines.sampling.order import hash64, stream_seed
from experiments.applications.generating.source import confined
from experiments.applications.generating.trajectories import Trajectories, describe
from experiments.applications.judging.config import JudgeConfig
from experiments.applications.judging.ground_truth import Reconstruct
from experiments.applications.judging.head import Head, SuccessHead, balanced_error, fit_heads, worth_of
from experiments.applications.judging.outcomes import LEARNED, SHUFFLED
from experiments.applications.policies.demonstrations import Demonstrations
from experiments.applications.policies.learning import Report, log_spaced_steps
from experiments.applications.policies.network import downsample_uint8
from experiments.applications.policies.tasks import RecordedTask, held
from experiments.simulators import START_FRAMES
from experiments.terminal.progress import step
from hma_jax.config import ConfigError, require
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start

FEWEST = 8
"""Least number of recordings of each kind: two of them are held out."""

HELD_OUT = 4
"""One of this many recordings of a kind is held out: nothing is learnt from it, the head is measured on it, and
episodes begin as it did."""

TUNED_ON = 5
"""Every TUNED_ON-th training recording of a kind is used to choose the training step at which the head is best: a head
soon overfits few recordings."""

LIGHT, SHIFT = 0.15, 1 / 8
"""For the same reason the light of frames is varied more than `HeadConfig` says, and frames are shifted by up to this
share of a side. With 230 recordings of a pusher, half of them successes, 54 of 76 held-out ones were then classified
correctly instead of 39."""

FIRST, CHECKPOINTS = 50, 12
"""Training steps at which a head may be best: the first of them, and their number."""

MOST = 0.9
"""If the length of an episode is not given, this share of the recorded successes is no longer than an episode."""

LAST = "last frames taken for reached"
"""If no reward says at which frames the goal was reached, this many last frames of each recorded success count as
reached."""

BEFORE = START_FRAMES - 1
"""Frames of a recording before the first that is looked at."""


class RecordedTruth:
    """The `GroundTruth` of recordings. `config` is the given one, with the task's length and goal and the number of
    starts that the recordings allow."""

    worlds = (LEARNED, SHUFFLED)

    def __init__(self, config: JudgeConfig, recorded: Trajectories, robot: Robot):
        """Raises ConfigError for too few recordings of either kind."""
        task = config.task
        if not isinstance(task, RecordedTask):
            raise TypeError(f"recordings have a RecordedTask, not {task}")
        self._recorded, self.robot = recorded, robot
        with step("which recordings succeeded") as report:
            outlines = [recorded.outline(i) for i in _one_by_one(range(len(recorded)), report)]
        length = np.array([outline.frames - BEFORE for outline in outlines])
        self._reached = self._read_rewards(task.reward, [outline.frames for outline in outlines])
        if self._reached is None:
            known = np.array([outline.success is not None for outline in outlines], bool)
            self._success = np.array([bool(outline.success) for outline in outlines], bool)
        else:
            known = np.ones(len(outlines), bool)
            self._success = np.array([held(x[None, 1:], task.hold).any() for x in self._reached], bool)
        # A recording that is held out of a model's training comes first here, too: by the same hash (not in the store
        # of a dataset that joins others).
        order = np.argsort(hash64(recorded.ids(), stream_seed("held-out", recorded.drawn_as)), kind="stable")
        enough = length > task.hold
        usable = [int(i) for i in order if known[i] and enough[i]][: config.head_episodes]
        kinds = [[i for i in usable if self._success[i] == kind] for kind in (True, False)]
        self._left_out = {"unknown": float((~known).sum()), "too short": float((known & ~enough).sum())}
        require(
            min(map(len, kinds)) >= FEWEST,
            f"{recorded.name}, split {recorded.split}: of {len(outlines)} recordings {len(kinds[0])} succeeded and "
            f"{len(kinds[1])} failed ({self._left_out['unknown']:.0f} do not say whether they did, "
            f"{self._left_out['too short']:.0f} have fewer than the {BEFORE + task.hold + 1} frames at the model's "
            f"rate that --hold {task.hold} needs). A success head needs at least {FEWEST} of each kind",
        )
        self.held_out = sorted((i for kind in kinds for i in kind[: len(kind) // HELD_OUT]), key=usable.index)
        self.learnt = [i for i in usable if i not in set(self.held_out)]
        frames = task.frames or int(np.ceil(np.quantile(length[kinds[0]], MOST))) - 1  # one frame is the start's
        instruction = recorded[self.held_out[0]].instructions[0]
        # As in true worlds, episodes start before their goal is reached, if that is known.
        self._begun_from = [i for i in self.held_out if self._reached is None or not self._reached[i][0]]
        require(
            len(self._begun_from) >= 2,
            f"{recorded.name}: {len(self._begun_from)} of {len(self.held_out)} held-out recordings have not yet "
            f"reached the goal (--reward {task.reward}) at frame {BEFORE} of the model's rate, where policies start; "
            "at least 2 are needed",
        )
        starts = min(config.starts, len(self._begun_from))
        batch = min(config.batch, starts)
        goal = instruction or "what its recordings call success"
        self.config = replace(
            config,
            task=replace(task, frames=frames, goal=goal),
            head=replace(config.head, light=LIGHT),
            starts=starts - starts % batch,
            batch=batch,
        )

    def _read_rewards(self, least: float | None, frames: Sequence[int]) -> list[np.ndarray] | None:
        """For every recording, bool [n]: in which of the n frames used its rewards say that the goal is reached. None
        without a `least` reward."""
        if least is None:
            return None
        reached = []
        with step("at which frames their goal is reached") as report:
            for i in _one_by_one(range(len(frames)), report):
                rewards = self._recorded.rewards(i)
                require(
                    rewards is not None and len(rewards) == frames[i] and bool(np.isfinite(rewards[1:]).all()),
                    f"{self._recorded.origin(i)}: it has no reward for every step, which --reward needs. Leave out "
                    "--reward, so that success is taken from the end of each recording; if DATASET is a token store, "
                    "which has no rewards, give the dataset that it was made from",
                )
                reached.append(rewards[BEFORE:] >= least)
        return reached

    def about(self) -> dict[str, Any]:
        return {"recordings": describe(self._recorded)}

    def demonstrations(self) -> Demonstrations:
        raise ConfigError(
            "with --recordings there is no scripted expert to train policies on: use --cloned 0 --diffusion 0"
        )

    def make_head(self, reconstruct: Reconstruct) -> SuccessHead:
        config, fit = self.config.head, self.config.head.fit
        tuned_on = {
            i for kind in (True, False) for i in [j for j in self.learnt if self._success[j] == kind][::TUNED_ON]
        }
        with step(f"read {len(self.learnt)} recordings for the success head") as report:
            read = {i: self._pairs(i, reconstruct) for i in _one_by_one(self.learnt, report)}
        learnt, tuning = (
            [np.concatenate(x) for x in zip(*(read[i] for i in self.learnt if (i in tuned_on) == tunes), strict=True)]
            for tunes in (False, True)
        )
        keep = log_spaced_steps(fit.steps, CHECKPOINTS, FIRST) if fit.steps > FIRST else ()
        kept = replace(config, fit=replace(fit, keep=keep))
        with step("train the success head") as report:
            heads = fit_heads(*learnt, kept, self.config.seed, report, round(SHIFT * config.encoder.size))
        errors = {step: balanced_error(head, *tuning) for step, head in heads.items()}
        best = min(errors, key=errors.__getitem__)
        heads[best].measured |= {
            "steps": float(best),
            "learnt from": float(len(self.learnt)),
            "successes among them": float(self._success[self.learnt].sum()),
            **({LAST: float(self.config.task.hold)} if self._reached is None else {}),
        }
        return heads[best]

    def _pairs(self, i: int, reconstruct: Reconstruct) -> tuple[np.ndarray, np.ndarray]:
        """Training pairs and labels of one recording for `fit_heads`. A random half of the frames is shown as the
        tokenizer reconstructs them: if they alternated, all frames of one kind could fall into one half."""
        images, rng = self._images(i), np.random.default_rng([self.config.seed, i, 17])
        chosen, label = self._labelled(i, len(images))
        seen = np.stack([np.broadcast_to(images[0], images[chosen].shape), images[chosen]], 1)
        decoded = rng.permutation(len(chosen))[: len(chosen) // 2]
        flat = seen[decoded].reshape(-1, *images.shape[1:])
        seen[decoded] = reconstruct(flat).reshape(seen[decoded].shape)
        return downsample_uint8(seen, self.config.head.encoder.size), label

    def measure(self, head: Head, reconstruct: Reconstruct) -> dict[str, float]:
        """Measures on all frames of the held-out recordings, also as the model's tokenizer shows them, which is how the
        head sees the model's frames."""
        hold, successes = self.config.task.hold, self._success[self.held_out]
        scores, labels, decisions, decoded_decisions = [], [], [], []
        for i in self.held_out:
            images = self._images(i)
            chosen, label = self._labelled(i, len(images))
            for shown, into in ((images, decisions), (reconstruct(images), decoded_decisions)):
                probability = head.probabilities(shown, shown[:1])
                into.append(held(probability[None, 1:] > head.threshold, hold).any())
                if shown is images:
                    scores.append(probability[chosen])
                    labels.append(label)
        by_head = np.array(decisions)
        return worth_of(head, np.concatenate(scores), np.concatenate(labels), by_head, successes) | {
            "successes": float(successes.sum()),
            "successes told": float(by_head[successes].sum()),
            "failures told": float((~by_head[~successes]).sum()),
            "episode accuracy, decoded": float((np.array(decoded_decisions) == successes).mean()),
            **self._left_out,
        }

    def _labelled(self, i: int, length: int) -> tuple[np.ndarray, np.ndarray]:
        if self._reached is not None:
            return np.arange(length), self._reached[i]
        return labelled(length, bool(self._success[i]), self.config.task.hold)

    def _images(self, i: int) -> np.ndarray:
        return self._recorded[i].images[BEFORE:]

    def starts(self) -> list[Start]:
        starts = []
        for i in self._begun_from[: self.config.starts]:
            trajectory = confined(self._recorded[i], self.robot)
            given = trajectory.chunks[:BEFORE].reshape(-1, self.robot.action_dim)
            starts.append(Start(self.robot.name, trajectory.images[:START_FRAMES], given))
        return starts

    def open(self) -> AbstractContextManager[None]:
        return nullcontext()


def labelled(length: int, success: bool, hold: int) -> tuple[np.ndarray, np.ndarray]:
    """The frames of a recording without rewards whose label is known, int [n], and these labels, bool [n]. The goal is
    reached in no frame of a failure; in a success it is reached in each of the last `hold` frames, and in no earlier
    frame of its first half.
    """
    if not success:
        return np.arange(length), np.zeros(length, bool)
    half = min(length // 2, length - hold)
    return np.r_[:half, length - hold : length], np.arange(half + hold) >= half


def _one_by_one(numbers: Sequence[int], report: Report) -> Iterator[int]:
    """Yields the numbers of recordings, and reports how many have been read."""
    for done, i in enumerate(numbers):
        report(done, len(numbers), "recordings")
        yield i
