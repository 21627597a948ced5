"""Named tensors in files, read one at a time: safetensors, and torch's state dicts (`torch_file`)."""

from __future__ import annotations

import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import ml_dtypes
import numpy as np
import safetensors.numpy
from safetensors import SafetensorError, safe_open

from hma_jax.config import ConfigError, require

DTYPES = {
    "F64": np.dtype(np.float64),
    "F32": np.dtype(np.float32),
    "F16": np.dtype(np.float16),
    "BF16": np.dtype(ml_dtypes.bfloat16),
    "I64": np.dtype(np.int64),
    "I32": np.dtype(np.int32),
    "I16": np.dtype(np.int16),
    "I8": np.dtype(np.int8),
    "U8": np.dtype(np.uint8),
    "BOOL": np.dtype(np.bool_),
}
"""safetensors' names of the element types that a checkpoint may have."""

FLOATS = ("float32", "float16", "bfloat16")
"""Element types of weights: all their values are also float32 values."""


@dataclass(frozen=True)
class Stored:
    """One tensor of a file. `read` fetches its values."""

    shape: tuple[int, ...]
    dtype: np.dtype
    read: Callable[[], np.ndarray]


MOST_NAMED = 10
"""The most tensors that a message names; for more it gives only the number."""


def check_tensors(
    want: Mapping[str, tuple[int, ...]],
    tensors: Mapping[str, Stored],
    where: str,
    types: tuple[str, ...] = FLOATS,
) -> None:
    """Raises ConfigError, which names (the first few) tensors of the file or directory `where` that are missing, not
    expected, of another shape, or not of one of `types`."""
    found = {name: tensor.shape for name, tensor in tensors.items()}
    wrong = {
        "missing": [f"{n} {want[n]}" for n in want if n not in found],
        "not expected": [f"{n} {found[n]}" for n in found if n not in want],
        "with another shape": [
            f"{n}: expected {want[n]}, found {found[n]}" for n in want if n in found and found[n] != want[n]
        ],
    }
    lines = [
        f"\n  {len(names)} {problem}: " + "; ".join(names[:MOST_NAMED]) + ("; ..." if len(names) > MOST_NAMED else "")
        for problem, names in wrong.items()
        if names
    ]
    if lines:
        raise ConfigError(f"{where}: the tensors differ from those that the description requires:" + "".join(lines))
    foreign = [f"{name} ({tensor.dtype.name})" for name, tensor in tensors.items() if tensor.dtype.name not in types]
    require(not foreign, f"{where}: tensors that are not of type {', '.join(types)}: {', '.join(foreign[:MOST_NAMED])}")


def read_finite(tensors: Mapping[str, Stored], name: str, where: str) -> np.ndarray:
    """The values of one tensor of the file or directory `where`. Raises ConfigError if some are not finite."""
    values = tensors[name].read()
    require(
        bool(np.isfinite(values).all()),
        f"{where}: {name} contains values that are not finite: the file is damaged, or was saved after training had "
        "diverged; download it again, or use an earlier checkpoint",
    )
    return values


def read_safetensors(path: Path) -> dict[str, Stored]:
    """name -> tensor. Raises ConfigError for a file that is damaged or of another format."""

    def stored(name: str) -> Stored:
        entry = file.get_slice(name)
        kind = entry.get_dtype()
        if kind not in DTYPES:
            raise ConfigError(f"{path}: {name} has elements of type {kind}, which are not supported")
        return Stored(tuple(entry.get_shape()), DTYPES[kind], lambda: file.get_tensor(name))

    try:
        file = safe_open(path, framework="np")
        return {name: stored(name) for name in file.keys()}  # noqa: SIM118 (it is no dictionary)
    except SafetensorError as error:
        raise ConfigError(f"{path}: not a readable safetensors file ({error}); download it again") from error


def write_safetensors(path: Path, tensors: Mapping[str, np.ndarray]) -> None:
    """Writes the tensors, as contiguous copies where needed; the bytes of the values do not change. Raises OSError.

    The file states PyTorch as its format, as files of the Hugging Face libraries do: some of these refuse files without
    it.
    """
    dense = {name: np.ascontiguousarray(x).reshape(x.shape) for name, x in tensors.items()}
    # safetensors replaces our file by one that only its owner may read; it then gets the mode that the umask gave ours.
    path.touch()
    mode = stat.S_IMODE(path.stat().st_mode)
    try:
        safetensors.numpy.save_file(dense, path, metadata={"format": "pt"})
    except SafetensorError as error:
        raise OSError(f"{path} cannot be written: {error}; check the space on its disk") from error
    path.chmod(mode)
