"""The fingerprint inside an RLDS directory that we made, and whether it is all there."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

FINGERPRINT = "fingerprint"
"""Its key in metadata.json, where every writer puts it."""


def read_metadata(directory: Path) -> dict[str, Any]:
    """What the writer said of the dataset; empty if it said nothing that can be read."""
    try:
        values = json.loads((directory / "metadata.json").read_text())
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def shard_lengths(directory: Path, split: str | None = None) -> list[int]:
    """Records of every shard, of one split or of all, as dataset_info.json says; empty if it cannot be read."""
    try:
        splits = json.loads((directory / "dataset_info.json").read_text())["splits"]
        return [int(n) for s in splits if split in (None, s["name"]) for n in s["shardLengths"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def is_complete(directory: Path, mark: str) -> bool:
    """Whether `directory` holds a dataset with this fingerprint and all of its shards."""
    shards = len(shard_lengths(directory))
    found = len(list(directory.glob("*.tfrecord-*")))
    return read_metadata(directory).get(FINGERPRINT) == mark and found == shards > 0
