"""The kinds of policies that are trained on demonstrations, in one table: how each is made, explained and drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from experiments.applications.policies.acting import ChunkConfig, ChunkPolicy
from experiments.applications.policies.cloning import BcConfig, ClonedPolicy, init_bc, train_bc
from experiments.applications.policies.demonstrations import Demonstrations
from experiments.applications.policies.diffusion import (
    DiffusionConfig,
    DiffusionPolicy,
    init_diffusion,
    train_diffusion,
)
from experiments.applications.policies.learning import Report
from experiments.applications.policies.network import Params


@dataclass(frozen=True)
class Kind:
    """A kind of policy. Its `config` has the fields `frames`, `encoder` and `fit`, which `hma judge` sets."""

    policy: type[ChunkPolicy]
    config: type[ChunkConfig]
    init: Callable[[Any, int, int], Params]  # init(config, action_dim, seed): what a file of it must hold
    # train(demonstrations, config, seed, report): {step: policy} for the steps of its `fit` to keep, and the last one
    train: Callable[[Demonstrations, Any, int, Report], Mapping[int, ChunkPolicy]]
    explained: str  # on the page of a judgement
    legend: str  # a figure's name for all of this kind, after the colour's name
    colour: str


KINDS = {
    kind.policy.kind: kind
    for kind in (
        Kind(ClonedPolicy, BcConfig, init_bc, train_bc, "behaviour cloning", "blue: cloned", "#2b5c8a"),
        Kind(
            DiffusionPolicy, DiffusionConfig, init_diffusion, train_diffusion,
            "a small Diffusion Policy", "orange: diffusion policies", "#b3541e",
        ),
    )
}  # fmt: skip
"""The kinds by name. Each has a field in `LadderConfig` and an option of `hma judge` with this name: how many of its
checkpoints are judged."""
