"""What policies are judged against, and does not come from the model: starts of episodes, labels of success, and the
true simulator if there is one."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from typing import Any, Protocol

import numpy as np

from experiments.applications.judging.config import JudgeConfig
from experiments.applications.judging.head import Head, SuccessHead, measure_head, train_head
from experiments.applications.judging.outcomes import WORLDS
from experiments.applications.judging.rollouts import make_starts
from experiments.applications.policies.demonstrations import Demonstrations, record
from experiments.applications.policies.tasks import OWN, Task, join
from experiments.simulators import has_truth, true_simulator
from experiments.terminal.progress import say, step
from hma_jax.config import require
from hma_jax.simulator.interface import AnySimulator
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

HELD_OUT = 7919
"""Added to the seed of recordings that nothing is trained on."""

OFTEN = 0.5
"""Share of demonstrations that should succeed, for policies to learn the task from them."""

Reconstruct = Callable[[np.ndarray], np.ndarray]
"""uint8 [n, H, W, 3] as the model's tokenizer shows them."""


class GroundTruth(Protocol):
    """The ground truth of a robot: from its true simulator, or only from recordings.

    `worlds`: those in which policies act, in this order; the true one only if `open` gives it. `about`: what identifies
    the source, for judge.json. Expensive parts are made when the methods are called.
    """

    config: JudgeConfig
    robot: Robot
    worlds: tuple[str, ...]

    def about(self) -> dict[str, Any]: ...

    def demonstrations(self) -> Demonstrations:
        """The training set of the policies of the ladder."""
        ...

    def make_head(self, reconstruct: Reconstruct) -> SuccessHead:
        """A trained success head whose accuracy is not measured yet."""
        ...

    def measure(self, head: Head, reconstruct: Reconstruct) -> dict[str, float]:
        """The accuracy of a head on episodes on which no head is trained."""
        ...

    def starts(self) -> list[Start]: ...

    def open(self) -> AbstractContextManager[AnySimulator | None]:
        """The true simulator, if there is one."""
        ...


class SimulatedTruth:
    """Ground truth for a robot with a true simulator: its expert is cloned, and the simulator's state says what
    succeeded."""

    worlds = WORLDS

    def __init__(self, config: JudgeConfig, robot: Robot, learned: Simulator):
        """Raises ConfigError for a robot without a true simulator."""
        require(has_truth(robot), f"{robot.name} has no true simulator here; give recordings of it with --recordings")
        self.config, self.robot, self._learned = config, robot, learned
        self._size = learned.tokenizer.image_size

    def about(self) -> dict[str, Any]:
        return {}

    def _demonstrated_frames(self) -> int:
        asked, task = self.config.demonstration_frames, self.config.task
        return max(asked, task.frames) if task.hold > asked // 2 else asked  # or too few are left to reach the goal in

    def demonstrations(self) -> Demonstrations:
        config, task = self.config, replace(self.config.task, frames=self._demonstrated_frames())
        with step(f"record {config.demonstrations} demonstrations"):
            made = record(
                task,
                config.demonstrations,
                stride=self.robot.stride,
                image_size=self._size,
                noise=config.noise,
                after=0,
                seed=config.seed,
            )
        if seldom := describe_rare_success(made, task):
            say(seldom)
        return made

    def make_head(self, reconstruct: Reconstruct) -> SuccessHead:
        config, size, stride = self.config, self._size, self.robot.stride
        with step("record episodes for the success head"):
            known = head_recordings(config, size, stride, config.head_episodes, config.seed)
        with step("train the success head") as report:
            return train_head(known, config.head, config.seed, reconstruct, report)

    def measure(self, head: Head, reconstruct: Reconstruct) -> dict[str, float]:
        del reconstruct  # rates of the true frames stand beside those of the model
        config, episodes = self.config, max(self.config.head_episodes // 10, 12)
        with step("record episodes to measure the success head on"):
            new = head_recordings(config, self._size, self.robot.stride, episodes, config.seed + HELD_OUT)
        return measure_head(head, new, config.task)

    def starts(self) -> list[Start]:
        return make_starts(self.config.task, self.config.starts, self._size, self.robot.stride)

    def open(self) -> AbstractContextManager[AnySimulator]:
        return closing(true_simulator(self._learned, [self.robot], self.config.batch))


def describe_rare_success(demos: Demonstrations, task: Task) -> str:
    """A warning that the suite's expert rarely succeeds at its robot's own task, so that policies cannot learn it; ""
    if it succeeds, or if there is no easier task."""
    done = float(demos.successes.mean())
    if not task.in_suite or task.name != OWN or done >= OFTEN:
        return ""
    return (
        f"The scripted expert of {task.robot} succeeds in only {done:.0%} of the demonstrations ({task.frames} frames "
        "each), so policies cannot learn the task well from it; reaching the mark, --task reach, is easier."
    )


def head_recordings(config: JudgeConfig, size: int, stride: int, episodes: int, seed: int) -> Demonstrations:
    """Episodes of experts of several kinds and of play: successes, failures, and what lies between."""
    play = episodes // 3
    expert = record(config.task, episodes - play, stride=stride, image_size=size, noise=config.head_noise, seed=seed)
    return join([expert, record(config.task, play, stride=stride, image_size=size, play=True, seed=seed + 1)])
