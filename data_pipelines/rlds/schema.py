"""The schema of an RLDS directory: where its version lies, what a step holds, which shards.

Owns what is read through tfds, which is metadata only. Reads no record. The metadata of a
remote directory is copied aside for tfds, which then needs to know nothing of remote stores.
"""

from __future__ import annotations

import difflib
import json
import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.rlds.location import is_remote, locate
from hma_jax.config import require

if TYPE_CHECKING:
    from data_pipelines.rlds.location import Location

METADATA = (".json", ".txt")
"""How the files end that tfds writes beside the shards."""


@dataclass(frozen=True)
class FlatFeature:
    """A field of the schema: an image, or `size` numbers per step (0: text and the like)."""

    image: bool
    size: int


@dataclass(frozen=True)
class SplitMetadata:
    """What tfds recorded about a split, or several: flat schema, shard files with their record counts and splits."""

    name: str
    version: str
    features: dict[str, FlatFeature]
    shards: list[Location]
    shard_lengths: list[int]
    shard_splits: list[str]


def resolve_version(directory: str | Location) -> Location:
    """The version directory: `directory` itself or its newest version."""
    directory = locate(directory)
    if not directory.is_dir():
        raise DataError(f"{directory}: no such directory. Give the path of an RLDS dataset.")
    if (directory / "dataset_info.json").is_file():
        return directory
    versions = [
        d
        for d in directory.iterdir()
        if re.fullmatch(r"\d+\.\d+\.\d+", d.name) and (d / "dataset_info.json").is_file()
    ]
    if versions:
        return max(versions, key=lambda d: tuple(map(int, d.name.split("."))))
    entries = sorted(p.name for p in directory.iterdir())
    raise DataError(
        f"{directory}: no RLDS dataset: neither it nor a version directory such as 1.0.0 in it has a "
        f"dataset_info.json (it holds {listing(entries[:6]) or 'nothing'}). "
        "Give the directory that tfds wrote, <name> or <name>/<version>."
    )


def dataset_name(directory: str | Location) -> str:
    """The name that an RLDS directory gives itself, read from dataset_info.json alone.

    Raises DataError for a directory that is none.
    """
    path = resolve_version(directory) / "dataset_info.json"
    try:
        return str(json.loads(path.read_text())["name"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        message = f"{path}: it does not name the dataset ({error}). Restore it as tfds wrote it."
        raise DataError(message) from error


def read_metadata(directory: Location, split: str) -> SplitMetadata:
    """Metadata of one split, or of several one after the other as in "train+val".

    Raises DataError for damaged files, ConfigError for an unknown split.
    """
    # Imported here: it takes half a second that readers of a token store need not pay.
    import tensorflow_datasets as tfds
    from google.protobuf.json_format import ParseError

    try:
        with _on_disk(directory) as here:
            info = tfds.builder_from_directory(str(here)).info
        file_format = json.loads((directory / "dataset_info.json").read_text()).get("fileFormat", "tfrecord")
    except (OSError, ValueError, KeyError, ParseError) as error:
        raise DataError(
            f"{directory}: dataset_info.json or features.json is missing or damaged ({error}). "
            "Restore both as tfds wrote them."
        ) from error
    if file_format != "tfrecord":
        raise DataError(f"{directory}: fileFormat is {file_format!r}; only 'tfrecord' can be read.")
    parts = split.split("+")
    for part in parts:
        require(
            part in info.splits,
            f"{info.name}: no split {part!r} in {directory}; splits there: {listing(sorted(info.splits))}",
        )
    return SplitMetadata(
        name=info.name,
        version=str(info.version),
        features=_flatten(info.features, ""),
        shards=[directory / Path(p).name for part in parts for p in info.splits[part].filepaths],
        shard_lengths=[n for part in parts for n in info.splits[part].shard_lengths],
        shard_splits=[part for part in parts for _ in info.splits[part].shard_lengths],
    )


@contextmanager
def _on_disk(directory: Location) -> Iterator[Location]:
    """`directory`, or a copy of its metadata if it is remote."""
    if not is_remote(directory):
        yield directory
        return
    copy = Path(tempfile.mkdtemp(prefix="hma-metadata-"))
    try:
        for file in directory.iterdir():
            if file.name.endswith(METADATA):
                (copy / file.name).write_bytes(file.read_bytes())
        yield copy
    finally:
        shutil.rmtree(copy)


def _flatten(feature, key: str) -> dict[str, FlatFeature]:
    """Fields by the flat key under which tfds stores them in a record."""
    import tensorflow_datasets as tfds

    if isinstance(feature, tfds.features.FeaturesDict):
        flat = {}
        for name, child in feature.items():
            flat |= _flatten(child, f"{key}/{name}" if key else name)
        return flat
    if isinstance(feature, tfds.features.Image):
        return {key: FlatFeature(image=True, size=0)}
    if isinstance(feature, (tfds.features.Dataset, tfds.features.Sequence)):
        return _flatten(feature.feature, key)
    spec = feature.get_tensor_info()
    numeric = not isinstance(spec, dict) and np.dtype(spec.np_dtype).kind in "fiub" and None not in spec.shape
    return {key: FlatFeature(image=False, size=int(np.prod(spec.shape)) if numeric else 0)}


def field_slice(key: str) -> tuple[str, slice]:
    """The field of an action key, and which of its values: `action[:7]` is ("action", slice(0, 7))."""
    match = re.fullmatch(r"(.+)\[(\d*):(\d*)\]", key)
    if not match:
        return key, slice(0, None)
    field, start, stop = match.groups()
    return field, slice(int(start or 0), int(stop) if stop else None)


def step_key(key: str) -> str:
    """The flat record key of a field of a step."""
    return key if key.startswith("steps/") else f"steps/{key}"


def listing(names: Sequence[str]) -> str:
    """Names for a message, as a user writes them."""
    return ", ".join(n.removeprefix("steps/") for n in names)


def closest(name: str, names: Sequence[str]) -> str:
    """' (closest: x)' for a message, or nothing."""
    close = difflib.get_close_matches(step_key(name), names, n=1)
    return f" (closest: {close[0].removeprefix('steps/')})" if close else ""
