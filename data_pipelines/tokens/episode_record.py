"""One tokenised episode as bytes: a flat layout that is read without parsing or copying.

Owns the layout of a record of the token store, nothing of files.

    int32 [10]   header: version, episode, success (-1 unknown, 0, 1), stored frames F,
                 tokens per frame S, native steps N, action dim A, bytes per id or value,
                 image size (0: no frames), latent channels C (0: tokens are ids)
    float32 [N, A] actions, then tokens [F, S] or [F, S, C], then uint8 [F, size, size, 3] frames if any
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

VERSION = 1
HEADER = 10  # int32 entries; a multiple of the widest item's alignment


@dataclass(frozen=True)
class StoredEpisode:
    """One episode. Every array is a read-only view into the record's bytes."""

    episode: int  # number in the source split, counting damaged ones
    success: bool | None
    tokens: np.ndarray  # uint16 or uint32 [F, S] or float16 [F, S, C], every frame_step-th native frame
    actions: np.ndarray  # float32 [N, A], native rate, raw units
    frames: np.ndarray | None  # uint8 [F, size, size, 3]


def token_dtype(vocab_size: int, channels: int = 0) -> np.dtype:
    """The smallest of uint16 and uint32 that holds every id; float16 for latents."""
    if channels:
        return np.dtype(np.float16)
    return np.dtype(np.uint16 if vocab_size <= 1 << 16 else np.uint32)


def encode_episode(item: StoredEpisode) -> bytes:
    """The record of `item`; equal items give equal bytes."""
    size = 0 if item.frames is None else item.frames.shape[1]
    success = -1 if item.success is None else int(item.success)
    frames, tokens, *channels = item.tokens.shape
    header = [VERSION, item.episode, success, frames, tokens, *item.actions.shape]
    header += [item.tokens.dtype.itemsize, size, *(channels or [0])]
    parts = [
        np.asarray(header, "<i4"),
        np.ascontiguousarray(item.actions, "<f4"),
        np.ascontiguousarray(item.tokens),
    ]
    if item.frames is not None:
        parts.append(np.ascontiguousarray(item.frames, np.uint8))
    return b"".join(parts)  # this copies them once


def decode_episode(data: bytes) -> StoredEpisode:
    """Inverse of `encode_episode`. Raises ValueError for bytes of another layout or length."""
    if len(data) < 4 * HEADER:
        raise ValueError(f"{len(data)} bytes are not an episode record")
    header = np.frombuffer(data, "<i4", HEADER).tolist()
    version, episode, success, frames, tokens, steps, action_dim, width, size, channels = header
    if version != VERSION:
        raise ValueError(f"episode record of version {version}; this program reads {VERSION}")
    shape = (frames, tokens, channels) if channels else (frames, tokens)
    at_tokens = 4 * HEADER + 4 * steps * action_dim
    at_frames = at_tokens + width * math.prod(shape)
    if len(data) != at_frames + frames * size * size * 3:
        raise ValueError(f"episode record of {len(data)} bytes does not match its header")
    dtype = f"<{'f' if channels else 'u'}{width}"
    pixels = np.frombuffer(data, np.uint8, offset=at_frames).reshape(frames, size, size, 3)
    return StoredEpisode(
        episode=episode,
        success=None if success < 0 else bool(success),
        tokens=np.frombuffer(data, dtype, math.prod(shape), at_tokens).reshape(shape),
        actions=np.frombuffer(data, "<f4", steps * action_dim, 4 * HEADER).reshape(steps, action_dim),
        frames=pixels if size else None,
    )
