"""An RLDS dataset directory as random-access episodes, without TensorFlow.

Owns reading what tfds wrote: schema, shards, records, one camera and the action of an
episode. Knows neither tokenizers nor windows nor which dataset has which camera (see
`registry`). tfds is asked for metadata only; records go through `tfrecord` and `example`,
and lie on a disk or in a remote store (see `location`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from data_pipelines.errors import CorruptRecordError, DataError, EpisodeError, UnreachableError
from data_pipelines.rlds.example import Feature, parse_example
from data_pipelines.rlds.images import decode_image
from data_pipelines.rlds.location import REMOTE_READS, OpenFiles, is_remote
from data_pipelines.rlds.schema import closest, field_slice, listing, read_metadata, resolve_version, step_key
from data_pipelines.rlds.tfrecord import ShardIndex, open_record, read_parts, scan_shard
from hma_jax.config import ConfigError, require

if TYPE_CHECKING:
    from data_pipelines.rlds.location import Location

SUCCESS_KEY = "episode_metadata/success"
"""Optional episode flag that says whether the behaviour reached its goal."""

MAX_SKIPPED = 16
"""Default bound of the policy corrupt='skip'."""

REMEMBERED = 2**14
"""Episodes of which it is remembered where their frames lie: 16 bytes a frame."""


@dataclass(frozen=True)
class RawEpisode:
    """One episode as recorded. `images`: every `frame_step`-th of the N native frames."""

    index: int
    images: list[np.ndarray]  # uint8 [H, W, 3] each
    actions: np.ndarray  # float32 [N, A], native rate, raw units
    success: bool | None

    @property
    def steps(self) -> int:
        """N, native frames."""
        return len(self.actions)


@dataclass(frozen=True)
class OpenEpisode:
    """An episode whose frames are decoded one by one, while its record is open."""

    index: int
    actions: np.ndarray  # float32 [N, A], native rate, raw units
    success: bool | None
    encoded: Callable[[int], bytes]
    """Native frame n as recorded. One thread at a time. Raises EpisodeError if it cannot be read."""
    decode: Callable[[int, bytes], np.ndarray]
    """Native frame n from its bytes, uint8 [H, W, 3], in any thread. Raises EpisodeError."""

    @property
    def steps(self) -> int:
        """N, native frames."""
        return len(self.actions)

    def image(self, n: int) -> np.ndarray:
        return self.decode(n, self.encoded(n))


class RldsDataset:
    """Random access to the episodes of one split, or of several one after the other ("train+val").

    `directory`, a path or URL, is a version directory (`<name>/1.0.0`) or its parent, then the
    newest version is taken. Shards are indexed when the object is made. Thread-safe; pickles.

    Damage: with corrupt="raise" every damaged shard or record is an error. With "skip",
    what a damaged shard still holds is indexed, `skip` accepts unusable episodes, and all
    losses are listed in `skipped`; more than `max_skipped` of them raise DataError.

    Many datasets may share `files`, so that their number does not multiply the files kept open.

    Raises DataError for a directory that is no dataset, missing or damaged shards and a
    record count that contradicts dataset_info.json; ConfigError for an unknown split.
    """

    def __init__(
        self,
        directory: str | Location,
        split: str = "train",
        *,
        corrupt: Literal["raise", "skip"] = "raise",
        max_skipped: int = MAX_SKIPPED,
        files: OpenFiles | None = None,
    ):
        require(corrupt in ("raise", "skip"), f"corrupt must be 'raise' or 'skip', got {corrupt!r}")
        self.directory = resolve_version(directory)
        self.split = split
        self.corrupt = corrupt
        self.max_skipped = max_skipped
        self.skipped: dict[str, int] = {}  # reason -> episodes lost
        self._files = OpenFiles() if files is None else files
        self._known: dict[tuple[int, str], np.ndarray] = {}  # (episode, image) -> where its frames lie, [N, 2]
        meta = read_metadata(self.directory, split)
        self.name, self.version = meta.name, meta.version
        self.features = meta.features
        self._shard_splits = meta.shard_splits
        self._index(meta.shards, meta.shard_lengths)

    def __len__(self) -> int:
        return len(self._lengths)

    def fingerprint(self) -> str:
        """Hash over the shards' names and sizes and the length and checksum of every record."""
        digest = hashlib.sha256()
        for path, size in zip(self._paths, self._sizes, strict=True):
            digest.update(f"{path.name}:{size};".encode())
        digest.update(self._lengths.astype("<i8").tobytes())
        digest.update(self._checksums.astype("<u4").tobytes())
        return digest.hexdigest()[:16]

    # --- episodes ----------------------------------------------------------------------------

    @contextmanager
    def open_episode(
        self, i: int, image_key: str, action_keys: Sequence[str]
    ) -> Iterator[OpenEpisode]:
        """Episode `i` in bounded memory, however large its record: see `OpenEpisode`.

        Keys are relative to a step, as in features.json: `observation/image_0`, `action`,
        `action/arm`, `action[:7]`. Raises ConfigError for keys that the dataset lacks, CorruptRecordError
        for damaged bytes and EpisodeError for contents that cannot be used.
        """
        self.check_keys(image_key, action_keys)
        image_key, action_keys = step_key(image_key), [step_key(k) for k in action_keys]
        fields = [field_slice(key)[0] for key in action_keys]
        with self._open(i, [image_key, *fields, SUCCESS_KEY]) as record:
            encoded = self._frames_of(i, record, image_key)
            actions = self._actions(i, record, action_keys, steps=len(encoded))
            success = record.get(SUCCESS_KEY)
            known = success is not None and len(success) == 1
            yield OpenEpisode(
                i,
                actions,
                bool(success[0]) if known else None,
                lambda step: self._encoded(i, image_key, step, encoded),
                lambda step, data: self._image(i, image_key, step, data),
            )

    def episode(
        self, i: int, image_key: str, action_keys: Sequence[str], frame_step: int = 1
    ) -> RawEpisode:
        """Episode `i`, whole: one camera, the actions of `action_keys` concatenated, the success flag.

        Raises what `open_episode` raises.
        """
        with self.open_episode(i, image_key, action_keys) as episode:
            images = [episode.image(t) for t in range(0, episode.steps, frame_step)]
            return RawEpisode(i, images, episode.actions, episode.success)

    def frames(
        self, i: int, image_key: str, choose: Callable[[int], Sequence[int]], at_least: int = 0
    ) -> list[np.ndarray]:
        """Some frames of episode `i`, without its actions: `choose` maps N to frame numbers.

        JPEG images may come smaller, see `decode_image`. A record is read and verified as a whole
        once; where its frames lie is remembered, and after that they alone are read, from a file
        that stays open (see `OpenFiles`).
        """
        key = step_key(image_key)
        known = self._known.get((i, key))
        if known is not None:
            chosen = choose(len(known))
            path, offset, _ = self._place(i)
            parts = read_parts(self._files.get(path), path, offset, known[chosen].tolist())
        else:
            self.check_keys(image_key, ())
            with self._open(i, [key]) as record:
                encoded = self._frames_of(i, record, key)
                chosen = choose(len(encoded))
                parts = [self._encoded(i, key, t, encoded) for t in chosen]
                if len(self._known) < REMEMBERED and not is_remote(self.directory):
                    self._known[i, key] = np.asarray(encoded.spans)
        return [self._image(i, key, t, data, at_least) for t, data in zip(chosen, parts, strict=True)]

    def record(self, i: int, keys: Sequence[str] | None = None) -> dict[str, Feature]:
        """The flat features of episode `i`, as `example.parse_example` gives them."""
        with self._open(i, keys, lazy=False) as record:
            return record

    def in_split(self, split: str) -> np.ndarray:
        """bool [episodes]: those that lie in this one of the splits that are read."""
        return np.array([s == split for s in self._shard_splits])[self._shard_of]

    def sizes(self) -> np.ndarray:
        """int64 [episodes]: bytes of each record."""
        return self._lengths

    def check_keys(
        self, image_key: str, action_keys: Sequence[str], action_dims: Sequence[int] | None = None
    ) -> None:
        """Raises ConfigError unless the camera and the action fields exist, with these sizes."""
        cameras = [k for k, f in self.features.items() if f.image]
        numbers = [k for k, f in self.features.items() if f.size and "action" in k]
        if step_key(image_key) not in self.features:
            raise ConfigError(
                f"{self.name}: no image {image_key!r} in {self.directory / 'features.json'}; "
                f"images there: {listing(cameras)}{closest(image_key, cameras)}. Correct image_key."
            )
        require(
            self.features[step_key(image_key)].image,
            f"{self.name}: {image_key!r} is not an image; images: {listing(cameras)}. Correct image_key.",
        )
        for n, key in enumerate(action_keys):
            field, part = field_slice(key)
            feature = self.features.get(step_key(field))
            if feature is None or not feature.size:
                raise ConfigError(
                    f"{self.name}: no numeric field {field!r} in {self.directory / 'features.json'}; "
                    f"action fields there: {listing(numbers)}{closest(field, numbers)}. Correct action_keys."
                )
            size = len(range(feature.size)[part])
            if action_dims is not None and size != action_dims[n]:
                raise ConfigError(
                    f"{self.name}: field {key!r} has {size} values per step in "
                    f"{self.directory / 'features.json'}, but {action_dims[n]} were expected. "
                    "Correct action_dims, or read the version of the dataset it was written for."
                )

    def skip(self, error: EpisodeError) -> None:
        """Counts an unusable episode once, or raises `error` under the policy corrupt='raise'."""
        if self.corrupt == "raise":
            raise error
        if str(error) not in self.skipped:
            self._lose(str(error), 1)

    # --- inside ------------------------------------------------------------------------------

    @contextmanager
    def _open(
        self, i: int, keys: Sequence[str] | None, lazy: bool = True
    ) -> Iterator[dict[str, Feature]]:
        path, offset, length = self._place(i)
        with open_record(path, offset, length) as payload:
            try:
                record = parse_example(payload, keys, lazy)
            except (DataError, OSError) as error:
                raise CorruptRecordError(path, offset, str(error)) from error
            yield record

    def _index(self, shards: list[Location], expected: list[int]) -> None:
        offsets, lengths, checksums, shard_of, sizes = [], [], [], [], []
        for n, (path, count, scanned) in enumerate(zip(shards, expected, _scan(shards), strict=True)):
            if isinstance(scanned, DataError):
                if self.corrupt == "raise" or isinstance(scanned, UnreachableError):
                    raise scanned
                self._lose(str(scanned), count)
                sizes.append(0)
                continue
            index, damage = scanned
            if damage is not None and self.corrupt == "raise":
                raise damage
            self._check_count(path, len(index), count, damage)
            offsets.append(index.offsets)
            lengths.append(index.lengths)
            checksums.append(index.checksums)
            shard_of.append(np.full(len(index), n, np.int32))
            sizes.append(path.stat().st_size)
        self._paths, self._sizes = shards, sizes
        self._offsets = np.concatenate(offsets or [np.zeros(0, np.int64)])
        self._lengths = np.concatenate(lengths or [np.zeros(0, np.int64)])
        self._checksums = np.concatenate(checksums or [np.zeros(0, np.uint32)])
        self._shard_of = np.concatenate(shard_of or [np.zeros(0, np.int32)])
        if not len(self):
            raise DataError(f"{self.directory}: split {self.split!r} has no readable episode.")

    def _check_count(self, path: Location, found: int, expected: int, damage: Exception | None) -> None:
        if found == expected:
            return
        empty = ": the file is empty" if path.stat().st_size == 0 else ""
        message = (
            f"{path}: {found} records, but dataset_info.json says {expected}{empty}. "
            "Fetch the shard again, or restore the dataset_info.json it was written with."
        )
        if self.corrupt == "raise" or found > expected:
            raise DataError(message)
        self._lose(str(damage or message), expected - found)

    def _lose(self, reason: str, episodes: int) -> None:
        self.skipped[reason] = self.skipped.get(reason, 0) + episodes
        lost = sum(self.skipped.values())
        if lost > self.max_skipped:
            raise DataError(
                f"{self.name}: {lost} episodes are unusable, more than max_skipped={self.max_skipped}. "
                f"The last: {reason} Raise max_skipped if the rest is worth it."
            )

    def _place(self, i: int) -> tuple[Location, int, int]:
        if not 0 <= i < len(self):
            raise IndexError(f"{self.name}: episode {i} of {len(self)}")
        return self._paths[self._shard_of[i]], int(self._offsets[i]), int(self._lengths[i])

    def _unusable(self, i: int, what: str) -> EpisodeError:
        path, offset, _ = self._place(i)
        where = f"{self.name}, episode {i} ({path.name}, byte {offset})"
        return EpisodeError(f"{where}: {what}").at(path, offset)

    def _frames_of(self, i: int, record: dict[str, Feature], key: str) -> Sequence[bytes]:
        encoded = record.get(key, ())
        if not len(encoded):
            raise self._unusable(i, f"it has no frames in {key!r}; leave it out with corrupt='skip'")
        return encoded

    def _encoded(self, i: int, key: str, step: int, encoded: Sequence[bytes]) -> bytes:
        try:
            return encoded[step]
        except OSError as error:
            raise self._unusable(i, f"step {step} of {key!r} cannot be read ({error})") from error

    def _image(self, i: int, key: str, step: int, data: bytes, at_least: int = 0) -> np.ndarray:
        try:
            return decode_image(data, at_least)
        except ValueError as error:
            raise self._unusable(
                i,
                f"step {step} of {key!r} cannot be decoded: {error}. "
                "Repair the episode, or read with corrupt='skip'.",
            ) from error

    def _actions(self, i: int, record: dict[str, Feature], keys: list[str], steps: int) -> np.ndarray:
        columns = [np.zeros((steps, 0), np.float32)]  # of a dataset without actions nothing else
        for key in keys:
            field, part = field_slice(key)
            values, size = record.get(field, []), self.features[field].size
            if not isinstance(values, np.ndarray) or len(values) != steps * size or not steps:
                raise self._unusable(
                    i,
                    f"{key!r} has {len(values)} values, but {steps} frames of {size} need "
                    f"{steps * size}. Repair the episode, or read with corrupt='skip'.",
                )
            values = values.reshape(steps, size).astype(np.float32)
            finite = np.isfinite(values).all(axis=1)
            if not finite.all():
                step = int(np.flatnonzero(~finite)[0])
                raise self._unusable(
                    i,
                    f"{key!r} is not finite at step {step}: {values[step].tolist()}. "
                    "Repair the episode, or read with corrupt='skip'.",
                )
            columns.append(values[:, part])
        return np.concatenate(columns, axis=1)


Scanned = tuple[ShardIndex, CorruptRecordError | None] | DataError


def _scan(shards: Sequence[Location]) -> Iterator[Scanned]:
    """Each shard's index or what is wrong with it; several at a time if they are remote."""

    def scan(path: Location) -> Scanned:
        try:
            return scan_shard(path)
        except DataError as error:
            return error

    if not shards or not is_remote(shards[0]):
        yield from map(scan, shards)
        return
    with ThreadPoolExecutor(REMOTE_READS) as pool:
        yield from pool.map(scan, shards)
