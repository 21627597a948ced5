"""A trained model as a simulator: episodes are reset, stepped with raw actions, saved, branched and rewound.

This module owns the host's record of each episode; the state on the device and the programs that compute with it are in
`programs`.
"""

from __future__ import annotations

import copy
import logging
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import jax
import numpy as np

from hma_jax.config import ConfigError, DecodeConfig, ExecutionConfig, Weights, check_decoding, require
from hma_jax.config.base import require_choice
from hma_jax.generation.episodes import Episodes
from hma_jax.simulator.episode import Episode, Snapshot, begin_episode
from hma_jax.simulator.folder import DEFAULT_DECODE, find_decode, find_robots, find_starts, find_tokenizer
from hma_jax.simulator.interface import (
    HISTORY,
    Actions,
    WholeNumbers,
    chosen_episodes,
    each_action,
    each_beginning,
    read_only,
    whole_numbers,
)
from hma_jax.simulator.programs import Programs, ResetInputs, padded
from hma_jax.simulator.robots import Outside, Robot, require_robot
from hma_jax.simulator.starts import Start
from hma_jax.tokenizers.base import Tokenizer, token_mismatch
from hma_jax.training.runs import Model, load_model, require_frames

Rate = Literal["model", "native"]
"""Whether a step is a frame of the model, or one native action; then every stride-th step gives a frame."""

log = logging.getLogger(__name__)


class Simulator:
    """B episodes at once, each with its own robot, beginning and end.

    An episode must begin (`reset`) before it advances (`step`). Frames, including the first ones, are uint8 [B, H, W,
    3], as the tokenizer decodes them. What an episode shows depends only on its start, its actions and its seed: frame
    t is drawn from fold_in(key(seed), t). Past the model's window of T frames it continues as `decode.slide` says. A
    model trained on passive video ignores actions. ConfigError is raised for whatever cannot be done; nothing has then
    changed. After a fault of the device, or if a tokenizer or a model gives values that are not tokens (NaN, say),
    every episode may have to begin again (`counts` is then 0).
    """

    made_in: ClassVar[int | None] = None
    """The id of the process in which the first simulator was made."""

    def __init__(
        self,
        model: Model,
        tokenizer: Tokenizer,
        *,
        robots: Sequence[Robot] = (),
        starts: Sequence[Start] = (),
        episodes: int = 1,
        decode: DecodeConfig | None = None,
        outside: Outside = "clip",
        rate: Rate = "model",
        history: int = HISTORY,
    ):
        """`robots` replace the descriptions derived from the model's table. `outside` says whether actions outside
        their range are clipped (reported in `clipped`, and logged once per robot) or refused."""
        config = model.config
        require_frames(model.run, "show")
        episodes, history = _checked(episodes, history, decode, outside, rate)
        require(
            config.frames >= 3,
            f"a simulator needs a model with model.frames of at least 3, this one has {config.frames}",
        )
        differs = token_mismatch(config, tokenizer)
        require(not differs, differs)
        check_decoding(config, decode or DEFAULT_DECODE)
        Simulator.made_in = Simulator.made_in or os.getpid()
        self.model, self.tokenizer, self.decode = model, tokenizer, decode or DEFAULT_DECODE
        self.robots: Mapping[str, Robot] = {e.name: Robot.of(e) for e in model.table.entries if e.action_dim}
        self.update_robots(robots)
        self.starts, self.outside, self.rate = tuple(starts), outside, rate
        self.capacity, self.history = config.frames - 1, history
        self._programs = Programs(model, tokenizer, episodes, self.decode)
        self._state = self._programs.empty()
        self._images = np.zeros((episodes, *tokenizer.image_shape, 3), np.uint8)
        self._episodes: list[Episode | None] = [None] * episodes
        self._warned: set[str] = set()
        self.clipped: list[tuple[str, ...]] = [()] * episodes

    @classmethod
    def load(
        cls,
        run: str | Path,
        tokenizer: str | Path | None = None,
        *,
        execution: ExecutionConfig = ExecutionConfig(),
        weights: Weights = "auto",
        robots: Sequence[Robot] | None = None,
        starts: Sequence[Start] | None = None,
        episodes: int = 1,
        decode: DecodeConfig | None = None,
        outside: Outside = "clip",
        rate: Rate = "model",
        history: int = HISTORY,
    ) -> Simulator:
        """Loads the simulator of a training run, with the files beside it (`folder`).

        `robots`, `starts` and `decode` override these files; robots that are not given are as the files describe them.
        The constructor says what all options from `robots` on mean.

        Raises ConfigError if there is no run, if it predicts no frames, or if the tokenizer is not the one with which
        it was trained.
        """
        run = Path(run)
        episodes, history = _checked(episodes, history, decode, outside, rate)  # loading takes long
        model = load_model(run, execution, weights)
        return cls(
            model,
            find_tokenizer(run, model.run, Path(tokenizer) if tokenizer else None),
            robots=(*find_robots(run, model.table), *(robots or ())),  # of equal names the last counts
            starts=find_starts(run) if starts is None else starts,
            episodes=episodes,
            decode=find_decode(run) if decode is None else decode,
            outside=outside,
            rate=rate,
            history=history,
        )

    def __deepcopy__(self, memo: dict[int, Any]) -> Simulator:
        """Returns this simulator itself: Gymnasium copies the arguments of an environment, model included, whenever it
        is asked for its `spec`. `snapshot` and `branch` copy episodes."""
        return self

    # --- What there is -----------------------------------------------------------------------------

    def __len__(self) -> int:
        """B."""
        return len(self._episodes)

    @property
    def images(self) -> np.ndarray:
        """The present frames, uint8 [B, H, W, 3]; black for episodes that have not begun. Read-only."""
        return read_only(self._images)

    @property
    def counts(self) -> tuple[int, ...]:
        """The number of frames of each episode so far, without those of its start that the model did not see; 0: it has
        not begun."""
        return tuple(0 if e is None else e.count for e in self._episodes)

    @property
    def ignores_actions(self) -> bool:
        """Whether the model was trained without actions, so that actions have no effect."""
        return self.model.run.train.masking.ignores_actions

    def update_robots(self, robots: Sequence[Robot]) -> None:
        """Replaces descriptions of robots, for episodes that begin from now on. Raises ConfigError if one does not fit
        the model."""
        for robot in robots:
            known = self.robot(robot.name)
            require(
                (robot.action_dim, robot.stride) == (known.action_dim, known.stride),
                f"{robot.name} is described with {robot.action_dim} action values and {robot.stride} actions per "
                f"frame, but the model was trained with {known.action_dim} and {known.stride}",
            )
        self.robots = {**self.robots, **{robot.name: robot for robot in robots}}

    def robot(self, name: str) -> Robot:
        """The robot called `name`. Raises ConfigError if the model does not know it or it has no actions."""
        require_robot(name, tuple(self.robots))
        return self.robots[name]

    # --- Beginning ---------------------------------------------------------------------------------

    def reset(
        self,
        starts: Start | Sequence[Start],
        *,
        seeds: int | WholeNumbers = 0,
        episodes: WholeNumbers | None = None,
    ) -> np.ndarray:
        """Begins `episodes` (default: all) at `starts`, one for each or one for all. Returns the frames of all
        episodes.

        The model sees the last T - 1 frames of a start. If `seeds` is an int, the b-th of these episodes gets `seeds` +
        b.
        """
        which = chosen_episodes(episodes, len(self))
        each, numbers = each_beginning(starts, seeds, len(which))
        new = {b: self._new_episode(start, seed) for b, start, seed in zip(which, each, numbers, strict=True)}
        if not which:
            return self.images
        at = self._reset_inputs(which, (*self.tokenizer.image_shape, 3), np.uint8)
        start_of = dict(zip(which, each, strict=True))
        for i, b in enumerate(at.rows.tolist()):
            at.set_episode(i, new[b], start_of[b].images[-self.capacity :])
        with self._donating_state():
            state, *made = self._programs.reset_from_images(self._programs.weights, self._state, at)
            tokens, seen = map(np.asarray, made)
            self.tokenizer.require_tokens(tokens, "encoding the start", "; correct the tokenizer")
            self._state = state
        for i, (b, episode) in enumerate(new.items()):
            episode.frames.extend(tokens[i, : at.given[i]])
            self._episodes[b] = episode
        return self._update_images(which, seen[: len(which)])

    def _new_episode(self, start: Start, seed: int) -> Episode:
        robot, table = self.robot(start.robot), self.model.table
        size, given = (*self.tokenizer.image_shape, 3), start.images.shape[1:]
        require(given == size, f"a start of {robot.name}: frames must be {size}, got {given}")
        return begin_episode(
            robot, table.index(robot.name), start, seed, self.capacity, self.history, table.action_width
        )

    def _reset_inputs(self, which: list[int], shape: tuple[int, ...], dtype: Any) -> ResetInputs:
        return ResetInputs.empty(padded(which, len(self)), self.capacity, self.model.table.action_width, shape, dtype)

    def _running_episode(self, b: int) -> Episode:
        [b] = chosen_episodes([b], len(self))
        episode = self._episodes[b]
        if episode is None:
            raise ConfigError(f"episode {b} has not begun; reset it first")
        return episode

    def _update_images(self, which: Sequence[int], seen: np.ndarray) -> np.ndarray:
        images = self._images.copy()  # callers may keep the frames that they were given
        images[list(which)] = seen
        self._images = images
        return self.images

    # --- Advancing ---------------------------------------------------------------------------------

    def step(self, actions: Actions) -> np.ndarray:
        """The frames after `actions`, one entry per episode: an action [A], held for a frame, a chunk [stride, A], or
        None for an episode that waits. At the native rate every entry is one action [A].

        `clipped` then names, for each episode, the dimensions whose values were outside the range.
        """
        each = each_action(actions, len(self))
        asked: dict[int, np.ndarray] = {}
        clipped: list[tuple[str, ...]] = [()] * len(self)
        for b, action in enumerate(each):
            if action is None:
                continue
            robot = self._running_episode(b).robot
            values = robot.numbers(action)
            native = self.rate == "native"
            require(
                not native or values.ndim == 1, f"at the native rate an action must have shape [A], got {values.shape}"
            )
            asked[b], beyond = robot.clip_to_range(robot.chunk(values), self.outside)
            if beyond.any():
                clipped[b] = tuple(np.array(robot.dimensions)[beyond].tolist())
                self._warn_once(robot, beyond, values)
        self.clipped = clipped
        chunks = {b: chunk for b, asked_b in asked.items() if (chunk := self._complete_chunk(b, asked_b)) is not None}
        return self._advance(chunks) if chunks else self.images

    def _complete_chunk(self, b: int, chunk: np.ndarray) -> np.ndarray | None:
        """The chunk [stride, A] to execute, or None while some of its native actions are missing."""
        episode = self._running_episode(b)
        if self.rate == "model":
            return chunk
        episode.pending.append(chunk[0])
        if len(episode.pending) < episode.robot.stride:
            return None
        whole, episode.pending = np.stack(episode.pending), []
        return whole

    def _warn_once(self, robot: Robot, beyond: np.ndarray, actions: np.ndarray) -> None:
        if robot.name not in self._warned:
            self._warned.add(robot.name)
            log.warning(
                "%s: %s; such actions are clipped (this is said once)", robot.name, robot.describe(beyond, actions)
            )

    def _advance_inputs(self, which: list[int]) -> tuple[list[int], np.ndarray | None, np.ndarray]:
        """(rows, rows_n, chunk_nU) for the program that advances the episodes `which`: their numbers, padded; the same
        as an argument of the program, None for all episodes; their chunks, still zeros."""
        rows = padded(which, len(self))
        rows_n = None if len(which) == len(self) else np.array(rows, np.int32)
        return rows, rows_n, np.zeros((len(rows), self.model.table.action_width), np.float32)

    def _advance(self, chunks: Mapping[int, np.ndarray]) -> np.ndarray:
        rows, rows_n, chunk_nU = self._advance_inputs(list(chunks))
        for i, b in enumerate(rows):
            chunk_nU[i, : chunks[b].size] = chunks[b].ravel()
        seeds = np.array([self._running_episode(b).seed for b in rows], np.uint32)
        with self._donating_state():
            state, tokens, seen = self._programs.advance(self._programs.weights, self._state, rows_n, chunk_nU, seeds)
            tokens, seen = np.asarray(tokens), np.asarray(seen)
            advice = "; did it diverge? `hma branch` makes a run of an earlier checkpoint"
            self.tokenizer.require_tokens(tokens, "the model", advice)
            self._state = state
        for b, frame, chunk in zip(chunks, tokens, chunk_nU, strict=False):
            episode = self._running_episode(b)
            episode.frames.append(frame)
            episode.chunks.append(chunk)
            episode.count += 1
        return self._update_images(list(chunks), seen[: len(chunks)])

    @contextmanager
    def _donating_state(self) -> Iterator[None]:
        """Used around a program to which the state is donated, until its results have arrived. If the program fails
        after the donation, the state is lost: all episodes are then as before their first reset."""
        try:
            yield
        except BaseException:  # an interrupt by the user too
            if any(x.is_deleted() for x in jax.tree.leaves(self._state)):
                self._episodes, self._images = [None] * len(self), np.zeros_like(self._images)
                self._state = self._programs.empty()
            raise

    def compile(self, together: int) -> None:
        """Compiles the program that advances `together` episodes at once, ahead of its first use. It may be called from
        any thread: no episode changes."""
        [together] = whole_numbers("together", [together])
        require(
            1 <= together <= len(self), f"between 1 and {len(self)} episodes can be stepped together, got {together}"
        )
        rows, rows_n, chunk_nU = self._advance_inputs(list(range(together)))
        seeds, state = np.zeros(len(rows), np.uint32), self._programs.empty()
        jax.block_until_ready(self._programs.advance(self._programs.weights, state, rows_n, chunk_nU, seeds))

    # --- Going back, and apart ---------------------------------------------------------------------

    def snapshot(self) -> Snapshot:
        """The present state of all episodes."""
        episodes = copy.deepcopy(tuple(self._episodes))
        return Snapshot(self._copy_state(self._state), self.images, episodes, self._identity)

    @property
    def _identity(self) -> str:
        # Past the window the exact way to slide leaves the cache behind, the streaming way continues from it.
        slide = "" if self.decode.slide == "exact" else f" {self.decode.slide}"
        return f"{self.model.identity} {self.tokenizer.identity}{slide}"

    def restore(self, snapshot: Snapshot) -> np.ndarray:
        """Continues from a snapshot of this simulator, any number of times; the same actions then give the same frames.
        Raises ConfigError for a snapshot of another model, tokenizer or `decode.slide`, or of another number of
        episodes."""
        require(
            isinstance(snapshot, Snapshot), f"restore takes what `snapshot` returned, got {type(snapshot).__name__}"
        )
        require(
            len(snapshot.episodes) == len(self),
            f"the snapshot is of {len(snapshot.episodes)} episodes, not {len(self)}",
        )
        kinds = [jax.tree.map(lambda x: (x.shape, x.dtype), state) for state in (snapshot.state, self._state)]
        same = snapshot.identity == self._identity and kinds[0] == kinds[1]
        require(same, "the snapshot is of a simulator of another model or tokenizer, or of another decode.slide")
        self._state, self._images = self._copy_state(snapshot.state), snapshot.images
        self._episodes = list(copy.deepcopy(snapshot.episodes))
        return self.images

    def branch(self, sources: WholeNumbers) -> np.ndarray:
        """Episode b becomes a copy of episode sources[b], seed included, so that later differences are due only to
        actions."""
        copied = whole_numbers("sources", sources)
        fits = len(copied) == len(self) and all(0 <= s < len(self) for s in copied)
        require(fits, f"branch needs {len(self)} numbers of episodes to copy, each below {len(self)}, got {copied}")
        rows = np.asarray(copied, np.int32)
        self._state, self._images = self._programs.take(self._state, rows), self._images[rows]
        self._episodes = [copy.deepcopy(self._episodes[s]) for s in copied]
        return self.images

    def rewind(self, frames: int, episodes: WholeNumbers | None = None) -> np.ndarray:
        """Takes `episodes` (default: all) back by `frames` frames.

        Later frames are forgotten, and come again under the same actions: exactly with `decode.slide` "exact". With
        "streaming" the window is computed anew, which is nearer to exact than the previous cache.
        """
        [frames] = whole_numbers("frames", [frames])
        require(frames >= 0, f"the number of frames to rewind must not be negative, got {frames}")
        which = chosen_episodes(episodes, len(self))
        if not which:
            return self.images
        at = self._reset_inputs(which, self.model.config.frame_shape, self.model.config.frame_dtype)
        new: dict[int, Episode] = {}
        for b in which:
            max_rewind = self.max_rewind(b)
            require(frames <= max_rewind, f"in episode {b} at most {max_rewind} frames can be rewound, got {frames}")
            new[b] = self._running_episode(b).rewound(frames)
        for i, b in enumerate(at.rows.tolist()):
            at.set_episode(i, new[b], np.stack(list(new[b].frames)[-min(new[b].count, self.capacity) :]))
        with self._donating_state():
            state, made = self._programs.reset_from_tokens(self._programs.weights, self._state, at)
            seen = np.asarray(made)
            self._state = state
        for b, episode in new.items():
            self._episodes[b] = episode
        return self._update_images(which, seen[: len(which)])

    def max_rewind(self, b: int) -> int:
        """The number of frames by which episode b can be rewound."""
        return self._running_episode(b).max_rewind(self.capacity)

    def last_action(self, b: int) -> np.ndarray | None:
        """The native action [A] just before the present frame of episode b; None if that is its first."""
        episode = self._running_episode(b)
        robot = episode.robot
        if not episode.chunks:
            return None
        return episode.chunks[-1][: robot.stride * robot.action_dim].reshape(robot.stride, -1)[-1]

    def _copy_state(self, state: Episodes) -> Episodes:
        return self._programs.take(state, np.arange(len(self), dtype=np.int32))


def _checked(episodes: int, history: int, decode: DecodeConfig | None, outside: Outside, rate: Rate) -> tuple[int, int]:
    """(episodes, history). Raises ConfigError for options that no model can have."""
    [episodes], [history] = whole_numbers("episodes", [episodes]), whole_numbers("history", [history])
    require(episodes >= 1, f"a simulator needs at least 1 episode, got {episodes}")
    require(history >= 0, f"history, the number of frames that can be rewound, must not be negative, got {history}")
    require_choice(outside, get_args(Outside), "outside")
    require_choice(rate, get_args(Rate), "rate")
    require(
        decode is None or isinstance(decode, DecodeConfig),
        f"decode must be a DecodeConfig, got {type(decode).__name__}",
    )
    return episodes, history
