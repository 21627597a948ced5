"""The configuration of a judgement."""

from __future__ import annotations

from dataclasses import dataclass, field

from experiments.applications.judging.head import HeadConfig
from experiments.applications.judging.ladder import LadderConfig
from experiments.applications.policies.tasks import AnyTask
from hma_jax.config import require


@dataclass(frozen=True)
class JudgeConfig:
    """The task at which policies are judged, and how policies, starts and the success head are made."""

    task: AnyTask
    starts: int = 50
    batch: int = 50  # episodes at once
    seed: int = 0
    demonstrations: int = 3000
    demonstration_frames: int = 12  # as many as the task has, if the goal is held for more than half of these
    noise: tuple[float, ...] = (0.0, 0.1)  # noise of the expert that is cloned
    ladder: LadderConfig = field(default_factory=LadderConfig)
    head: HeadConfig = field(default_factory=HeadConfig)
    head_episodes: int = 3000
    head_noise: tuple[float, ...] = (0.0, 0.2, 0.6)  # noise of the expert in the head's recordings; a third are play

    def __post_init__(self):
        require(self.demonstrations >= 1, f"--demonstrations must be at least 1, got {self.demonstrations}")
        fewest = 3  # a third of them are play
        require(self.head_episodes >= fewest, f"--head-episodes must be at least {fewest}, got {self.head_episodes}")
        last = 2**32 - self.starts  # the i-th start has the seed plus i
        require(0 <= self.seed <= last, f"--seed must lie in 0..{last}, got {self.seed}")
        fewest = 2  # with one at a time the control has no other episode to take actions from
        require(self.batch >= fewest, f"--batch must be at least {fewest}, got {self.batch}")
        require(self.starts % self.batch == 0, f"--starts {self.starts} is not a multiple of --batch {self.batch}")

    @property
    def seeds(self) -> list[int]:
        """Seeds of the episodes, in the order of starts."""
        return [self.seed + i for i in range(self.starts)]
