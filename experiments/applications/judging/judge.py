"""`hma judge` from end to end: policies, head, rollouts, table, figures. What is finished is found again.

OUT/judge.json           what is judged; another command does not go on in the same directory
OUT/own_policies.py      the user's file, where there is one
OUT/policies/NAME        checkpoints (`policies.files`)
OUT/head                 the success head, or of a user's own what it was found to be worth
OUT/rollouts/NAME.WORLD.npz   frames of all episodes
OUT/outcomes.csv, agreement.json, scatter.png, judge.html, blind.html
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from experiments.applications.generating.trajectories import open_trajectories, require_layout
from experiments.applications.judging.config import JudgeConfig, Step
from experiments.applications.judging.head import DESCRIPTION as HEAD_DESCRIPTION
from experiments.applications.judging.head import Head, load_head, save_head
from experiments.applications.judging.ladder import OWN_HEAD, find_policy, names, train_ladder
from experiments.applications.judging.outcomes import LEARNED, SHUFFLED, TRUE, Outcome, judge_rollout
from experiments.applications.judging.outside import Outside, TrueOutside
from experiments.applications.judging.own_policies import load_own, try_out
from experiments.applications.judging.own_success import PAGE, OwnSuccess
from experiments.applications.judging.recordings import Recordings
from experiments.applications.judging.rollouts import Rollout, load_rollout, run, save_rollout
from experiments.applications.policies.network import require_multiples
from experiments.applications.policies.policy import Policy
from experiments.applications.settings_file import pin_settings, short_hash
from experiments.applications.simulators import load_simulator
from experiments.own_file import naming_line
from experiments.running.workspace import Workspace
from experiments.words import few
from hma_jax.config import require
from hma_jax.config.json import to_dict
from hma_jax.evaluation.protocol import predicts_actions
from hma_jax.runtime.files import write_file
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

OWN_FILE, MEASURED = "own_policies.py", "measured.json"


@dataclass(frozen=True)
class Judged:
    """What was found."""

    config: JudgeConfig
    head: Head
    policies: tuple[str, ...]
    own: tuple[str, ...]  # of these, the user's
    worlds: tuple[str, ...]
    outcomes: tuple[Outcome, ...]
    beyond: dict[str, float]  # the share of each policy's actions in the model that the robot's range did not have
    seconds: dict[str, float]  # per episode in each world, of the simulator's steps
    rollouts: Callable[[str, str], Rollout]  # by policy and world


def judge_run(run_directory: Path, out: Path, config: JudgeConfig, step: Step, own: Path | None = None) -> Judged:
    """The ladder's policies, and those of the user's file `own`, in the true and in the learned simulator.

    Raises ConfigError where `out` holds other judgements, the robot is not the run's or has no true simulator, or what
    the file gives are no policies.
    """
    simulator = load_simulator(run_directory, episodes=config.batch)
    _require_some(simulator, own is not None or config.ladder.cloned or config.ladder.diffusion)
    robot = simulator.robot(config.task.robot)
    return _judge(run_directory, out, simulator, robot, TrueOutside(config, robot, simulator, step), step, own)


def judge_recorded(
    run_directory: Path,
    out: Path,
    config: JudgeConfig,
    dataset: str,
    step: Step,
    own: Path | None = None,
    split: str = "train",
    counted: Sequence[str] = (),
) -> Judged:
    """The same for a robot without a true simulator, whose recordings in `dataset` say what success looks like. Of the
    starts and episodes at once that are asked for, as many as recordings are held out. `counted` are the policies that
    the real robot was seen to act by.

    Raises ConfigError as `judge_run` does, for recordings that are not the robot's, and for too few of them;
    EpisodeError for one that cannot be read.
    """
    simulator = load_simulator(run_directory, own_starts=True)
    _require_some(simulator, own is not None)
    robot, stores = simulator.robot(config.task.robot), Workspace.of_run(run_directory).store
    recorded, _ = open_trajectories(dataset, split, robot, {}, simulator.tokenizer, stores)
    require_layout(recorded, robot, simulator.model.table)
    outside = Recordings(config, recorded, robot, step)
    return _judge(run_directory, out, _of_episodes(simulator, outside.config.batch), robot, outside, step, own, counted)


def _require_some(simulator: Simulator, given: bool | int) -> None:
    """Raises ConfigError where neither are policies given nor is the model one."""
    some = given or _acts(simulator)
    require(bool(some), "there is no policy to judge but the random one: give --policies FILE")


def _acts(simulator: Simulator) -> bool:
    """Whether the model itself is a policy: heads alone do not make it one, which know nothing until actions are
    trained."""
    return predicts_actions(simulator.model.config, simulator.model.run.train.masking.setting)


def _of_episodes(simulator: Simulator, episodes: int) -> Simulator:
    """The same one with so many episodes at once."""
    robots = tuple(simulator.robots.values())
    return Simulator(simulator.model, simulator.tokenizer, robots=robots, episodes=episodes, decode=simulator.decode)


def _judge(
    run_directory: Path,
    out: Path,
    simulator: Simulator,
    robot: Robot,
    outside: Outside,
    step: Step,
    own: Path | None,
    counted: Sequence[str] = (),
) -> Judged:
    config = outside.config
    policies = names(config.ladder) + [OWN_HEAD] * _acts(simulator)  # may refuse the ladder
    users, success, about = {}, None, outside.about()
    if own is not None:
        users, success = load_own(own, robot)
    encoders = [config.ladder.encoder] * bool(config.ladder.cloned + config.ladder.diffusion)
    for encoder in encoders + [config.head.encoder] * (success is None):
        require_multiples(*simulator.tokenizer.image_shape, encoder.size)
    if own is not None:
        with naming_line(own, PAGE):
            try_out(users, success, config.batch, simulator.tokenizer.image_shape)
        about["contents of --policies"] = short_hash(own.read_bytes())
    policies += users
    others = [name for name in counted if name not in policies]
    require(
        not others, f"counted on the real robot: {few(others)}; judged here: {', '.join(policies)}; use the same names"
    )
    pin_settings(out, run_directory, simulator, {"config": to_dict(config), **about}, file="judge.json")
    if own is not None:
        write_file(out / OWN_FILE, own.read_bytes())
    taught = {"robot": robot.name, "task": config.task.name}
    with step("policies") as report:
        train_ladder(out / "policies", outside.demonstrations, config.ladder, config.seed, taught, lambda kind: report)
    head = _find_head(out / "head", outside, simulator, success)
    starts = outside.starts()
    seeds = [config.seed + i for i in range(len(starts))]
    acting: dict[str, Policy] = dict(users)  # what was compiled for one world serves the next
    with outside.open() as true:
        for world, name in itertools.product(outside.worlds, policies):
            path = _place(out, name, world)
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                policy = acting[name] = acting.get(name) or find_policy(out / "policies", name, robot, simulator)
                with step(f"{name} in the {world} world") as report:
                    made = run(
                        true if world == TRUE else simulator, policy, starts, seeds, config.task,
                        shuffled=world == SHUFFLED, report=report,
                    )  # fmt: skip
                save_rollout(made, path)
    return _collect(out, outside, head, policies, tuple(users), robot, starts, seeds)


def _collect(
    out: Path,
    outside: Outside,
    head: Head,
    policies: Sequence[str],
    own: tuple[str, ...],
    robot: Robot,
    starts: Sequence[Start],
    seeds: Sequence[int],
) -> Judged:
    numbers = [start.seed if start.seed is not None else -1 for start in starts]
    outcomes, seconds, beyond = [], {}, {}
    for world in outside.worlds:
        times = []
        for name in policies:
            rollout = load_rollout(_place(out, name, world))
            times.append(rollout.seconds)
            outcomes += judge_rollout(rollout, head, outside.config.task, name, world, numbers, seeds)
            if world == LEARNED:
                beyond[name] = _beyond(rollout.actions, robot)
        seconds[world] = float(np.median(np.concatenate(times)))  # the first one compiles
    rollouts = lambda name, world: load_rollout(_place(out, name, world))  # noqa: E731
    return Judged(
        outside.config, head, tuple(policies), own, outside.worlds, tuple(outcomes), beyond, seconds, rollouts
    )


def _beyond(actions: np.ndarray, robot: Robot) -> float:
    """The share of actions [..., A] of which a value lies outside the robot's range, to which it is then moved."""
    low, high = np.array(robot.low, np.float32), np.array(robot.high, np.float32)
    return float(((actions < low) | (actions > high)).any(-1).mean())


def _place(out: Path, name: str, world: str) -> Path:
    return out / "rollouts" / f"{name}.{world}.npz"


def _find_head(directory: Path, outside: Outside, simulator: Simulator, own: OwnSuccess | None) -> Head:
    tokenizer = simulator.tokenizer

    def reconstruct(images: np.ndarray) -> np.ndarray:
        return np.asarray(tokenizer.decode(tokenizer.encode(images)))

    if own is not None:
        kept = directory / MEASURED
        if not kept.exists():
            directory.mkdir(parents=True, exist_ok=True)
            write_file(kept, json.dumps(outside.measure(own, reconstruct), indent=1) + "\n")
        own.measured |= json.loads(kept.read_text())
        return own
    if (directory / HEAD_DESCRIPTION).exists():
        return load_head(directory)
    head = outside.make_head(reconstruct)
    head.measured |= outside.measure(head, reconstruct)
    save_head(head, directory)
    return head
