"""Attention as the model calls it, and the table of the backends that compute it.

Queries, keys and values are [B, T, P, H, I]: T frames of P tokens with H heads of width I. All backends
compute softmax(scale q.k) v, with logits and softmax in float32, and agree with `plain` up to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax

from hma_jax.config import require
from hma_jax.kernels import cpu, cudnn, plain, splash
from hma_jax.runtime.devices import default_device

Within = Callable[[jax.Array, float], jax.Array]
"""within(qkv, scale): qkv [B, T, P, 3, H, I] -> [B, T, P, H, I]; a token sees all tokens of its frame."""

OverTime = Callable[[jax.Array, jax.Array, float], jax.Array]
"""over_time(qkv, visible, scale): qkv [B, T, P, 3, H, I] -> [B, T, P, H, I]; a token sees its own position in
the frames that `visible` (bool [T, T], or [B, T, T] where examples differ) allows."""

OverCache = Callable[[jax.Array, jax.Array, jax.Array, jax.Array, float], jax.Array]
"""over_cache(qkv, keys, values, visible, scale): as `over_time`, with keys and values [B, T_past, P, H, I] of
earlier frames before those of `qkv`; `visible` is bool [T, T_past + T]."""


class Backend(NamedTuple):
    within: Within
    over_time: OverTime
    over_cache: OverCache


BACKENDS = {
    "plain": Backend(plain.within, plain.over_time, plain.over_cache),
    "cpu": Backend(cpu.within, plain.over_time, cpu.over_cache),
    "cudnn": Backend(cudnn.within, plain.over_time, plain.over_cache),
    "splash": Backend(splash.within, plain.over_time, plain.over_cache),
}

OF_PLATFORM = {"cpu": "cpu", "gpu": "cudnn", "cuda": "cudnn", "tpu": "splash"}

ONLY_ON = {"cudnn": "an NVIDIA GPU", "splash": "a TPU"}
"""Backends whose kernel runs on one platform only."""


def backend_of(platform: str) -> str:
    """The backend that `auto` stands for on `platform`, a platform by JAX's name."""
    return OF_PLATFORM.get(platform, "plain")


def find_backend(name: str) -> Backend:
    """The backend called `name`; `auto` is the backend for the platform that is compiled for: that of the mesh, or else
    of the default device. Raises ConfigError for an unknown name, and for a kernel that does not run on the
    platform."""
    mesh_device = jax.sharding.get_abstract_mesh().abstract_device
    platform = (mesh_device or default_device()).platform
    suits = backend_of(platform)
    name = suits if name == "auto" else name
    require(name in BACKENDS, f"execution.attention {name!r} is unknown; known: auto, {', '.join(BACKENDS)}")
    require(
        name == suits or name not in ONLY_ON,
        f"execution.attention {name!r} runs only on {ONLY_ON.get(name)}, but the device is a {platform.upper()}; use "
        "auto, which chooses by the device",
    )
    return BACKENDS[name]
