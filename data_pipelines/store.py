"""The token store: tokenised episodes of many datasets, with random access.

Owns `<store>/<dataset>/{train,val}.array_record` and the reading of them. Knows nothing of
windows or mixtures; `tokenize_job` writes it.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path

from array_record.python import array_record_module

from data_pipelines.episode_record import StoredEpisode, decode_episode
from data_pipelines.errors import DataError
from data_pipelines.manifest import FILE, Manifest, load_manifest
from hma_jax.config import ConfigError, stable_hash
from hma_jax.embodiments import EmbodimentTable

READ_OPTIONS = "readahead_buffer_size:0,max_parallelism:0"  # for random access


class TokenStore:
    """Opens every dataset under `root`. Thread-safe; pickles (files are reopened).

    Raises DataError if `root` is no store or a manifest is damaged.
    """

    def __init__(self, root: str | Path):
        self.root = Path(root)
        if not self.root.is_dir():
            raise DataError(f"{self.root}: no such token store. Tokenise datasets into it first.")
        found = sorted(p.parent for p in self.root.glob(f"*/{FILE}") if not p.parent.name.startswith("."))
        if not found:
            raise DataError(f"{self.root}: no dataset in this token store. Tokenise datasets into it first.")
        self._manifests = {directory.name: load_manifest(directory / FILE) for directory in found}
        self._open_lock = threading.Lock()
        self._readers: dict[tuple[str, str], array_record_module.ArrayRecordReader] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Datasets, sorted."""
        return tuple(self._manifests)

    def manifest(self, name: str) -> Manifest:
        if name not in self._manifests:
            raise ConfigError(
                f"dataset {name!r} is not in the token store {self.root}; it has {', '.join(self.names)}. "
                "Tokenise it first."
            )
        return self._manifests[name]

    def hash(self, names: Sequence[str] | None = None) -> str:
        """Identity of the data: over the manifests of `names`, or of all datasets, in any order."""
        chosen = sorted(self.names if names is None else names)
        return stable_hash({name: self.manifest(name).hash() for name in chosen})

    def embodiment_table(self, names: Sequence[str]) -> EmbodimentTable:
        """The table of `names`, in that order."""
        return EmbodimentTable(tuple(self.manifest(name).embodiment() for name in names))

    def episode(self, name: str, split: str, i: int) -> StoredEpisode:
        """Episode `i` of a split, in store order. Raises DataError for a damaged record."""
        reader = self._reader(name, split)
        try:
            return decode_episode(reader.read([i])[0])
        except (RuntimeError, ValueError) as error:
            path = self._path(name, split)
            raise DataError(
                f"{path}: episode {i} cannot be read: {error}. "
                f"Remove {path.parent} and tokenise the dataset again."
            ) from error

    def check_table(self, table: EmbodimentTable, names: Sequence[str]) -> None:
        """Raises ConfigError unless `table` has each of `names` with the action layout stored here."""
        for name in names:
            here, there = self.manifest(name).embodiment(), table.entries[table.index(name)]
            if (here.action_dim, here.stride) != (there.action_dim, there.stride):
                raise ConfigError(
                    f"{name}: the token store has {here.action_dim} action values at stride {here.stride}, "
                    f"the embodiment table {there.action_dim} at stride {there.stride}. "
                    "Use the store the table was made from."
                )

    def _path(self, name: str, split: str) -> Path:
        return self.root / name / f"{split}.array_record"

    def _reader(self, name: str, split: str) -> array_record_module.ArrayRecordReader:
        key = (name, split)
        reader = self._readers.get(key)
        if reader is None:
            with self._open_lock:
                reader = self._readers.get(key) or self._open(name, split)
                self._readers[key] = reader
        return reader

    def _open(self, name: str, split: str) -> array_record_module.ArrayRecordReader:
        path, expected = self._path(name, split), len(self.manifest(name).split(split).episodes)
        advice = f"Remove {path.parent} and tokenise the dataset again."
        if not path.is_file():
            raise DataError(f"{path}: the file is missing from the token store. {advice}")
        try:
            reader = array_record_module.ArrayRecordReader(str(path), options=READ_OPTIONS)
        except RuntimeError as error:
            raise DataError(f"{path}: not a readable ArrayRecord file ({error}). {advice}") from error
        if reader.num_records() != expected:
            raise DataError(
                f"{path}: {reader.num_records()} episodes, but the manifest says {expected}: "
                f"the file is damaged. {advice}"
            )
        return reader

    def __getstate__(self) -> dict:
        return {"root": self.root, "_manifests": self._manifests}

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state, _open_lock=threading.Lock(), _readers={})
