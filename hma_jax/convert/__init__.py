"""Conversion of checkpoints to and from other formats: the official release's, safetensors, StableHLO.

The common form of models is `training.runs.Run`: readers return one, writers take one. Readers of pretrained tokenizers
return a tokenizer that `tokenizers.io` can save.
"""

from hma_jax.convert.atomic import require_free
from hma_jax.convert.neutral import read_neutral, write_neutral
from hma_jax.convert.official import import_remarks, official_shapes, read_official, write_official
from hma_jax.convert.pretrained import find_reader, has_average, read_magvit2, read_svd_vae
from hma_jax.convert.release_limits import loads_in_release
from hma_jax.convert.run_directory import write_run
from hma_jax.convert.stablehlo import ProgramConfig, write_stablehlo

__all__ = [
    "ProgramConfig",
    "find_reader",
    "has_average",
    "import_remarks",
    "loads_in_release",
    "official_shapes",
    "read_magvit2",
    "read_neutral",
    "read_official",
    "read_svd_vae",
    "require_free",
    "write_neutral",
    "write_official",
    "write_run",
    "write_stablehlo",
]
