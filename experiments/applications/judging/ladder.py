"""The policies that are judged, a ladder from random to fully trained, all of them acting on images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from experiments.applications.policies.demonstrations import Demonstrations
from experiments.applications.policies.files import DESCRIPTION, load_policy, save_policy
from experiments.applications.policies.kinds import KINDS
from experiments.applications.policies.learning import FitConfig, Report, log_spaced_steps
from experiments.applications.policies.network import EncoderConfig
from experiments.applications.policies.own_head import OwnHeadPolicy
from experiments.applications.policies.policy import Policy, RandomPolicy
from hma_jax.config import require
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator

RANDOM = "random"

OWN_HEAD = "hma"
"""The model itself, where it predicts actions."""


@dataclass(frozen=True)
class LadderConfig:
    """How many checkpoints of each kind of policy (`KINDS`) there are, in addition to the random policy."""

    cloned: int = 6
    diffusion: int = 3
    steps: int = 6000
    first: int = 60  # the step of the first checkpoint
    batch: int = 64
    learning_rate: float = 2e-3
    frames: int = 1  # from two frames a policy would read what was just done, and merely repeat it
    encoder: EncoderConfig = field(default_factory=EncoderConfig)

    def __post_init__(self):
        for kind, count in self.counts.items():
            require(count >= 0, f"--{kind} must not be negative, got {count}")

    @property
    def counts(self) -> dict[str, int]:
        """{kind of policy: number of its checkpoints}."""
        return {kind: getattr(self, kind) for kind in KINDS}

    def fits(self) -> dict[str, FitConfig]:
        """{kind of policy: its training}, for kinds that have checkpoints."""
        return {kind: self._fit(count) for kind, count in self.counts.items() if count}

    def _fit(self, count: int) -> FitConfig:
        keep = log_spaced_steps(self.steps, count, self.first) if count > 1 else (self.steps,)
        return FitConfig(steps=self.steps, batch=self.batch, learning_rate=self.learning_rate, keep=keep)


def names(config: LadderConfig) -> list[str]:
    """The names of all policies, in the order of their training."""
    return [RANDOM, *(f"{kind}-{step}" for kind, fit in config.fits().items() for step in fit.keep)]


def train_ladder(
    directory: Path,
    demos: Callable[[], Demonstrations],
    config: LadderConfig,
    seed: int,
    about: dict[str, str],
    report: Report,
) -> None:
    """Trains the kinds that are not in `directory` yet, each with all its checkpoints. `demos` are recorded if
    needed."""
    recorded: Demonstrations | None = None
    for kind, fit in config.fits().items():
        if all((directory / f"{kind}-{step}" / DESCRIPTION).exists() for step in fit.keep):
            continue
        recorded = demos() if recorded is None else recorded
        policy_config = KINDS[kind].config(frames=config.frames, encoder=config.encoder, fit=fit)
        for step, policy in KINDS[kind].train(recorded, policy_config, seed, report).items():
            save_policy(policy, directory / f"{kind}-{step}", about | {"step": step, "seed": seed})


def kind_of(name: str) -> str:
    """The kind of a policy that is made here, by its name; for trained policies as in `KINDS`."""
    return name.split("-")[0]


def find_policy(directory: Path, name: str, robot: Robot, simulator: Simulator) -> Policy:
    """The policy called `name`. Raises ConfigError if it does not exist, or is damaged."""
    if name == RANDOM:
        return RandomPolicy(robot)
    if name == OWN_HEAD:
        return OwnHeadPolicy(simulator.model, simulator.tokenizer, robot, simulator.decode)
    return load_policy(directory / name)
