"""Where the demonstrations come from that policies are trained on, and what judges these policies: a scripted expert
and the true simulator, or recordings and held-out recordings alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from data_pipelines.errors import EpisodeError
from experiments.applications.generating.source import confined
from experiments.applications.generating.trajectories import Trajectories, Trajectory, describe
from experiments.applications.policies.closed_loop import MOST_TRIED, run_policy, start_distances, start_seeds
from experiments.applications.policies.demonstrations import Demonstrations, record
from experiments.applications.policies.policy import Policy
from experiments.applications.policies.tasks import Task, find_task
from hma_jax.config import require
from hma_jax.config.base import later
from hma_jax.simulator.robots import Robot


@dataclass(frozen=True)
class Training:
    """How policies are trained, and on how many trajectories. Results depend on this, the world model and the
    demonstrations alone."""

    trajectories: int = 100
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int = 2000  # of training, of every policy
    batch: int = 32
    learning_rate: float = 2e-3
    given: int = 1  # recorded frames that a generated trajectory begins with
    with_given: bool = False  # policies are trained on these, too
    through_tokenizer: bool = later(False)  # policies see all frames as the world model's tokenizer reconstructs them
    temperature: float = 0.0  # of sampling, whatever a run's decode.json says; 0: greedy decoding

    def __post_init__(self) -> None:
        """Raises ConfigError."""
        require(
            self.given >= 1,
            f"--given must be at least 1, got {self.given}: a generated trajectory begins with recorded frames",
        )
        require(bool(self.seeds), "no seed was given: at least 1 is needed")
        require(self.steps >= 1, f"--steps must be at least 1, got {self.steps}")


@dataclass(frozen=True)
class Settings(Training):
    """A scripted expert's task."""

    robot: str = "gripper_wood"
    task: str = "hover"
    frames: int = 14
    hold: int = 6  # frames in a row at the goal, for success
    least: float = 0.5  # from the goal, that an episode begins, in halves of the floor's side
    noise: float = 0.05  # of the expert
    starts: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.starts >= 1, f"--starts must be at least 1, got {self.starts}")
        require(
            self.given < self.frames,
            f"--given {self.given} must be below the {self.frames} frames of an episode, so that at least one frame "
            "is generated",
        )

    def make_task(self) -> Task:
        return find_task(self.robot, self.task, self.frames, self.hold)


@dataclass(frozen=True)
class RecordedSettings(Training):
    """Recordings, told from others by `describe`."""

    robot: str = ""
    recordings: dict[str, Any] | None = None
    held_out: dict[str, Any] | None = None


class DemonstrationSource(Protocol):
    """Demonstrations to train policies on (`record`) and to measure their action errors on (`record_held_out`), and a
    judge: {measure: a number for every start} of a policy in closed loop, {} where no simulator can run one."""

    settings: Training
    robot: Robot

    def record(self) -> Demonstrations: ...

    def record_held_out(self) -> Demonstrations: ...

    def judge(self, policy: Policy) -> dict[str, list[float]]: ...


class ScriptedSource:
    """Successful episodes of the scripted expert that begin far enough from the goal; policies are judged in closed
    loop in the true simulator."""

    def __init__(self, settings: Settings, robot: Robot, image_size: int):
        self.settings, self.robot, self._size, self._task = settings, robot, image_size, settings.make_task()

    def record(self) -> Demonstrations:
        return self._record(seed=0)

    def record_held_out(self) -> Demonstrations:
        return self._record(seed=1)

    def _record(self, seed: int) -> Demonstrations:
        settings, task = self.settings, self._task
        count = MOST_TRIED * settings.trajectories
        how = {"noise": settings.noise, "only_successes": True, "stride": self.robot.stride, "image_size": self._size}
        made = record(task, count, seed=seed, **how)
        far = np.flatnonzero(start_distances(task, made.seeds) >= settings.least)[: settings.trajectories]
        enough = len(far) == settings.trajectories
        require(enough, f"{task.robot}: too few episodes begin at least {settings.least:g} away from the goal")
        return made.take(far)

    def judge(self, policy: Policy) -> dict[str, list[float]]:
        starts = start_seeds(self._task, self.settings.starts, least=self.settings.least)
        outcome = run_policy(self._task, policy, starts, self._size, self.robot.stride)
        return {"success": outcome.success.astype(int).tolist(), "distance": np.round(outcome.distance, 4).tolist()}


class RecordedSource:
    """The first recordings that are longer than the given frames, with actions clipped as the simulator executes them,
    and at most as many held-out ones; nothing runs a policy in closed loop."""

    def __init__(self, training: Training, robot: Robot, recorded: Trajectories, held_out: Trajectories):
        """Raises ConfigError for too few recordings, and for a split that would be judged on itself."""
        require(
            (recorded.fingerprint, recorded.split) != (held_out.fingerprint, held_out.split),
            f"{recorded.name}: policies would be evaluated on their training data, split {recorded.split}; give "
            "another split with --held-out",
        )
        require(
            len(recorded) >= training.trajectories,
            f"{recorded.name}, split {recorded.split}, has {len(recorded)} trajectories, but {training.trajectories} "
            "are needed; give another --split or DATASET",
        )
        self.robot, self._recorded, self._held_out = robot, recorded, held_out
        about = {"recordings": describe(recorded), "held_out": describe(held_out)}
        self.settings = RecordedSettings(**vars(training), robot=robot.name, **about)

    def record(self) -> Demonstrations:
        longer = self._first(self._recorded)
        require(
            len(longer) == self.settings.trajectories,
            f"{self._recorded.name}, split {self._recorded.split}, has {len(longer)} trajectories longer than "
            f"{self.settings.given} frame(s), but {self.settings.trajectories} are needed; give another --split or "
            "DATASET",
        )
        return as_demonstrations([confined(t, self.robot) for t in longer])

    def record_held_out(self) -> Demonstrations:
        longer = self._first(self._held_out)
        require(
            bool(longer),
            f"{self._held_out.name}, split {self._held_out.split}, has no trajectory to evaluate policies on",
        )
        return as_demonstrations(longer)

    def _first(self, trajectories: Trajectories) -> list[Trajectory]:
        """At most as many as policies are trained on."""
        longer = []
        for i in range(len(trajectories)):
            if len(longer) == self.settings.trajectories:
                break
            try:
                one = trajectories[i]
            except EpisodeError as error:
                trajectories.skip(i, error)
                continue
            if len(one) > self.settings.given:
                longer.append(one)
        return longer

    def judge(self, policy: Policy) -> dict[str, list[float]]:
        return {}


def as_demonstrations(trajectories: list[Trajectory]) -> Demonstrations:
    """An action is the whole chunk of its frame, [stride * A]. Success is unknown and set to False."""
    count, longest = len(trajectories), max(map(len, trajectories))
    images = np.zeros((count, longest, *trajectories[0].images.shape[1:]), np.uint8)
    actions = np.zeros((count, longest, trajectories[0].chunks[0].size), np.float32)
    for i, one in enumerate(trajectories):
        images[i, : len(one)], actions[i, : len(one)] = one.images, one.chunks.reshape(len(one), -1)
    lengths, unknown = np.array([len(t) for t in trajectories]), np.zeros((count, longest), bool)
    return Demonstrations(images, actions, lengths, unknown, unknown[:, 0], np.full(count, -1))


def as_trajectories(demos: Demonstrations, robot: Robot) -> list[Trajectory]:
    """With the chunks that a demonstration's actions stand for: whole ones, or an action that is held."""
    trajectories = []
    for i, length in enumerate(demos.lengths):
        acted = demos.actions[i, :length]
        whole = acted.shape[1] == robot.stride * robot.action_dim
        chunks = acted.reshape(length, robot.stride, -1) if whole else np.repeat(acted[:, None], robot.stride, 1)
        trajectories.append(Trajectory(str(i), demos.images[i, :length], chunks))
    return trajectories


def shuffled_actions(demos: Demonstrations) -> np.ndarray:
    """float32 [N, L, A]: every trajectory gets the actions of the one before it, whose last action is held where it is
    shorter."""
    at = np.minimum(np.arange(demos.actions.shape[1]), np.roll(demos.lengths, 1)[:, None] - 1)
    return np.take_along_axis(np.roll(demos.actions, 1, 0), at[..., None], 1)
