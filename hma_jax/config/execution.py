"""How a program is executed: recorded with a run, but not part of its identity.

A run may be resumed with any other execution (`training.train`); results differ at most by rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from hma_jax.config.base import check_fields, require

Dtype = Literal["float32", "bfloat16"]

MAX_THREADS = 1024
"""The most threads that may read windows. A system starts only a few thousand; a program that asks for more hangs."""

Remat = Literal["none", "products", "attention", "everything", "offload"]
"""What a block of the trunk or a diffusion head keeps for its backward pass; what it does not keep is computed again.

    none        whatever the gradient asks for: most memory, nothing computed twice
    products    matrix products and attention; norms and activations are computed again
    attention   attention and the first product of the MLP
    everything  the block's input alone
    offload     the block's input alone, in the trunk in the memory of the host

On CPUs diffusion heads keep everything, because XLA merges their second computation with the first.
"""

Attention = Literal["auto", "plain", "cpu", "cudnn", "splash"]
"""What computes attention (`hma_jax.kernels`); `auto` takes what suits the platform and the shapes."""


@dataclass(frozen=True)
class MeshConfig:
    """Devices along each mesh axis; -1 on one axis takes all that are left."""

    data: int = -1  # devices for data parallelism: the batch is split over them
    fsdp: int = 1  # devices for fsdp: batch and parameters are split over them
    tensor: int = 1  # devices for tensor parallelism: heads and MLP are split over them
    min_shard_size: int = 2**14  # parameters with fewer values are not split

    def __post_init__(self):
        check_fields(self)
        sizes = (self.data, self.fsdp, self.tensor)
        require(sizes.count(-1) <= 1, f"mesh: only one axis may be -1, got {sizes}")
        require(all(s == -1 or s >= 1 for s in sizes), f"mesh axes must be -1 or at least 1, got {sizes}")
        require(self.min_shard_size >= 0, f"mesh.min_shard_size must not be negative, got {self.min_shard_size}")

    @property
    def min_devices(self) -> int:
        """The product of the axes that are not -1: the number of devices if none is -1, else the least."""
        return math.prod(size for size in (self.data, self.fsdp, self.tensor) if size != -1)


@dataclass(frozen=True)
class ExecutionConfig:
    """Number format, memory, kernels and devices of a program."""

    dtype: Dtype = "float32"  # number format of the computation; parameters are stored in float32
    # What the backward pass recomputes, in the trunk and in diffusion heads, to save memory. The default takes the
    # least memory. Where there is four times as much for activations, "products" is a seventh faster on CPU (twelve
    # layers; docs/performance.md).
    remat: Remat = "everything"
    attention: Attention = "auto"  # implementation of attention; auto: chosen by platform and shapes
    accumulate: int = 1  # micro-batches per optimiser step
    # Evaluation: windows per device that are in memory at the same time. Each is continued under
    # 1 + eval.random_actions action sequences, and the caches of those are most of the memory.
    windows_at_once: int = 4
    # Threads that read training windows ahead, two batches each. More of them where batches come late: long episodes,
    # latents, slow disks.
    loader_threads: int = 2
    mesh: MeshConfig = field(default_factory=MeshConfig)

    def __post_init__(self):
        check_fields(self)
        for name in ("accumulate", "windows_at_once", "loader_threads"):
            require(getattr(self, name) >= 1, f"execution.{name} must be at least 1, got {getattr(self, name)}")
        require(
            self.loader_threads <= MAX_THREADS,
            f"execution.loader_threads must be at most {MAX_THREADS:,}, got {self.loader_threads:,}",
        )
