"""`hma judge` from end to end: policies, head, rollouts, table, figures. Finished parts are reused.

OUT/judge.json           what is judged; a different command does not continue in the same directory
OUT/own_policies.py      the user's file, if there is one
OUT/policies/NAME        checkpoints (`policies.files`)
OUT/head                 the success head, or the measured accuracy of a user's own
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
from experiments.applications.judging.config import JudgeConfig
from experiments.applications.judging.ground_truth import GroundTruth, SimulatedTruth
from experiments.applications.judging.head import DESCRIPTION as HEAD_DESCRIPTION
from experiments.applications.judging.head import Head, load_head, save_head
from experiments.applications.judging.ladder import OWN_HEAD, find_policy, names, train_ladder
from experiments.applications.judging.outcomes import LEARNED, SHUFFLED, TRUE, Outcome, judge_rollout
from experiments.applications.judging.recordings import RecordedTruth
from experiments.applications.judging.rollouts import Rollout, load_rollout, run, save_rollout
from experiments.applications.judging.user_policies import load_user_policies, try_out
from experiments.applications.judging.user_success import PAGE, UserSuccess
from experiments.applications.policies.network import require_multiples
from experiments.applications.policies.policy import Policy
from experiments.applications.settings_file import pin_settings, short_hash
from experiments.running.workspace import Workspace
from experiments.simulators import load_simulator
from experiments.terminal.progress import step
from experiments.terminal.words import few
from experiments.user_input.user_file import naming_line
from hma_jax.config import require
from hma_jax.evaluation.protocol import predicts_actions
from hma_jax.runtime.files import read_json, write_file
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

USER_FILE, MEASURED = "own_policies.py", "measured.json"


@dataclass(frozen=True)
class Judgement:
    """The outcomes of all policies in all worlds, and what they were made with."""

    config: JudgeConfig
    head: Head
    policies: tuple[str, ...]
    user_policies: tuple[str, ...]  # those of them that are the user's
    worlds: tuple[str, ...]
    outcomes: tuple[Outcome, ...]
    clipped: dict[str, float]  # the share of each policy's actions in the model that were clipped to the robot's range
    seconds: dict[str, float]  # seconds per episode in each world, for the simulator's steps only
    rollouts: Callable[[str, str], Rollout]  # by policy and world


def judge_run(run_directory: Path, out: Path, config: JudgeConfig, user_file: Path | None = None) -> Judgement:
    """The ladder's policies, and those of the user's file `user_file`, in the true and in the learned simulator.

    Raises ConfigError if `out` holds other judgements, if the robot is not the run's or has no true simulator, or if
    the file does not give policies.
    """
    simulator = load_simulator(run_directory, episodes=config.batch)
    _require_policy(simulator, user_file is not None or any(config.ladder.counts.values()))
    robot = simulator.robot(config.task.robot)
    return _judge(run_directory, out, simulator, SimulatedTruth(config, robot, simulator), user_file)


def judge_recorded(
    run_directory: Path,
    out: Path,
    config: JudgeConfig,
    dataset: str,
    user_file: Path | None = None,
    split: str = "train",
    counted: Sequence[str] = (),
) -> Judgement:
    """The same for a robot without a true simulator, whose recordings in `dataset` say what success looks like. There
    are at most as many starts, and episodes at once, as held-out recordings. `counted`: the policies whose successes on
    the real robot were counted.

    Raises ConfigError as `judge_run` does, for recordings that are not the robot's, and for too few of them;
    EpisodeError for one that cannot be read.
    """
    simulator = load_simulator(run_directory, own_starts=True)
    _require_policy(simulator, user_file is not None)
    robot, stores = simulator.robot(config.task.robot), Workspace.of_run(run_directory).store
    recorded, _ = open_trajectories(dataset, split, robot, {}, simulator.tokenizer, stores)
    require_layout(recorded, robot, simulator.model.table)
    truth = RecordedTruth(config, recorded, robot)
    return _judge(run_directory, out, _with_episodes(simulator, truth.config.batch), truth, user_file, counted)


def _require_policy(simulator: Simulator, given: bool) -> None:
    """Raises ConfigError if no policies are given and the model is not a policy itself."""
    some = given or _predicts_actions(simulator)
    require(some, "there is no policy to evaluate except the random one: give --policies FILE")


def _predicts_actions(simulator: Simulator) -> bool:
    """Whether the model itself is a policy: action heads alone do not make it one, since they know nothing until
    actions are trained."""
    return predicts_actions(simulator.model.config, simulator.model.run.train.masking.setting)


def _with_episodes(simulator: Simulator, episodes: int) -> Simulator:
    """The same simulator with this number of episodes at once."""
    robots = tuple(simulator.robots.values())
    return Simulator(simulator.model, simulator.tokenizer, robots=robots, episodes=episodes, decode=simulator.decode)


def _judge(
    run_directory: Path,
    out: Path,
    simulator: Simulator,
    truth: GroundTruth,
    user_file: Path | None,
    counted: Sequence[str] = (),
) -> Judgement:
    config, robot = truth.config, truth.robot
    policies = names(config.ladder) + [OWN_HEAD] * _predicts_actions(simulator)  # this may refuse the ladder
    user_policies, success, about = {}, None, truth.about()
    if user_file is not None:
        user_policies, success = load_user_policies(user_file, robot)
    encoders = [config.ladder.encoder] * any(config.ladder.counts.values())
    for encoder in encoders + [config.head.encoder] * (success is None):
        require_multiples(*simulator.tokenizer.image_shape, encoder.size)
    if user_file is not None:
        with naming_line(user_file, PAGE):
            try_out(user_policies, success, config.batch, simulator.tokenizer.image_shape)
        about["contents of --policies"] = short_hash(user_file.read_bytes())
    policies += user_policies
    others = [name for name in counted if name not in policies]
    require(
        not others,
        f"--real has policies {few(others)}, but the policies here are {', '.join(policies)}; use the same names",
    )
    pin_settings(out, run_directory, simulator, {"config": config}, about, file="judge.json")
    if user_file is not None:
        write_file(out / USER_FILE, user_file.read_bytes())
    about_policies = {"robot": robot.name, "task": config.task.name}
    with step("policies") as report:
        train_ladder(out / "policies", truth.demonstrations, config.ladder, config.seed, about_policies, report)
    head = _find_head(out / "head", truth, simulator, success)
    starts = truth.starts()
    acting: dict[str, Policy] = dict(user_policies)  # programs compiled for one world serve the next
    with truth.open() as true:
        for world, name in itertools.product(truth.worlds, policies):
            path = _place(out, name, world)
            if not path.exists():
                path.parent.mkdir(parents=True, exist_ok=True)
                policy = acting[name] = acting.get(name) or find_policy(out / "policies", name, robot, simulator)
                with step(f"{name} in the {world} world") as report:
                    made = run(
                        true if world == TRUE else simulator, policy, starts, config.seeds, config.task,
                        shuffled=world == SHUFFLED, report=report,
                    )  # fmt: skip
                save_rollout(made, path)
    return _collect(out, truth, head, policies, tuple(user_policies), starts)


def _collect(
    out: Path,
    truth: GroundTruth,
    head: Head,
    policies: Sequence[str],
    user_policies: tuple[str, ...],
    starts: Sequence[Start],
) -> Judgement:
    config, numbers = truth.config, [start.seed if start.seed is not None else -1 for start in starts]
    outcomes, seconds, clipped = [], {}, {}
    for world in truth.worlds:
        times = []
        for name in policies:
            rollout = load_rollout(_place(out, name, world))
            times.append(rollout.seconds)
            outcomes += judge_rollout(rollout, head, config.task, name, world, numbers, config.seeds)
            if world == LEARNED:
                clipped[name] = _clipped_share(rollout.actions, truth.robot)
        seconds[world] = float(np.median(np.concatenate(times)))  # the first call compiles
    rollouts = lambda name, world: load_rollout(_place(out, name, world))  # noqa: E731
    return Judgement(
        config, head, tuple(policies), user_policies, truth.worlds, tuple(outcomes), clipped, seconds, rollouts
    )


def _clipped_share(actions: np.ndarray, robot: Robot) -> float:
    """The share of actions [..., A] with a value outside the robot's range, to which it is then clipped."""
    low, high = np.array(robot.low, np.float32), np.array(robot.high, np.float32)
    return float(((actions < low) | (actions > high)).any(-1).mean())


def _place(out: Path, name: str, world: str) -> Path:
    return out / "rollouts" / f"{name}.{world}.npz"


def _find_head(directory: Path, truth: GroundTruth, simulator: Simulator, user_success: UserSuccess | None) -> Head:
    reconstruct = simulator.tokenizer.reconstruct
    if user_success is not None:
        kept = directory / MEASURED
        if not kept.exists():
            directory.mkdir(parents=True, exist_ok=True)
            write_file(kept, json.dumps(truth.measure(user_success, reconstruct), indent=1) + "\n")
        user_success.measured |= read_json(kept, "remove it to have the accuracy measured again")
        return user_success
    if (directory / HEAD_DESCRIPTION).exists():
        return load_head(directory)
    head = truth.make_head(reconstruct)
    head.measured |= truth.measure(head, reconstruct)
    save_head(head, directory)
    return head
