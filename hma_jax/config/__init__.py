"""Configuration: frozen dataclasses, validated when made. Nothing here imports JAX.

A default lives here and nowhere else; named instances are `experiments.presets`. `model`, `training`, `tokenizer`,
`fixed_tokenizers` and `evaluation` hold what determines a result, `execution` how it is computed. Paths, clocks and
verbosity belong to the calling code. `json` reads and writes all of them. Finished results are named by these fields,
so a new field must be declared with `base.later`.
"""

from hma_jax.config.base import ConfigError, require
from hma_jax.config.evaluation import SMALLEST_LPIPS_IMAGE, DecodeConfig, EvalConfig, SamplerConfig, check_decoding
from hma_jax.config.execution import Dtype, ExecutionConfig, MeshConfig
from hma_jax.config.fixed_tokenizers import (
    AnyTokenizerConfig,
    Latents,
    Magvit2Config,
    PixelsConfig,
    PythonConfig,
    SvdVaeConfig,
)
from hma_jax.config.model import Conditioning, DiffusionConfig, ModelConfig, MupConfig
from hma_jax.config.tokenizer import ImageSize, TokenGrid, TokenizerConfig, TokenizerTrainConfig
from hma_jax.config.training import (
    MaskingConfig,
    MaskingSetting,
    OptimizerConfig,
    TrainConfig,
    Weights,
    check_micro_batches,
    check_objective,
)

__all__ = [
    "SMALLEST_LPIPS_IMAGE",
    "AnyTokenizerConfig",
    "Conditioning",
    "ConfigError",
    "DecodeConfig",
    "DiffusionConfig",
    "Dtype",
    "EvalConfig",
    "ExecutionConfig",
    "ImageSize",
    "Latents",
    "Magvit2Config",
    "MaskingConfig",
    "MeshConfig",
    "ModelConfig",
    "MupConfig",
    "OptimizerConfig",
    "PixelsConfig",
    "PythonConfig",
    "SamplerConfig",
    "MaskingSetting",
    "SvdVaeConfig",
    "TokenGrid",
    "TokenizerConfig",
    "TokenizerTrainConfig",
    "TrainConfig",
    "Weights",
    "check_decoding",
    "check_micro_batches",
    "check_objective",
    "require",
]
