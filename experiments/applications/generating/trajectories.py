"""Recorded trajectories at a model's rate: of an RLDS directory, or of a dataset in a study's token store."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data_pipelines.errors import EpisodeError, without_advice
from data_pipelines.registry import DatasetSpec, find_reader, get_spec
from data_pipelines.sources.identity import episode_ids
from data_pipelines.sources.open import open_source, source_name
from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.sources.rlds.schema import step_key
from data_pipelines.sources.source import (
    INSTRUCTION_KEYS,
    MAX_SKIPPED,
    REWARD_KEY,
    find_instructions,
    join_actions,
    vector_sizes,
)
from data_pipelines.tokens.episode_record import StoredEpisode
from data_pipelines.tokens.manifest import FILE as MANIFEST
from data_pipelines.tokens.manifest import Manifest
from data_pipelines.tokens.manifest_file import load_manifest
from data_pipelines.tokens.store import TokenStore
from experiments.terminal.words import counted
from hma_jax.config import ConfigError, require
from hma_jax.simulator.robots import Robot

if TYPE_CHECKING:
    from hma_jax.model.embodiments import EmbodimentTable
    from hma_jax.tokenizers.base import Tokenizer


@dataclass(frozen=True)
class Trajectory:
    """One recorded episode as a model sees it: M frames, and after each the chunk that was executed then."""

    origin: str  # dataset/split/number
    images: np.ndarray  # uint8 [M, H, W, 3]
    chunks: np.ndarray  # float32 [M, stride, A], raw; the last one's effect is not seen
    instructions: Sequence[str] = ()  # the text at each frame, "" for none

    def __len__(self) -> int:
        """M."""
        return len(self.images)


@dataclass(frozen=True)
class Outline:
    """What is known of a trajectory before its frames are decoded."""

    frames: int  # M
    success: bool | None  # whether it reached its goal, where the recording says so


@dataclass(frozen=True)
class Readings:
    """What was recorded at the M frames of a trajectory besides them and the actions."""

    observations: Mapping[str, np.ndarray] = field(default_factory=dict)  # float32 [M, size], as `observed` says
    rewards: np.ndarray | None = None  # float32 [M]: the sum over each frame's chunk


class Trajectories(ABC):
    """The recorded trajectories of one split, made when they are asked for."""

    name: str  # of the dataset
    drawn_as: str  # the name by which `ids` are hashed: the dataset's own, also where an entry joins it with others
    split: str
    fingerprint: str  # of its contents
    spec: DatasetSpec  # which camera and actions of it, at which rate
    reconstructed: bool = False  # whether images are what the tokenizer makes of tokens, for want of recorded ones
    observed: Mapping[str, int] = {}  # sizes of the vectors that `readings` has, by their keys in a step

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def __getitem__(self, i: int) -> Trajectory:
        """Raises EpisodeError for an episode that cannot be read."""

    @abstractmethod
    def outline(self, i: int) -> Outline:
        """Raises EpisodeError for an episode that cannot be read."""

    @abstractmethod
    def actions(self, i: int) -> np.ndarray:
        """float32 [N, A]: all native actions, raw, without the frames. Raises EpisodeError as `outline`."""

    def readings(self, i: int) -> Readings:
        """Raises EpisodeError for an episode whose readings cannot be used."""
        return Readings()

    def skip(self, i: int, error: EpisodeError) -> str:
        """Leaves out the damaged episode `i`; returns why, for people. Raises `error` where none may be damaged, and
        DataError for too many."""
        raise error

    @abstractmethod
    def rewards(self, i: int) -> np.ndarray | None:
        """float32 [M], see `rewards_of_frames`; None where the recording has none. Raises EpisodeError as `outline`."""

    @abstractmethod
    def ids(self) -> np.ndarray:
        """uint64 [trajectories]: what decides which are held out, see `sampling.splits`."""

    def origin(self, i: int) -> str:
        return f"{self.name}/{self.split}/{i}"


class RldsTrajectories(Trajectories):
    """Trajectories of a dataset in any format that is read in place."""

    def __init__(self, directory: str, split: str, spec: DatasetSpec, robot: Robot, size: int, max_lost: float = 0):
        """`max_lost`: how many episodes may be missing or damaged. Raises ConfigError for a dataset whose actions are
        not this robot's, DataError for more damage."""
        self._source = open_source(directory, split, corrupt="skip" if max_lost else "raise", max_skipped=max_lost)
        self.spec, self._robot, self._size = spec, robot, size
        self.name, self.split = spec.name, split
        self.fingerprint = self._source.fingerprint_with_texts()  # they are copied into what is generated
        self.drawn_as = self._source.name if spec.joins else spec.name
        _require_fit(spec, robot)
        self._source.check_keys(spec.image_key, spec.action_keys, spec.action_dims)
        sizes, start = vector_sizes(self._source.features), step_key("observation/")
        observed = {key: size for key, size in sizes.items() if key.startswith(start)}
        self.observed = {key.removeprefix(step_key("")): size for key, size in observed.items()}

    def __len__(self) -> int:
        return len(self._source)

    def __getitem__(self, i: int) -> Trajectory:
        spec = self.spec
        episode = self._source.episode(i, spec.image_key, spec.action_keys, self._robot.stride)
        images = spec.correct(fit_images(episode.images, self._size))
        texts = find_instructions(self._source.record(i, INSTRUCTION_KEYS), episode.steps)
        return _trajectory(self.origin(i), images, spec.convert(episode.actions), self._robot, texts)

    def outline(self, i: int) -> Outline:
        with self._source.open_episode(i, self.spec.image_key, self.spec.action_keys) as episode:
            return Outline(-(-episode.steps // self._robot.stride), episode.success)

    def actions(self, i: int) -> np.ndarray:
        with self._source.open_episode(i, self.spec.image_key, self.spec.action_keys) as episode:
            return self.spec.convert(episode.actions)

    def readings(self, i: int) -> Readings:
        stride, keys = self._robot.stride, [step_key(key) for key in self.observed]
        record, steps = self._source.record(i, [*keys, REWARD_KEY]), len(self.actions(i))

        def unusable(what: str) -> EpisodeError:
            return EpisodeError(f"{self.name}, episode {i}: {what}")

        vectors = (join_actions(record, [key], self._source.features, steps, unusable)[::stride] for key in keys)
        rewards = record.get(REWARD_KEY)
        if isinstance(rewards, np.ndarray):
            if rewards.shape != (steps,) or not np.isfinite(rewards).all():
                raise unusable(f"it has no reward for each of its {steps} steps")
            rewards = np.add.reduceat(rewards, np.arange(0, steps, stride)).astype(np.float32)
        return Readings(dict(zip(self.observed, vectors, strict=True)), rewards)

    def skip(self, i: int, error: EpisodeError) -> str:
        self._source.skip(i, error)
        return self._source.without_location(without_advice(str(error)))

    def rewards(self, i: int) -> np.ndarray | None:
        native = self._source.record(i, [REWARD_KEY]).get(REWARD_KEY)
        if not isinstance(native, np.ndarray):
            return None
        return rewards_of_frames(native, self._robot.stride)

    def ids(self) -> np.ndarray:
        return self._source.ids[self._source.numbers]


class StoredTrajectories(Trajectories):
    """Trajectories of a token store: its frames where it kept them, otherwise its tokens as the tokenizer decodes
    them."""

    def __init__(self, store: TokenStore, name: str, split: str, tokenizer: Tokenizer, robot: Robot):
        """Raises ConfigError for tokens of another tokenizer, or of frames too far apart."""
        manifest = store.manifest(name)
        _require_fit(manifest.spec, robot)
        made_by = manifest.tokenizer.identity
        require(
            made_by == tokenizer.identity,
            f"{store.root / name} has tokens of tokenizer {made_by}, but the model's tokenizer is "
            f"{tokenizer.identity}; give the RLDS directory that the tokens were made from",
        )
        require(
            robot.stride % manifest.frame_step == 0,
            f"{store.root / name} keeps one of {manifest.frame_step} frames, but {robot.name} needs one of "
            f"{robot.stride}; give the RLDS directory that the tokens were made from",
        )
        self._store, self._tokenizer, self._robot = store, tokenizer, robot
        self._every = robot.stride // manifest.frame_step
        self.name, self.split, self.fingerprint, self.spec = name, split, manifest.hash(), manifest.spec
        self.drawn_as = name
        self._count = len(manifest.split(split).episodes)
        self.reconstructed = self._count > 0 and not self._keeps(store.episode(name, split, 0))

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, i: int) -> Trajectory:
        episode = self._store.episode(self.name, self.split, i)
        if self._keeps(episode):
            images = np.array(episode.frames[:: self._every])
        else:
            images = np.asarray(self._tokenizer.decode(np.array(episode.tokens[:: self._every])))
        return _trajectory(self.origin(i), images, episode.actions, self._robot, [""] * len(episode.actions))

    def _keeps(self, episode: StoredEpisode) -> bool:
        """Whether there are the recorded frames of an episode, of the size that the model's have."""
        return episode.frames is not None and episode.frames.shape[1:3] == self._tokenizer.image_shape

    def outline(self, i: int) -> Outline:
        episode = self._store.episode(self.name, self.split, i)
        return Outline(len(episode.tokens[:: self._every]), episode.success)

    def actions(self, i: int) -> np.ndarray:
        return self._store.episode(self.name, self.split, i).actions

    def rewards(self, i: int) -> np.ndarray | None:
        return None  # a token store does not keep them

    def ids(self) -> np.ndarray:
        manifest = self._store.manifest(self.name)
        numbers = np.asarray(manifest.split(self.split).episodes, np.int64)
        return episode_ids(manifest.runs)[numbers] if manifest.runs else numbers.astype(np.uint64)


def open_trajectories(
    place: str,
    split: str,
    robot: Robot | None,
    robots: dict[str, Robot],
    tokenizer: Tokenizer,
    stores: Path,
    *,
    skip_damaged: bool = False,
) -> tuple[Trajectories, Robot]:
    """(the trajectories at `place`, the robot that replays them): `robot`, by default the one that has the name of the
    dataset, or of the dataset that it is joined to.

    `place` is a dataset's directory, one of a token store (`STORE/NAME`), or the name of a dataset in the token store
    `stores`. Raises ConfigError for what is none of them, or of no known robot, and for an entry that corrects images
    otherwise than that store was made; DataError for more damaged episodes than were left out of the tokens of the same
    dataset in `stores`, with `skip_damaged` for more than MAX_SKIPPED, if that is more.
    """
    path = Path(place)
    if not path.exists() and stores.is_dir() and "/" not in place:
        available = TokenStore(stores).names
        require(
            place in available,
            f"{place}: no such directory, and {stores} has tokens of {', '.join(available) or 'nothing'}",
        )
        path = stores / place
    stored = (path / MANIFEST).is_file()
    name = path.name if stored else source_name(place)
    entry = None if stored else find_reader(name)
    name = name if entry is None else entry.name
    chosen = robot or robots.get(name)
    if chosen is None:
        known = ", ".join(robots)
        raise ConfigError(
            f"the dataset of {place} is called {name!r}, but the model's robots are {known}; choose one with --robot"
        )
    if stored:
        return StoredTrajectories(TokenStore(path.parent), name, split, tokenizer, chosen), chosen
    learnt_from = _find_manifest(stores / name)
    if name == chosen.name and learnt_from is not None:
        _require_corrections(get_spec(name), learnt_from, stores / name)
    max_lost = max(learnt_from.skipped_count if learnt_from is not None else 0, MAX_SKIPPED if skip_damaged else 0)
    return RldsTrajectories(place, split, get_spec(name), chosen, tokenizer.image_size, max_lost), chosen


def describe_reconstruction(recorded: Trajectories) -> str:
    """A note for the user where images are the tokenizer's reconstructions, for want of recorded frames; '' where they
    are recorded."""
    if not recorded.reconstructed:
        return ""
    return (
        f"note: the token store has no frames of {recorded.name}, split {recorded.split}. PSNR is computed against "
        "frames decoded from tokens, so it does not contain the error of the tokenizer; to avoid this, give the "
        "directory of the recordings"
    )


def describe_lacking(recorded: Trajectories) -> str:
    """A note for the user on what a token store does not keep; '' where there are the recordings themselves."""
    if not isinstance(recorded, StoredTrajectories):
        return ""
    return (
        "note: a token store keeps neither texts nor observed vectors and rewards: language_instruction will be empty and "
        "reward 0. If policies need them, give the directory of the recordings"
    )


def describe_training(recorded: Trajectories, count: int, stores: Path) -> str:
    """A note for the user where a study whose tokens are in `stores` trains on some of the first `count` trajectories;
    '' where it trains on none, or where that is not known."""
    manifest = _find_manifest(stores / recorded.name)
    if manifest is None or not manifest.runs:
        return ""
    trained = episode_ids(manifest.runs)[np.asarray(manifest.train.episodes, np.int64)]
    seen = int(np.isin(recorded.ids()[:count], trained).sum())
    if not seen:
        return ""
    return (
        f"note: the run's study trains on {seen:,} of {counted(count, 'episode')}, and PSNR is higher on such than on new "
        f"ones; `--actions {recorded.name} --split val` replays those that are held out"
    )


def _find_manifest(tokens: Path) -> Manifest | None:
    """None where there are no tokens: the run was moved, or converted."""
    return load_manifest(tokens / MANIFEST) if (tokens / MANIFEST).is_file() else None


def _require_fit(spec: DatasetSpec, robot: Robot) -> None:
    require(
        spec.action_dim == robot.action_dim,
        f"{spec.name} has {spec.action_dim} action values, but {robot.name} needs {robot.action_dim}; give the robot "
        "whose actions they are with --robot",
    )
    require(
        not robot.hz or robot.hz == spec.hz,
        f"{spec.name} was recorded at {spec.hz:g} Hz, but the model was trained with {robot.name} at {robot.hz:g} Hz",
    )


def _require_corrections(spec: DatasetSpec, learnt_from: Manifest, tokens: Path) -> None:
    """Raises ConfigError where the `tokens` that a model was trained on were made of frames that were corrected in
    another way: it would be shown, say, rotated ones."""
    learnt = learnt_from.spec.image_corrections
    there, asked = (" and ".join(corrections) or "none" for corrections in (learnt, spec.image_corrections))
    require(
        learnt == spec.image_corrections,
        f"{spec.name}: image_corrections of the registry's entry are not those of the tokens in {tokens} (there -> asked "
        f"for): {there} -> {asked}. The model has not seen such frames; restore those of the tokens in the entry "
        "(--registry)",
    )


def require_layout(recorded: Trajectories, robot: Robot, table: EmbodimentTable) -> None:
    """Raises ConfigError where recordings that are called after a robot have other actions than its model learnt."""
    if recorded.name == robot.name:
        recorded.spec.check_layout(table.entries[table.index(robot.name)])


def _trajectory(origin: str, images: np.ndarray, actions: np.ndarray, robot: Robot, texts: Sequence[str]) -> Trajectory:
    """Frames every `stride` native steps, and all actions between them; of a last chunk that is not whole, the last
    action is held. `texts`: of all native steps."""
    missing = len(images) * robot.stride - len(actions)
    held = np.concatenate([actions, np.repeat(actions[-1:], max(missing, 0), 0)])[: len(images) * robot.stride]
    chunks = held.reshape(len(images), robot.stride, robot.action_dim).astype(np.float32)
    return Trajectory(origin, images, chunks, tuple(texts[:: robot.stride]))


def rewards_of_frames(native_N: np.ndarray, stride: int) -> np.ndarray:
    """float32 [M], of N native steps: the reward of the action that led to each frame, nan for the first. The last
    frame has the greatest of that and of what came after it, which no frame shows: many recordings reward their last
    step alone.
    """
    before = np.arange(0, len(native_N), stride) - 1
    rewards = np.where(before < 0, np.nan, native_N[before]).astype(np.float32)
    rewards[-1] = native_N[max(before[-1], 0) :].max()
    return rewards


def describe(trajectories: Trajectories) -> dict[str, Any]:
    """What identifies these recordings, and what is taken of them."""
    spec = trajectories.spec
    taken = {"image_key": spec.camera_key, "action_layout": spec.action_layout()}
    return {"dataset": trajectories.name, "split": trajectories.split, "contents": trajectories.fingerprint, **taken}
