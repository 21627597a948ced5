"""`hma judge` from end to end: policies, head, rollouts, table, figures. What is finished is found again.

OUT/judge.json           what is judged; another command does not go on in the same directory
OUT/policies/NAME        checkpoints (`policies.files`)
OUT/head                 the success head
OUT/rollouts/NAME.WORLD.npz   frames of all episodes
OUT/outcomes.csv, agreement.json, scatter.png, judge.html, blind.html
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from experiments.applications.judging.head import DESCRIPTION as HEAD_DESCRIPTION
from experiments.applications.judging.head import HeadConfig, SuccessHead, auroc, load_head, save_head, train_head
from experiments.applications.judging.ladder import OWN_HEAD, LadderConfig, find_policy, names, train_ladder
from experiments.applications.judging.outcomes import SHUFFLED, TRUE, WORLDS, Outcome, judge_rollout
from experiments.applications.judging.rollouts import Rollout, load_rollout, make_starts, run, save_rollout
from experiments.applications.made_with import claim
from experiments.applications.policies.demonstrations import Demonstrations, join, record
from experiments.applications.policies.learning import Report
from experiments.applications.policies.network import require_multiples
from experiments.applications.policies.policy import Policy
from experiments.applications.policies.tasks import Task, held
from experiments.applications.simulators import has_truth, load_simulator, true_simulator
from hma_jax.config import require
from hma_jax.config.json import to_dict
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

Step = Callable[[str], AbstractContextManager[Report]]

HELD_OUT = 7919
"""Added to the seed of recordings that nothing is trained on."""


@dataclass(frozen=True)
class JudgeConfig:
    """What is judged, and how its parts are made."""

    task: Task
    starts: int = 50
    batch: int = 50  # episodes at once
    seed: int = 0
    demonstrations: int = 3000
    demonstration_frames: int = 12
    noise: tuple[float, ...] = (0.0, 0.1)  # of the expert that is cloned
    ladder: LadderConfig = field(default_factory=LadderConfig)
    head: HeadConfig = field(default_factory=HeadConfig)
    head_episodes: int = 3000
    head_noise: tuple[float, ...] = (0.0, 0.2, 0.6)  # of the expert in the head's recordings; a third are play

    def __post_init__(self):
        require(self.demonstrations >= 1, f"--demonstrations must be at least 1, got {self.demonstrations}")
        fewest = 3  # a third of them are play
        require(self.head_episodes >= fewest, f"--head-episodes must be at least {fewest}, got {self.head_episodes}")
        last = 2**32 - self.starts  # the i-th start has the seed plus i
        require(0 <= self.seed <= last, f"--seed must lie in 0..{last}, got {self.seed}")
        fewest = 2  # with one at a time the control has no other episode to take actions from
        require(self.batch >= fewest, f"--batch must be at least {fewest}, got {self.batch}")
        require(self.starts % self.batch == 0, f"{self.starts} starts cannot be run {self.batch} at a time")


@dataclass(frozen=True)
class Judged:
    """What was found."""

    config: JudgeConfig
    head: SuccessHead
    policies: tuple[str, ...]
    outcomes: tuple[Outcome, ...]
    seconds: dict[str, float]  # per episode in each world, of the simulator's steps
    rollouts: Callable[[str, str], Rollout]  # by policy and world


def judge_run(run_directory: Path, out: Path, config: JudgeConfig, step: Step) -> Judged:
    """Raises ConfigError where `out` holds other judgements, or the robot is not the run's or has no true simulator."""
    simulator = load_simulator(run_directory, episodes=config.batch)
    robot = simulator.robot(config.task.robot)
    require(has_truth(robot), f"{robot.name} has no true simulator here: there is nothing to compare with")
    for encoder in (config.ladder.encoder, config.head.encoder):
        require_multiples(*simulator.tokenizer.image_shape, encoder.size)
    policies = names(config.ladder) + [OWN_HEAD] * simulator.model.config.action_heads  # may refuse the ladder
    claim(out, run_directory, simulator, {"config": to_dict(config)}, file="judge.json")
    size, stride, task = simulator.tokenizer.image_size, robot.stride, config.task

    def demonstrations() -> Demonstrations:
        short = replace(task, frames=config.demonstration_frames)
        with step(f"record {config.demonstrations} demonstrations"):
            return record(
                short,
                config.demonstrations,
                stride=stride,
                image_size=size,
                noise=config.noise,
                after=0,
                seed=config.seed,
            )

    about = {"robot": robot.name, "task": task.name}
    with step("policies") as report:
        train_ladder(out / "policies", demonstrations, config.ladder, config.seed, about, lambda kind: report)
    head = _find_head(out / "head", config, simulator, stride, step)
    starts = make_starts(task, config.starts, size, stride)
    seeds = [config.seed + i for i in range(len(starts))]
    acting: dict[str, Policy] = {}  # what was compiled for one world serves the next
    with closing(true_simulator(simulator, [robot], config.batch)) as true:
        for world, name in itertools.product(WORLDS, policies):
            path = _place(out, name, world)
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                policy = acting[name] = acting.get(name) or find_policy(out / "policies", name, robot, simulator)
                with step(f"{name} in the {world} world") as report:
                    made = run(
                        true if world == TRUE else simulator, policy, starts, seeds, task,
                        shuffled=world == SHUFFLED, report=report,
                    )  # fmt: skip
                save_rollout(made, path)
    return _collect(out, config, head, policies, starts, seeds)


def _collect(
    out: Path,
    config: JudgeConfig,
    head: SuccessHead,
    policies: Sequence[str],
    starts: Sequence[Start],
    seeds: Sequence[int],
) -> Judged:
    numbers = [start.seed if start.seed is not None else -1 for start in starts]
    outcomes, seconds = [], {}
    for world in WORLDS:
        times = []
        for name in policies:
            rollout = load_rollout(_place(out, name, world))
            times.append(rollout.seconds)
            outcomes += judge_rollout(rollout, head, config.task, name, world, numbers, seeds)
        seconds[world] = float(np.median(np.concatenate(times)))  # the first one compiles
    rollouts = lambda name, world: load_rollout(_place(out, name, world))  # noqa: E731
    return Judged(config, head, tuple(policies), tuple(outcomes), seconds, rollouts)


def _place(out: Path, name: str, world: str) -> Path:
    return out / "rollouts" / f"{name}.{world}.npz"


def head_recordings(config: JudgeConfig, size: int, stride: int, episodes: int, seed: int) -> Demonstrations:
    """Episodes of experts of several kinds and of play: successes, failures, and what lies between."""
    play = episodes // 3
    expert = record(config.task, episodes - play, stride=stride, image_size=size, noise=config.head_noise, seed=seed)
    return join([expert, record(config.task, play, stride=stride, image_size=size, play=True, seed=seed + 1)])


def _find_head(directory: Path, config: JudgeConfig, simulator: Simulator, stride: int, step: Step) -> SuccessHead:
    if (directory / HEAD_DESCRIPTION).exists():
        return load_head(directory)
    size, tokenizer = simulator.tokenizer.image_size, simulator.tokenizer
    with step("record episodes for the success head"):
        known = head_recordings(config, size, stride, config.head_episodes, config.seed)
        new = head_recordings(config, size, stride, max(config.head_episodes // 10, 12), config.seed + HELD_OUT)

    def reconstruct(images: np.ndarray) -> np.ndarray:
        return np.asarray(tokenizer.decode(tokenizer.encode(images)))

    with step("train the success head") as report:
        head = train_head(known, config.head, config.seed, reconstruct, report)
    head.measured |= measure_head(head, new, config.task)
    save_head(head, directory)
    return head


def measure_head(head: SuccessHead, demos: Demonstrations, task: Task) -> dict[str, float]:
    """On recorded true frames: accuracy and AUROC of frames, and accuracy of whole episodes."""
    steps = demos.steps()
    score = head.probabilities(demos.images, demos.images[:, :1])
    frames, labels = score[steps[:, 0], steps[:, 1]], demos.reached[steps[:, 0], steps[:, 1]]
    by_head = held(score > head.config.threshold, task.hold).any(1)
    return {
        "frames": float(len(labels)),
        "positive": float(labels.mean()),
        "frame accuracy": float(((frames > head.config.threshold) == labels).mean()),
        "frame AUROC": auroc(frames, labels),
        "episodes": float(len(demos)),
        "episode accuracy": float((by_head == demos.successes).mean()),
    }
