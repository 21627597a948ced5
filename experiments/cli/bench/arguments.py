"""Arguments that several commands of `hma bench` share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import arg

from experiments.study_setup import UNSET
from hma_jax.config.evaluation import SamplerKind
from hma_jax.config.execution import Dtype

Model = Literal["base", "xl", "base-continuous", "xl-continuous", "cpu", "cpu-continuous"]


@dataclass(frozen=True)
class Bench:
    """What is timed and how often."""

    model: Model = "base"
    """base: the released size, width 256, 32 layers, 12 frames of 256 + 64 tokens; xl: width 1024.
    cpu: the model of the cpu preset."""
    batch: tuple[int, ...] = (1,)
    """Batch size; several numbers give several measurements."""
    repeats: int = 30
    """Timed calls of every stage, after two untimed ones."""
    dtype: Dtype = "float32"
    """Number format of the computation."""
    robots: int = 1
    """Number of robots of the model; a batch mixes them."""
    layers: Annotated[int | None, arg(metavar="N"), UNSET] = None
    """Number of layers, instead of the model's own."""
    width: Annotated[int | None, arg(metavar="D"), UNSET] = None
    """Width, instead of the model's own."""
    seed: int = 0
    """Random seed of weights and inputs."""
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/bench")
    """Directory for the record."""


@dataclass(frozen=True)
class Decode:
    """How frames are generated."""

    unmask_steps: Annotated[int, arg(name="unmask-steps")] = 2
    """Unmasking steps per frame."""
    sampler_steps: Annotated[int, arg(name="sampler-steps")] = 100
    """Continuous models: steps of the diffusion sampler."""
    sampler: SamplerKind = "ddpm"
    """Continuous models: the diffusion sampler. dpm++ needs 8 to 12 steps."""
