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
    R action sequences that a rollout continues the same prompt with
    O action sequences of other episodes, in evaluation
    G robots of a training step (`training.active_robots`)

Small letters are axes of one function alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # type checkers and editors do not run `__getattr__`
    from hma_jax.config import DecodeConfig as DecodeConfig
    from hma_jax.config import ExecutionConfig as ExecutionConfig
    from hma_jax.config import ModelConfig as ModelConfig
    from hma_jax.config import TrainConfig as TrainConfig
    from hma_jax.generation import advance as advance
    from hma_jax.generation import rollout as rollout
    from hma_jax.generation import start as start
    from hma_jax.model.embodiments import EmbodimentTable as EmbodimentTable
    from hma_jax.model.hma import declare_model as declare_model
    from hma_jax.simulator import Simulator as Simulator
    from hma_jax.training.runs import load_model as load_model
    from hma_jax.training.train import train_model as train_model

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


def __dir__() -> list[str]:
    """Includes names that have not been imported yet, for completion."""
    return sorted({*globals(), *PUBLIC})
