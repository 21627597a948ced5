"""HMA in JAX: the model, its training, generation, evaluation and tokenizers.

This package knows no file format of robot data and no experiment. Dimension letters used
throughout, in signatures, parameter axes and tensor names:

    B batch             T frames               S image tokens per frame
    K action tokens     D width                H heads (I = D / H, one head's width)
    N layers            F mlp width            E embodiments
    W width of a diffusion head
    U padded action width (stride x native dim)
    Q vocabulary factors                       V entries per factor
    C latent channels   P tokens per frame in the trunk (S + K)
"""

from importlib import import_module
from typing import Any

__version__ = "0.1.0"

PUBLIC = {
    "ModelConfig": "hma_jax.config",
    "TrainConfig": "hma_jax.config",
    "ExecutionConfig": "hma_jax.config",
    "DecodeConfig": "hma_jax.config",
    "EmbodimentTable": "hma_jax.model.embodiments",
    "declare_model": "hma_jax.model.hma",
    "train_model": "hma_jax.training.train",
    "load_model": "hma_jax.training.runs",
    "rollout": "hma_jax.generation",
    "start": "hma_jax.generation",
    "advance": "hma_jax.generation",
    "Simulator": "hma_jax.simulator",
}
"""Names that this package offers, and where they live. Each is imported when it is first asked for: a program that
only reads configurations does not wait for JAX."""

__all__ = list(PUBLIC)


def __getattr__(name: str) -> Any:
    if name not in PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; it offers {', '.join(PUBLIC)}")
    return getattr(import_module(PUBLIC[name]), name)
