"""Indices of TFRecord files that are not damaged."""

from __future__ import annotations

from typing import TYPE_CHECKING

from data_pipelines.sources.rlds.tfrecord import ShardIndex, scan_shard

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location


def index_shard(path: str | Location) -> ShardIndex:
    """Of every record. Raises the CorruptRecordError that `scan_shard` returns."""
    index, damage = scan_shard(path)
    if damage is not None:
        raise damage
    return index
