"""Reads a manifest from its files."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from data_pipelines.columns import Column, Columns
from data_pipelines.errors import DataError
from data_pipelines.names import truncate
from data_pipelines.sources.rlds.location import retry
from data_pipelines.tokens.manifest import COLUMNS_FILE, EPISODE_COLUMNS, FORMAT_VERSION, SPLITS, Manifest
from hma_jax.config import ConfigError
from hma_jax.config.json import from_dict


def load_manifest(path: Path) -> Manifest:
    """Reads a manifest. Raises DataError if it is missing, damaged or of another format, UnreachableError if the disk
    fails."""
    advice = "Remove the dataset from the store and tokenise it again."
    try:
        values = json.loads(retry(path, path.read_bytes))
        if values.get("format") != FORMAT_VERSION:
            raise DataError(
                f"{path}: manifest format {values.get('format')!r}, but only {FORMAT_VERSION} can be read. {advice}"
            )
        columns_by_split = _from_file(path, values)
        manifest = from_dict(Manifest, values)
        manifest.check()
        return replace(manifest, **{s: replace(manifest.split(s), **columns_by_split[s]) for s in SPLITS})
    except FileNotFoundError as error:
        raise DataError(f"{path}: the manifest cannot be read ({error.strerror}). {advice}") from error
    except (ValueError, AttributeError, TypeError, KeyError, OverflowError, RecursionError) as error:
        if isinstance(error, ConfigError):
            raise DataError(f"{path}: not a manifest of this program: {truncate(error)}. {advice}") from error
        raise DataError(f"{path}: the manifest is damaged ({truncate(error)}). {advice}") from error


EpisodeColumns = dict[str, dict[str, Sequence[int]]]
"""Columns with an entry per episode, by split and name."""


def _from_file(path: Path, values: dict[str, Any]) -> EpisodeColumns:
    """The columns in the file beside a manifest, which describes them."""
    stated = values.pop("columns")
    file = path.with_name(COLUMNS_FILE)
    columns = retry(file, lambda: Columns(file))
    columns_by_split = {s: {name: Column.of(columns, f"{s}.{name}") for name in EPISODE_COLUMNS} for s in SPLITS}
    for split, by_name in columns_by_split.items():
        for name, column in by_name.items():
            if stated[f"{split}.{name}"] != column.digest():
                raise ValueError(f"{columns.path.name} does not belong to it")
            if len(column) != sum(values[split]["parts"]):
                raise ValueError(f"{split}.{name} has {len(column)} entries, not one per episode")
    return {s: {n: c if len(c) else () for n, c in by_name.items()} for s, by_name in columns_by_split.items()}
