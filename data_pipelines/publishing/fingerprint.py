"""The fingerprint that our writers store in an RLDS directory, and the check whether the directory is complete."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

FINGERPRINT = "fingerprint"
"""Its key in metadata.json."""


def read_metadata(directory: Path) -> dict[str, Any]:
    """The contents of metadata.json; empty if it is missing or cannot be read."""
    try:
        values = json.loads((directory / "metadata.json").read_text())
    except (OSError, ValueError):
        return {}
    return values if isinstance(values, dict) else {}


def shard_lengths(directory: Path, split: str | None = None) -> list[int]:
    """Records in each shard of one split, or of all, from dataset_info.json; empty if it cannot be read."""
    try:
        splits = json.loads((directory / "dataset_info.json").read_text())["splits"]
        return [int(n) for s in splits if split in (None, s["name"]) for n in s["shardLengths"]]
    except (OSError, ValueError, KeyError, TypeError):
        return []


def is_complete(directory: Path, fingerprint: str) -> bool:
    """Whether `directory` holds a dataset with this fingerprint and all of its shards."""
    shards = len(shard_lengths(directory))
    found = len(list(directory.glob("*.tfrecord-*")))
    return read_metadata(directory).get(FINGERPRINT) == fingerprint and found == shards > 0
