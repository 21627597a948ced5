"""The metadata of an RLDS directory: its version directory, the fields of a step, its splits and shards, its rate.

Owns reading features.json, dataset_info.json and metadata.json as tfds wrote them. Reads no record, and imports neither
tfds nor the classes that the files name; the files may be of unknown origin, on a disk or in a remote store.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from data_pipelines.errors import DataError, NoDatasetError, UnreachableError
from data_pipelines.json_file import read_object
from data_pipelines.names import NAME_RULE, is_dataset_name, quote
from data_pipelines.sources.rlds.features import FlatFeature, parse_features
from data_pipelines.sources.rlds.location import exists, locate, retry
from hma_jax.config import ConfigError, require

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location

INFO, FEATURES, METADATA = "dataset_info.json", "features.json", "metadata.json"
RATE_KEY = "hz"
"""The key of metadata.json under which this package's writers store native frames per second."""

TEMPLATE = "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}"
"""tfds's default template of shard names."""

MAX_SHARDS = 2**15
"""Shards of one split."""

DATASETS = (
    "the directory of an RLDS dataset, <name> or <name>/<version> as tfds wrote it, the root of a LeRobot dataset, or a "
    "robomimic .hdf5 file"
)
"""What a location may be, for messages: a location of no other format is taken for RLDS."""

ADVICE = "Restore the file as tfds wrote it."

FILE_FORMATS = ("tfrecord", "array_record")
"""Supported file formats of shards, as named in dataset_info.json."""


@dataclass(frozen=True)
class SplitInfo:
    """What dataset_info.json says about one split."""

    name: str
    shard_lengths: tuple[int, ...]  # records in each shard
    bytes: int
    template: str  # template of the shards' names


@dataclass(frozen=True)
class DatasetInfo:
    """What dataset_info.json says about a dataset."""

    name: str
    version: str
    file_format: str
    splits: dict[str, SplitInfo]

    def shard_names(self, split: str) -> list[str]:
        """The file names of a split's shards. Raises ValueError for an invalid one."""
        of = self.splits[split]
        count = len(of.shard_lengths)
        digits = max(len(str(count)), 5)
        fields = {"DATASET": self.name, "SPLIT": split, "FILEFORMAT": self.file_format}
        names = []
        for n in range(count):
            here, all_ = f"{n:0{digits}d}", f"{count:0{digits}d}"
            fields |= {"SHARD_INDEX": here, "NUM_SHARDS": all_, "SHARD_X_OF_Y": f"{here}-of-{all_}"}
            name = re.sub(r"\{([A-Z_]+)\}", lambda m: fields.get(m[1], m[0]), of.template)
            name = name.rpartition("/")[2]
            if not 0 < len(name) <= 255 or not name.isprintable() or name.startswith(".") or "{" in name:
                raise ValueError(f"split {split!r}: {quote(name)}, of filepathTemplate, is no name of a shard")
            names.append(name)
        return names


@dataclass(frozen=True)
class SplitMetadata:
    """What tfds recorded about a split, or several: flat schema, shard files with their record counts and splits."""

    name: str
    version: str
    features: dict[str, FlatFeature]
    shards: list[Location]
    shard_lengths: list[int]
    shard_splits: list[str]
    file_format: str


def resolve_version(directory: str | Location) -> Location:
    """The version directory: `directory` itself or its newest version.

    Raises NoDatasetError for a location that is not a dataset; another DataError if perhaps only its disk is not
    mounted: its parent is missing, or it is empty.
    """
    directory = locate(directory)
    if not exists(directory, "directory"):
        what = "it is a file, not a directory" if exists(directory, "file") else "no such directory"
        kind = NoDatasetError if exists(directory.parent, "directory") else DataError
        raise kind(f"{directory}: {what}. Give {DATASETS}.")
    if _has_info(directory):
        return directory
    inside = retry(directory, lambda: list(directory.iterdir()))
    versions = [d for d in inside if re.fullmatch(r"\d+\.\d+\.\d+", d.name) and _has_info(d)]
    if versions:
        return max(versions, key=lambda d: tuple(map(int, d.name.split("."))))
    entries = sorted(p.name for p in inside)
    raise (NoDatasetError if entries else DataError)(
        f"{directory} is no dataset: neither it nor a version directory in it, such as 1.0.0, has a dataset_info.json, "
        f"and it has no meta/info.json (it holds {listing(entries[:6]) or 'nothing'}). Give {DATASETS}."
    )


def _has_info(directory: Location) -> bool:
    return exists(directory / INFO, "file")


def dataset_name(directory: str | Location) -> str:
    """The dataset's name in dataset_info.json. Raises DataError for a directory that is not an RLDS dataset."""
    return read_info(resolve_version(directory)).name


def read_metadata(directory: Location, split: str) -> SplitMetadata:
    """Metadata of one split, or of several one after the other as in "train+val".

    Raises DataError for damaged files, ConfigError for an unknown split.
    """
    info = read_info(directory)
    features = read_features(directory)
    if info.file_format not in FILE_FORMATS:
        known = " and ".join(FILE_FORMATS)
        raise DataError(f"{directory / INFO}: fileFormat is {quote(info.file_format)}; only {known} can be read.")
    parts = split.split("+")
    for part in parts:
        require(
            part in info.splits,
            f"{info.name}: no split {part!r} in {directory}; it has {listing(sorted(info.splits))}. Choose one with "
            f"--split, or, if the command has no such option, with split in the dataset's registry entry.{of_a_part(part)}",
        )
    try:
        shards = [name for part in parts for name in info.shard_names(part)]
    except ValueError as error:
        raise DataError(f"{directory / INFO}: {error}. {ADVICE}") from error
    return SplitMetadata(
        name=info.name,
        version=info.version,
        features=features,
        shards=[directory / name for name in shards],
        shard_lengths=[n for part in parts for n in info.splits[part].shard_lengths],
        shard_splits=[part for part in parts for _ in info.splits[part].shard_lengths],
        file_format=info.file_format,
    )


def of_a_part(split: str) -> str:
    """The end of a message that refuses `split`: what to do if it is a part of a split, such as "train[:5]"; ''
    otherwise."""
    whole, _, part = split.partition("[")
    if not part:
        return ""
    return f" Of a split no part can be named: give {whole!r}, and tokenise N of its episodes with --set store.max_train=N."


def read_features(directory: Location) -> dict[str, FlatFeature]:
    """Every field of a record, by its flat key. Raises DataError for a file that is missing or damaged."""
    path = directory / FEATURES
    schema = read_object(path, if_missing=ADVICE, advice=ADVICE)
    try:
        return parse_features(schema)
    except ValueError as error:
        raise DataError(f"{path}: {error}. {ADVICE}") from error


def read_info(directory: Location) -> DatasetInfo:
    """Raises DataError for a dataset_info.json that is missing or damaged."""
    path = directory / INFO
    values = read_object(path, if_missing=ADVICE, advice=ADVICE)
    name, version = values.get("name"), values.get("version")
    if (
        isinstance(name, str) and name.isidentifier() and not is_dataset_name(name)
    ):  # tfds takes letters of any alphabet
        raise DataError(
            f"{path}: name is {quote(name)}: {NAME_RULE}. Change it there and in the names of the shards, which begin "
            "with it."
        )
    try:
        splits = [_split(split) for split in _list(values.get("splits", []), "splits")]
        file_format = values.get("fileFormat", values.get("file_format")) or "tfrecord"
        for text, what in ((name, "name"), (version, "version"), (file_format, "fileFormat")):
            if not is_dataset_name(text):
                raise ValueError(f"{what} is {quote(text)}: {NAME_RULE}")
    except ValueError as error:
        raise DataError(f"{path}: {error}. {ADVICE}") from error
    return DatasetInfo(name, version, file_format, {split.name: split for split in splits})


def read_rate(directory: Location) -> float | None:
    """Native frames per second, as metadata.json says (`RATE_KEY`). None if it holds no rate, is missing or is not
    JSON: nothing else is read from it, and other programs may keep anything there. Raises UnreachableError if the disk
    or the store fails."""
    path = directory / METADATA
    if not exists(path, "file"):
        return None
    try:
        hz = read_object(path, if_missing=ADVICE, advice=ADVICE).get(RATE_KEY)
    except UnreachableError:
        raise
    except DataError:
        return None
    return float(hz) if type(hz) in (int, float) and 0 < hz < math.inf else None


def _split(values: Any) -> SplitInfo:
    if not isinstance(values, dict) or not is_dataset_name(values.get("name")):
        raise ValueError("a split has no valid name")
    name = values["name"]
    template = values.get("filepathTemplate", values.get("filepath_template")) or TEMPLATE
    if not isinstance(template, str) or len(template) > 256:
        raise ValueError(f"split {name!r}: filepathTemplate is {quote(template)}")
    lengths = _list(values.get("shardLengths", values.get("shard_lengths", [])), f"shardLengths of {name!r}")
    if len(lengths) > MAX_SHARDS:
        raise ValueError(f"split {name!r}: {len(lengths):,} shards, more than {MAX_SHARDS:,}")
    size = _count(values.get("numBytes", values.get("num_bytes", 0)), f"numBytes of {name!r}")
    return SplitInfo(name, tuple(_count(n, f"shardLengths of {name!r}") for n in lengths), size, template)


def _list(value: Any, what: str) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{what}: {quote(value)} is not a list")
    return value


def _count(value: Any, what: str) -> int:
    """A number below 2^63; the JSON of a message has such numbers as strings."""
    if isinstance(value, str) and len(value) <= 19 and value.isascii() and value.isdecimal():
        value = int(value)
    if type(value) is not int or not 0 <= value < 2**63:
        raise ValueError(f"{what}: {quote(value)} is not a count")
    return value


def field_slice(key: str) -> tuple[str, slice]:
    """The field of an action key, and the slice of its values: `action[:7]` is ("action", slice(0, 7))."""
    match = re.fullmatch(r"(.+)\[(\d{0,9}):(\d{0,9})\]", key)
    if not match:
        return key, slice(0, None)
    field, start, stop = match.groups()
    return field, slice(int(start or 0), int(stop) if stop else None)


def step_key(key: str) -> str:
    """The flat record key of a field of a step."""
    return key if key.startswith("steps/") else f"steps/{key}"


def check_fields(
    name: str,
    schema: Location,
    features: Mapping[str, FlatFeature],
    image_key: str,
    action_keys: Sequence[str],
    action_dims: Sequence[int] | None = None,
) -> None:
    """Raises ConfigError unless the camera and the action fields are among the `features` of a step of the dataset
    `name`, as the file `schema` says them, with these sizes."""
    cameras = [k for k, f in features.items() if f.camera]
    numbers = [k for k, f in features.items() if f.size and "action" in k]
    if step_key(image_key) not in features:
        raise ConfigError(
            f"{name}: no image {image_key!r} in {schema}; "
            f"images there: {listing(cameras)}{closest(image_key, cameras)}. Correct image_key."
        )
    chosen = features[step_key(image_key)]
    what = f"holds depths ({chosen.dtype}), which are not an image" if chosen.image else "is not an image"
    require(chosen.camera, f"{name}: {image_key!r} {what}; images: {listing(cameras)}. Correct image_key.")
    for n, key in enumerate(action_keys):
        field, part = field_slice(key)
        feature = features.get(step_key(field))
        if feature is not None and feature.encoding:
            raise ConfigError(
                f"{name}: {field!r} in {schema} is stored as bytes (encoding {feature.encoding!r}), "
                "which cannot be read; write the dataset again with encoding 'none' for it, or use another "
                "field."
            )
        if feature is None or not feature.size:
            raise ConfigError(
                f"{name}: no numeric field {field!r} in {schema}; "
                f"action fields there: {listing(numbers)}{closest(field, numbers)}. Correct action_keys."
            )
        size = len(range(feature.size)[part])
        if action_dims is not None and size != action_dims[n]:
            raise ConfigError(
                f"{name}: field {key!r} has {size} values per step in "
                f"{schema}, but {action_dims[n]} were expected. "
                "Correct action_dims, or read the version of the dataset it was written for."
            )


def listing(names: Sequence[str]) -> str:
    """Field names for a message, in the form that a user writes."""
    return ", ".join(n.removeprefix("steps/") for n in names)


def closest(name: str, names: Sequence[str]) -> str:
    """' (closest: x)' for a message, or nothing."""
    close = difflib.get_close_matches(step_key(name), names, n=1)
    return f" (closest: {close[0].removeprefix('steps/')})" if close else ""
