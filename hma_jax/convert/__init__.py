"""Checkpoints to and from other formats: the official release's, safetensors, StableHLO.

Everything meets in a `training.train.Run`: readers return one, writers take one.
"""

from hma_jax.convert.official import official_shapes, read_official, write_official

__all__ = ["official_shapes", "read_official", "write_official"]
