"""Our reading of RLDS records beside tfds's own decoder, feature by feature.

A record's features go once through our parser and once through `deserialize_example_np` of
tfds, which needs no TensorFlow; of images the stored bytes are compared. With TensorFlow the
record goes a third time through the decoder that RLDS pipelines run, pixels included.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.sources.rlds.example import parse_example
from data_pipelines.sources.rlds.images import JPEG_MAGIC, decode_image
from data_pipelines.sources.rlds.tfrecord import read_record
from tests.data_pipelines.shards import index_shard


@dataclass
class Tally:
    """What was compared, and every difference."""

    records: int = 0
    features: set[str] = field(default_factory=set)
    values: int = 0  # numbers and texts
    stored: int = 0  # images, as stored
    jpeg: int = 0  # images whose pixels were compared with TensorFlow's, by encoding
    png: int = 0
    differences: list[str] = field(default_factory=list)

    def add(self, other: Tally) -> None:
        for f in dataclasses.fields(self):
            mine, theirs = getattr(self, f.name), getattr(other, f.name)
            setattr(self, f.name, mine | theirs if isinstance(mine, set) else mine + theirs)


def compare_directory(directory: Path, tensorflow: Any = None) -> Tally:
    """Every feature of every record of every split of a version directory.

    `tensorflow` is the module, where there is one.
    """
    import tensorflow_datasets as tfds

    info = tfds.builder_from_directory(str(directory)).info
    encoded = _skip_images(info.features, tfds)
    tally = Tally()
    for name, split in sorted(info.splits.items()):
        for path, payload in _records(split.filepaths):
            where = f"{Path(path).name}[{tally.records}] of split {name}"
            ours = parse_example(payload)
            theirs = info.features.deserialize_example_np(payload, decoders=encoded)
            _compare(ours, _flatten(theirs), where, tally)
            if tensorflow is not None:
                _compare_decoded(ours, _flatten(info.features.deserialize_example(payload)), where, tally)
            tally.records += 1
    return tally


def _records(paths: list[str]) -> Iterator[tuple[str, bytes]]:
    for path in paths:
        index = index_shard(path)
        for offset, length in zip(index.offsets, index.lengths, strict=True):
            yield path, read_record(path, int(offset), int(length))


def _skip_images(feature: Any, tfds: Any) -> Any:
    """Decoders that leave images as they are stored."""
    if isinstance(feature, tfds.features.FeaturesDict):
        children = {name: _skip_images(child, tfds) for name, child in feature.items()}
        return {name: child for name, child in children.items() if child}
    if isinstance(feature, (tfds.features.Dataset, tfds.features.Sequence)):
        return _skip_images(feature.feature, tfds)
    return tfds.decode.SkipDecoding() if isinstance(feature, tfds.features.Image) else {}


def _flatten(value: Any, key: str = "") -> dict[str, list[Any]]:
    """Leaves by the flat key of a record, one entry per step (one in all, outside of steps)."""
    if isinstance(value, dict):
        found: dict[str, list[Any]] = {}
        for name, child in value.items():
            found |= _flatten(child, f"{key}/{name}" if key else name)
        return found
    if key == "steps":
        found = {}
        for step in value:
            for name, leaves in _flatten(step, "").items():
                found.setdefault(f"steps/{name}", []).extend(leaves)
        return found
    return [value] if not key else {key: [value.numpy() if hasattr(value, "numpy") else value]}


def _compare(ours: dict, theirs: dict[str, list[Any]], where: str, tally: Tally) -> None:
    """Everything but pixels: tfds's arrays, texts and stored images are what our parser found."""
    for key in sorted(set(ours) ^ set(theirs)):
        tally.differences.append(f"{where}: {key} is in {'our' if key in ours else 'their'} reading only")
    for key in sorted(set(ours) & set(theirs)):
        tally.features.add(key)
        mine, other = ours[key], theirs[key]
        if isinstance(mine, list):
            same = mine == [bytes(v) if not isinstance(v, str) else v.encode() for v in other]
            if mine and mine[0].startswith((JPEG_MAGIC, b"\x89PNG")):
                tally.stored += len(mine)
            else:
                tally.values += len(mine)
        else:
            stacked = np.stack([np.asarray(v) for v in other]) if other else np.zeros(0)
            same = mine.size == stacked.size and np.array_equal(
                mine.reshape(stacked.shape).astype(stacked.dtype), stacked, equal_nan=mine.dtype.kind == "f"
            )
            tally.values += mine.size
        if not same:
            tally.differences.append(f"{where}: {key} differs")


def _compare_decoded(ours: dict, theirs: dict[str, list[Any]], where: str, tally: Tally) -> None:
    """The same against TensorFlow's own decoder; images pixel by pixel."""
    pictures = {key for key, v in theirs.items() if np.ndim(v[0]) == 3 and np.asarray(v[0]).dtype == np.uint8}
    for key in sorted(pictures):
        for t, (data, image) in enumerate(zip(ours[key], theirs[key], strict=True)):
            tally.jpeg += data.startswith(JPEG_MAGIC)
            tally.png += not data.startswith(JPEG_MAGIC)
            if not np.array_equal(decode_image(data), image):
                tally.differences.append(f"{where}: pixels of {key} differ at step {t}")
    rest = {key: values for key, values in theirs.items() if key not in pictures}
    again = Tally()
    _compare({key: ours[key] for key in rest if key in ours}, rest, f"{where}, TensorFlow", again)
    tally.differences += again.differences
