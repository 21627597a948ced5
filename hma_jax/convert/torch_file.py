"""Reads a plain state dict from a file that torch saved, without torch and without running code.

Such a file is a zip: `data.pkl` describes the tensors, `data/KEY` holds their elements. A pickle is a program. This
reader knows the few names that a state dict of tensors needs, and refuses all others, by name, before anything is
called. In the checkpoint of a whole training run the state dict is one entry among others; everything else that a
trainer keeps there is skipped without being built.
"""

from __future__ import annotations

import collections
import io
import pickle
import zipfile
from dataclasses import dataclass
from math import prod
from pathlib import Path, PurePosixPath
from typing import Any

import ml_dtypes
import numpy as np

from hma_jax.config import ConfigError, require
from hma_jax.convert.tensors import Stored
from hma_jax.runtime.arrays import UNREADABLE

STORAGES = {
    "DoubleStorage": np.float64,
    "FloatStorage": np.float32,
    "HalfStorage": np.float16,
    "BFloat16Storage": ml_dtypes.bfloat16,
    "LongStorage": np.int64,
    "IntStorage": np.int32,
    "ShortStorage": np.int16,
    "CharStorage": np.int8,
    "ByteStorage": np.uint8,
    "BoolStorage": np.bool_,
}

LARGEST = 2**26
"""The most bytes of a description of tensors: more than any model needs."""


@dataclass(frozen=True, slots=True)
class _StorageType:
    dtype: np.dtype


@dataclass(frozen=True, slots=True)
class _Storage:
    dtype: np.dtype
    key: str


class _TakesItems(type):
    def __setitem__(cls, key: Any, value: Any) -> None:
        del key, value


class _Ignored(metaclass=_TakesItems):
    """Stands for any class of a trainer and for its objects. An instance of it is again this class, because it may
    itself be a class (`getattr` gives nested ones), and whatever else a pickle does to it has no effect."""

    def __new__(cls, *args: Any, **kwargs: Any) -> type[_Ignored]:
        del args, kwargs
        return cls

    @classmethod
    def __setstate__(cls, state: Any) -> None:
        del state

    @classmethod
    def append(cls, item: Any) -> None:
        del item

    @classmethod
    def extend(cls, items: Any) -> None:
        del items


class _Reader(pickle._Unpickler):
    """Knows ordered dictionaries, storages, and how a tensor is made from a storage. In the file of a `whole` training
    run everything else is skipped.

    It is based on the unpickler in Python: the one in C allocates room for as many objects as a number in the file
    says.
    """

    def __init__(self, path: Path, archive: zipfile.ZipFile, root: str, whole: bool):
        size = archive.getinfo(f"{root}data.pkl").file_size
        if size > LARGEST:
            raise pickle.UnpicklingError(f"{size:,} bytes, more than {LARGEST:,}")
        super().__init__(io.BytesIO(archive.read(f"{root}data.pkl")))  # whole: its checksum is verified first
        self.path, self.root, self.whole = path, root, whole
        self.bytes = {info.filename: info.file_size for info in archive.infolist()}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return self._rebuild
        if module == "torch" and name in STORAGES:
            return _StorageType(np.dtype(STORAGES[name]))
        if self.whole:
            return _Ignored
        raise ConfigError(
            f"{self.path} needs {module}.{name}, which a plain state dict of tensors does not; for safety it is not "
            "read. Save only the tensors, best as model.safetensors"
        )

    def persistent_load(self, pid: Any) -> _Storage | type[_Ignored]:
        kind, storage_type, key, _, _ = pid
        if storage_type is _Ignored:
            return _Ignored
        if kind != "storage" or not isinstance(storage_type, _StorageType) or not isinstance(key, str):
            raise pickle.UnpicklingError(f"unknown kind of data {kind!r}")
        return _Storage(storage_type.dtype, key)

    def _rebuild(
        self,
        storage: _Storage | type[_Ignored],
        offset: int,
        shape: tuple[int, ...],
        stride: tuple[int, ...],
        *rest: Any,
    ) -> Stored | type[_Ignored]:
        del rest  # gradients and hooks
        if storage is _Ignored:
            return _Ignored
        numbers = (offset, *shape, *stride)
        if not all(type(n) is int and n >= 0 for n in numbers) or len(shape) != len(stride):
            raise pickle.UnpicklingError(f"a tensor of shape {shape} and strides {stride} from {offset}")
        entry, size = f"{self.root}data/{storage.key}", storage.dtype.itemsize
        last = offset + sum((n - 1) * s for n, s in zip(shape, stride, strict=True))
        if prod(shape) and max(prod(shape), last + 1) * size > self.bytes[entry]:
            raise pickle.UnpicklingError(f"a tensor of more elements than {entry} has")

        def read() -> np.ndarray:
            if not prod(shape):
                return np.zeros(shape, storage.dtype)
            try:
                with zipfile.ZipFile(self.path) as archive:
                    elements = np.frombuffer(archive.read(entry), storage.dtype)[offset:]
            except UNREADABLE as error:
                raise ConfigError(f"{self.path}: {entry} is damaged ({error}); download the file again") from error
            strides = [s * size for s in stride]
            return np.lib.stride_tricks.as_strided(elements, shape, strides, writeable=False).copy()

        return Stored(tuple(shape), storage.dtype, read)


def read_torch(path: Path, within: str | None = None) -> dict[str, Stored]:
    """name -> tensor. Raises ConfigError, which names what the file contains, for anything but a plain state dict.

    `within` is the entry that holds the state dict if the file is a checkpoint of a training run.
    """
    advice = "; save it with torch.save(model.state_dict(), ...) or as model.safetensors"
    try:
        with zipfile.ZipFile(path) as archive:
            pickles = [name for name in archive.namelist() if PurePosixPath(name).name == "data.pkl"]
            require(len(pickles) == 1, f"{path} is a zip file without a torch state dict{advice}")
            root = pickles[0].removesuffix("data.pkl")
            if f"{root}byteorder" in archive.namelist():
                little = archive.read(f"{root}byteorder") == b"little"
                require(little, f"{path}: its byte order is not little-endian; save it on a little-endian machine")
            state = _Reader(path, archive, root, whole=within is not None).load()
    except zipfile.BadZipFile as error:
        raise ConfigError(
            f"{path}: not a readable zip file ({error}); it is damaged or was saved by torch before 1.6{advice}"
        ) from error
    except ConfigError:
        raise
    except Exception as error:  # a damaged pickle can raise anything
        raise ConfigError(f"{path}: its description of tensors cannot be read ({error}){advice}") from error
    if within is not None and isinstance(state, dict) and isinstance(state.get(within), dict):
        state = state[within]
    entries = state.items() if isinstance(state, dict) else [(type(state).__name__, state)]
    others = [str(name) for name, tensor in entries if not (isinstance(name, str) and isinstance(tensor, Stored))]
    require(not others, f"{path} contains something other than names and tensors ({', '.join(others[:3])}){advice}")
    return dict(state)
