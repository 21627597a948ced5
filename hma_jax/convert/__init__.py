"""Checkpoints to and from other formats: the official release's, safetensors, StableHLO.

Everything meets in a `training.train.Run`: readers return one, writers take one.
"""

from hma_jax.convert.aside import require_free
from hma_jax.convert.neutral import read_neutral, write_neutral
from hma_jax.convert.official import official_shapes, read_official, write_official
from hma_jax.convert.run_directory import write_run
from hma_jax.convert.stablehlo import ProgramConfig, write_stablehlo

__all__ = [
    "ProgramConfig",
    "official_shapes",
    "read_neutral",
    "read_official",
    "require_free",
    "write_neutral",
    "write_official",
    "write_run",
    "write_stablehlo",
]
