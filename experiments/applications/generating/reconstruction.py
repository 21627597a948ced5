"""Policies that see every frame as a world model's tokenizer reconstructs it: recorded, true and generated frames then
look alike."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from experiments.applications.generating.conditions import GENERATED_KINDS
from experiments.applications.policies.demonstrations import Demonstrations
from experiments.applications.policies.policy import Policy
from hma_jax.simulator.interface import WholeNumbers
from hma_jax.tokenizers.base import Tokenizer


def reconstruct_recorded(
    data: Mapping[str, Demonstrations], tokenizer: Tokenizer, given: int
) -> dict[str, Demonstrations]:
    """Kinds of trajectories with every recorded frame reconstructed, also the `given` ones that generated trajectories
    begin with. Generated frames are decoded from tokens already."""
    seen = {}
    for kind, demos in data.items():
        first = demos.images[:, : given if kind in GENERATED_KINDS else None]
        made = tokenizer.reconstruct(first.reshape(-1, *first.shape[2:])).reshape(first.shape)
        seen[kind] = replace(demos, images=np.concatenate([made, demos.images[:, first.shape[1] :]], 1))
    return seen


@dataclass
class ThroughTokenizer:
    """A policy that sees what the tokenizer reconstructs."""

    policy: Policy
    tokenizer: Tokenizer

    def reset(self, episodes: WholeNumbers | None = None, *, seeds: WholeNumbers | None = None) -> None:
        self.policy.reset(episodes, seeds=seeds)

    def act(self, images: np.ndarray) -> np.ndarray:
        return self.policy.act(self.tokenizer.reconstruct(images))
