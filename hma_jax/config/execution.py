"""How a run is computed; nothing here is part of what it is."""

from __future__ import annotations

from dataclasses import dataclass

from hma_jax.config.base import require


@dataclass(frozen=True)
class MeshConfig:
    """Devices along each mesh axis; -1 on one axis takes all that are left."""

    data: int = -1
    fsdp: int = 1
    tensor: int = 1
    min_shard_size: int = 2**14  # smaller parameters stay whole on every device

    def __post_init__(self):
        sizes = (self.data, self.fsdp, self.tensor)
        require(sizes.count(-1) <= 1, f"mesh: only one axis may be -1, got {sizes}")
        require(all(s == -1 or s >= 1 for s in sizes), f"mesh axes must be -1 or at least 1, got {sizes}")
