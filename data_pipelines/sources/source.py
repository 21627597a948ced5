"""The interface of all formats of robot data: random access to the episodes of one dataset.

Owns the interface that inspection, tokenizer training and tokenising use, and what all formats share: checking
cameras and action fields, and counting unusable episodes.
"""

from __future__ import annotations

import functools
import math
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from data_pipelines.errors import EpisodeError, too_many_skipped
from data_pipelines.sources.identity import EpisodeRun, episode_ids
from data_pipelines.sources.rlds.images import decode_image
from data_pipelines.sources.rlds.schema import FlatFeature, check_fields, field_slice
from hma_jax.config import require

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location

INSTRUCTION_KEY = "steps/language_instruction"

CODE_POINTS_KEY = "steps/observation/instruction"
"""Where Language Table keeps the text of a task, as code points with zeros behind them."""

INSTRUCTION_KEYS = (INSTRUCTION_KEY, "steps/observation/natural_language_instruction", CODE_POINTS_KEY)
"""Where RLDS datasets keep the text of a task."""

SUCCESS_KEY = "episode_metadata/success"
"""Optional episode flag that says whether the behaviour reached its goal."""

NO_ACTION = re.compile(r"terminat|is_first|is_last", re.IGNORECASE)
"""Names of flags for the beginning or end of an episode, which some datasets store beside the action."""

REWARD_KEY = "steps/reward"
"""Optional: the reward of each step's action, whose effect the next frame shows."""

MAX_SKIPPED = 16.0
"""Default limit of the policy corrupt='skip': a number of episodes or, below 1, a share of them."""

Corrupt = Literal["raise", "skip"]


def count_skippable(limit: float, episodes: int) -> int:
    """How many of `episodes` may be skipped: `limit`, or if it is below 1, this share of them, rounded down."""
    require(
        limit >= 0 and (limit < 1 or float(limit).is_integer()),
        f"max_skipped must be a whole number of episodes or, below 1, a fraction of them, got {limit:g}",
    )
    return int(limit if limit >= 1 else limit * episodes)


SourceFrame = bytes | np.ndarray
"""A frame as its source gives it: encoded bytes, or uint8 [H, W, 3] if frames are not encoded one by one (videos)."""


@dataclass(frozen=True)
class RawEpisode:
    """One episode as recorded. `images`: every `frame_step`-th of the N native frames."""

    images: list[np.ndarray]  # uint8 [H, W, 3] each
    actions: np.ndarray  # float32 [N, A], native rate, raw units
    success: bool | None

    @property
    def steps(self) -> int:
        """N, native frames."""
        return len(self.actions)


@dataclass(frozen=True)
class OpenEpisode:
    """An episode whose frames are decoded one by one, while it is open."""

    actions: np.ndarray  # float32 [N, A], native rate, raw units
    success: bool | None
    fetch: Callable[[int], SourceFrame]
    """Native frame n as its source gives it. Not thread-safe; in ascending order nothing is read twice. Raises
    EpisodeError."""
    decode: Callable[[int, SourceFrame], np.ndarray]
    """Decodes native frame n from the result of `fetch`: uint8 [H, W, 3]. Thread-safe. Raises EpisodeError."""

    @property
    def steps(self) -> int:
        """N, native frames."""
        return len(self.actions)

    def image(self, n: int) -> np.ndarray:
        return self.decode(n, self.fetch(n))

    def images(self, choose: Callable[[int], Sequence[int]]) -> list[np.ndarray]:
        """The images of the frames that `choose` names; it maps N to frame numbers."""
        chosen = choose(self.steps)
        seen = {t: self.image(t) for t in sorted(set(chosen))}
        return [seen[t] for t in chosen]


class EpisodeSource(ABC):
    """Random access to the `len(source)` episodes of one split. Thread-safe; can be pickled.

    `location`: where it lies. `features`: the fields of a step by their flat key, `steps/...`.
    `runs`: the names of all its episodes, readable or not (see `identity`).

    Damage: with corrupt="raise" every damaged part is an error. With "skip", only readable episodes are listed, `skip`
    accepts unusable ones, and all episodes that are left out are counted in `skipped`; more than `max_skipped` of them
    (below 1: more than this share of `runs`) raise DataError. A location that cannot be read at all is not damage: it
    raises UnreachableError under both policies.
    """

    name: str
    version: str
    split: str
    location: Location
    schema: Location  # the file that describes the fields
    features: Mapping[str, FlatFeature]
    runs: tuple[EpisodeRun, ...]
    files: int  # number of files that hold its episodes

    def __init__(self, corrupt: Corrupt, max_skipped: float):
        require(corrupt in ("raise", "skip"), f"corrupt must be 'raise' or 'skip', got {corrupt!r}")
        count_skippable(max_skipped, 0)
        self.corrupt, self._limit = corrupt, max_skipped
        self.skipped: dict[str, int] = {}  # reason -> episodes
        self._counted: set[int] = set()  # episodes that `skip` has counted

    @property
    def max_skipped(self) -> int:
        """How many episodes may be left out."""
        return count_skippable(self._limit, sum(run.count for run in self.runs))

    @abstractmethod
    def __len__(self) -> int: ...

    @property
    def numbers(self) -> np.ndarray:
        """int64 [episodes]: the number of each readable episode among all those named by `runs`. By default all are
        readable."""
        return np.arange(len(self), dtype=np.int64)

    @abstractmethod
    def fingerprint(self) -> str:
        """Hash of the contents, independent of the location."""

    def fingerprint_with_texts(self) -> str:
        """A fingerprint that also covers task texts."""
        return self.fingerprint()

    @abstractmethod
    def sizes(self) -> np.ndarray:
        """int64 [episodes]: approximate bytes of each."""

    @abstractmethod
    def steps(self) -> np.ndarray:
        """int32 [episodes]: native frames of each; -1 if unknown until it is read."""

    @abstractmethod
    def open_episode(self, i: int, image_key: str, action_keys: Sequence[str]) -> AbstractContextManager[OpenEpisode]:
        """Episode `i` in bounded memory, however long: see `OpenEpisode`.

        Keys are relative to a step: `observation/image_0`, `action`, `action/arm`, `action[:7]`.
        Raises ConfigError for unknown keys, EpisodeError for unusable contents.
        """

    @functools.cached_property
    def ids(self) -> np.ndarray:
        """uint64 per episode of `runs`: its name as a number, which splits and subsets hash."""
        return episode_ids(self.runs)

    @abstractmethod
    def record(self, i: int, keys: Sequence[str]) -> dict[str, Any]:
        """Fields of episode `i` by flat key, with all its cameras: numbers as arrays, texts as lists of
        bytes, images as sequences of `SourceFrame`. Fields that the episode lacks are absent. Raises EpisodeError."""

    @property
    def hz(self) -> float | None:
        """The native rate; None if the source does not say it."""
        return None

    def save_steps(self) -> None:
        """Saves what is known only after reading, such as the steps of episodes, for later starts."""

    def episode(self, i: int, image_key: str, action_keys: Sequence[str], frame_step: int = 1) -> RawEpisode:
        """Episode `i`, whole: one camera, the actions of `action_keys` concatenated, the success flag.

        Raises what `open_episode` raises.
        """
        with self.open_episode(i, image_key, action_keys) as episode:
            images = [episode.image(t) for t in range(0, episode.steps, frame_step)]
            return RawEpisode(images, episode.actions, episode.success)

    def frames(self, i: int, image_key: str, choose: Callable[[int], Sequence[int]]) -> list[np.ndarray]:
        """Some frames of episode `i`, without its actions: `choose` maps N to frame numbers. The frames are the same as
        `open_episode` decodes."""
        with self.open_episode(i, image_key, ()) as episode:
            return episode.images(choose)

    def check_keys(self, image_key: str, action_keys: Sequence[str], action_dims: Sequence[int] | None = None) -> None:
        """Raises ConfigError unless the camera and the action fields exist, with these sizes."""
        check_fields(self.name, self.schema, self.features, image_key, action_keys, action_dims)

    def without_location(self, reason: str) -> str:
        """The message without the dataset's location, so that results do not depend on where the dataset is stored."""
        place, name = str(self.location), self.location.name
        inside = reason.replace(f"{place}/", "")
        return inside.replace(place, name) if name else inside  # "." has none

    def skip(self, i: int, error: EpisodeError) -> None:
        """Counts the unusable episode `i`, only once however often it is read; raises `error` under the policy
        corrupt='raise'."""
        if self.corrupt == "raise":
            raise error
        if i not in self._counted:
            self._counted.add(i)
            self.count_skipped(str(error), 1)

    def count_skipped(self, reason: str, episodes: int) -> None:
        """Counts unusable or missing episodes. Raises DataError if they are too many."""
        self.skipped[reason] = self.skipped.get(reason, 0) + episodes
        total = sum(self.skipped.values())
        if total > self.max_skipped:
            raise too_many_skipped(self.name, total, self.max_skipped, reason)


def same_rate(hz: float, other: float) -> bool:
    """Whether two rates are the same number, even if one of them was printed and typed again (six digits)."""
    return math.isclose(hz, other, rel_tol=1e-5)


def vector_sizes(features: Mapping[str, FlatFeature]) -> dict[str, int]:
    """Number of values per step in each vector that is an action or an observation, by flat key. Besides these, sources
    have flags, rewards, and texts as code points or embeddings."""
    return {
        key: f.size
        for key, f in features.items()
        if f.size and not f.image and not f.encoding and key.startswith(("steps/observation/", "steps/action"))
        and "embedding" not in key and key not in INSTRUCTION_KEYS
    }  # fmt: skip


def action_fields(keys: Collection[str]) -> list[str]:
    """Which of a step's fields `keys` are its action, by their names: `action`, or else `actions` (its name in some
    LeRobot datasets), or else all `action/...` except flags (NO_ACTION)."""
    one = [key for key in ("action", "actions") if key in keys][:1]
    return one or [key for key in keys if key.startswith("action/") and not NO_ACTION.search(key)]


def find_instructions(record: Mapping[str, Any], steps: int) -> list[str]:
    """The text of every step in a record that was read with INSTRUCTION_KEYS; "" if it has none. A single text applies
    to all steps."""
    for key in INSTRUCTION_KEYS:
        values = record.get(key, ())
        if len(values) and isinstance(values[0], bytes):
            texts = [text.decode(errors="replace") for text in values]
            return texts if len(texts) == steps else texts[:1] * steps
    points = record.get(CODE_POINTS_KEY, ())
    if isinstance(points, np.ndarray) and points.dtype.kind in "iu" and steps and points.size % steps == 0:
        if ((points == 0) | ((points >= ord(" ")) & (points <= ord("~")))).all():  # other numbers are word ids
            return ["".join(map(chr, row[row > 0])) for row in points.reshape(steps, -1)]
    return [""] * steps


def find_success(record: Mapping[str, Any]) -> bool | None:
    """Whether the episode reached its goal, by a record that was read with SUCCESS_KEY; None if it has no such flag: a
    text, even "False", does not count."""
    success = record.get(SUCCESS_KEY)
    return bool(success[0]) if isinstance(success, np.ndarray) and len(success) == 1 else None


def decode_frame(frame: SourceFrame, unusable: Callable[[str], Exception]) -> np.ndarray:
    """uint8 [H, W, 3] of a frame as its source holds it.

    Raises what `unusable` makes of a reason, for bytes that are not an image.
    """
    if isinstance(frame, np.ndarray):
        return frame
    try:
        return decode_image(frame)
    except ValueError as error:
        raise unusable(f"cannot be decoded: {error}") from error


def join_actions(
    record: Mapping[str, Any],
    keys: Sequence[str],
    features: Mapping[str, FlatFeature],
    steps: int,
    unusable: Callable[[str], EpisodeError],
) -> np.ndarray:
    """float32 [steps, A]: the fields `keys` of a record (flat, possibly sliced), concatenated.

    Raises what `unusable` makes of a reason, for fields of another length and for values that are not finite.
    """

    def refuse(what: str) -> EpisodeError:
        return unusable(f"{what}. Repair the episode, or read with corrupt='skip'.")

    columns = [np.zeros((steps, 0), np.float32)]  # nothing else in a dataset without actions
    for key in keys:
        field, part = field_slice(key)
        values, size = record.get(field, []), features[field].size
        if not isinstance(values, np.ndarray) or values.size != steps * size or not steps:
            raise refuse(f"{key!r} has {np.size(values)} values, but {steps} frames of {size} need {steps * size}")
        if values.dtype.kind not in "biuf":
            raise refuse(f"{key!r} contains no numbers, but {values.dtype}")
        values = values.reshape(steps, size)[:, part].astype(np.float32)
        finite = np.isfinite(values).all(axis=1)
        if not finite.all():
            step = int(np.flatnonzero(~finite)[0])
            raise refuse(f"{key!r} is not finite at step {step}: {values[step].tolist()}")
        columns.append(values)
    return np.concatenate(columns, axis=1)
