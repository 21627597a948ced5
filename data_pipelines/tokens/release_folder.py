"""Token folders of the official release: raw arrays of one split of one dataset.

Owns their layout (reference section 5.2) and the check that the files agree with each other:

    metadata.json      num_images N, h, w, token_dtype, vocab_size or latent_channels, action_dim, name, hz
    video.bin          ids uint32 [N, h, w], or latents float16 [N, C, h, w]
    segment_ids.bin    int32 [N]: the episode of each frame, never decreasing
    actions/*.bin      float32 [N, A] each, joined in the order of their names

Files are mapped, not read. Knows nothing of the token store (see `import_tokens`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.json_file import read_object
from data_pipelines.names import quote
from hma_jax.config import ConfigError

ADVICE = "Download the folder again."
DTYPES = ("uint8", "uint16", "uint32", "int32", "float16", "float32")
MAX_COUNT = 10**9
"""Largest accepted number in metadata.json."""
FACTOR_VOCAB = 512
"""The released models read an id of 2^18 as two digits of this base."""


@dataclass(frozen=True)
class ReleaseFolder:
    """One opened folder. Arrays are views of the files."""

    path: Path
    name: str
    metadata: dict[str, Any]
    video: np.ndarray  # uint32 [N, h, w] or float16 [N, C, h, w]
    actions: np.ndarray  # float32 [N, A]
    bounds: np.ndarray  # int64 [episodes + 1]: where each episode begins, and N

    @property
    def channels(self) -> int:
        """Latent channels; 0: ids."""
        return self.video.shape[1] if self.video.ndim == 4 else 0

    @property
    def vocab_size(self) -> int:
        return 0 if self.channels else int(self.metadata["vocab_size"])

    @property
    def encoder(self) -> str:
        """The encoder that made the tokens, as far as the folder says."""
        kind, of = self.metadata.get("encoder_type"), self.metadata.get("encoder_name_or_path")
        words = " ".join(str(word) for word in (kind, Path(str(of)).name if of else None) if word)
        return f"{words or 'unknown encoder'} (release folder)"

    def __len__(self) -> int:
        """Number of episodes."""
        return len(self.bounds) - 1


def open_folder(path: str | Path) -> ReleaseFolder:
    """Opens a folder. Raises DataError, naming the file and the sizes, if its files do not fit each other."""
    path = Path(path)
    meta = _metadata(path / "metadata.json")
    frames, shape, dtype = _video_shape(path, meta)
    video = _map(path / "video.bin", dtype, shape, "num_images, h and w of metadata.json")
    segments = _map(path / "segment_ids.bin", np.int32, (frames,), "num_images of metadata.json")
    parts = sorted((path / "actions").glob("*.bin"))
    if not parts:
        raise DataError(f"{path / 'actions'}: no *.bin in it. {ADVICE}")
    actions = np.concatenate([_actions(part, frames) for part in parts], axis=1)
    if meta.get("action_dim") is not None and actions.shape[1] != meta["action_dim"]:
        raise DataError(
            f"{path / 'actions'}: {actions.shape[1]} values per frame, but metadata.json says action_dim "
            f"{meta['action_dim']}. {ADVICE}"
        )
    falls = segments[1:] < segments[:-1]
    if falls.any():
        frame = int(np.flatnonzero(falls)[0])
        raise DataError(
            f"{path / 'segment_ids.bin'}: the episode number falls from {segments[frame]} to {segments[frame + 1]} at "
            f"frame {frame + 1}, but it must not decrease. {ADVICE}"
        )
    bounds = np.concatenate([[0], np.flatnonzero(segments[1:] != segments[:-1]) + 1, [frames]]).astype(np.int64)
    return ReleaseFolder(path, str(meta.get("name") or path.name), meta, video, actions, bounds)


def _metadata(path: Path) -> dict[str, Any]:
    missing = "give a folder of the release, with video.bin beside it."
    meta = read_object(path, if_missing=missing, advice=ADVICE)
    for field in ("num_images", "h", "w", "latent_channels", "action_dim"):
        value = meta.get(field)
        if value is None and field in ("latent_channels", "action_dim"):
            continue
        if type(value) is not int or not 1 <= value <= MAX_COUNT:
            raise DataError(f"{path}: {field} is {quote(value)}, not a positive number. {ADVICE}")
    if meta.get("token_dtype", "uint32") not in DTYPES:
        raise DataError(
            f"{path}: token_dtype is {quote(meta['token_dtype'])}, but must be one of {', '.join(DTYPES)}. {ADVICE}"
        )
    return meta


def _video_shape(path: Path, meta: dict[str, Any]) -> tuple[int, tuple[int, ...], np.dtype]:
    """(N, shape, dtype). Raw images are refused: they are not tokens."""
    frames, grid, channels = meta["num_images"], (meta["h"], meta["w"]), meta.get("latent_channels")
    dtype = np.dtype(meta.get("token_dtype", "float16" if channels else "uint32"))
    if grid[0] != grid[1]:
        raise DataError(f"{path / 'metadata.json'}: a grid of {grid[0]} x {grid[1]}; only square ones can be read.")
    if dtype.kind == "f":
        return frames, (frames, channels or 4, *grid), dtype
    if dtype == np.uint8:
        raise ConfigError(
            f"{path}: it holds raw images (token_dtype uint8), not tokens; give the folder of ids or latents."
        )
    vocab_size = meta.get("vocab_size")
    if type(vocab_size) is not int or not 2 <= vocab_size <= 2**32:
        raise DataError(f"{path / 'metadata.json'}: vocab_size is {quote(vocab_size)}. {ADVICE}")
    return frames, (frames, *grid), dtype


def _map(path: Path, dtype: Any, shape: tuple[int, ...], because: str) -> np.ndarray:
    expected = math.prod(shape) * np.dtype(dtype).itemsize
    try:
        found = path.stat().st_size
        if found != expected:
            raise DataError(
                f"{path}: it has {found} bytes, but by {because} it should have {expected} ({np.dtype(dtype)} "
                f"{list(shape)}). {ADVICE}"
            )
        return np.memmap(path, dtype, "r", shape=shape)
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror}). {ADVICE}") from error


def _actions(path: Path, frames: int) -> np.ndarray:
    size = path.stat().st_size if path.is_file() else 0
    if not size or size % (4 * frames):
        raise DataError(
            f"{path}: its {size} bytes are not an array float32 [{frames}, A], with num_images of metadata.json as "
            f"first size. {ADVICE}"
        )
    return np.memmap(path, np.float32, "r", shape=(frames, size // (4 * frames)))
