"""How useful a learned simulator is to a planner.

Question: does a planner that looks ahead in the model reach goals in the true simulator?
Paper: left for future work there.
Command: python -m experiments.applications.plan_actions RUN
Cost: half an hour of one core, an hour for the served model; continues where it was stopped.
Expected: planning in the model comes close to planning in the true simulator, and both are above cloned and random
          actions.

The goal is an image: the last frame of an expert that began at the same start. At every second frame the planner
observes, searches and executes two actions. The cross-entropy method (CEM), MPPI and random shooting look ahead equally
often, in the learned simulator; the upper bound is CEM that looks ahead in the true one. Success is that of the task,
by the true simulator's state. The cloned policies were trained on trajectories of an expert at this task; they see the
mark in the frame and are given no image of the goal.

Writes to OUT: trials.csv, a row per way of acting and start; summary.csv and table.md; planning.png. `distance` is that
from the goal at the end of an episode: a planner's episode ends once its outcome is decided, an episode of a cloned
policy or of random actions with the last frame.
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from data_pipelines.sources.rlds.images import fit_image
from data_pipelines.suite.environment import Environment
from data_pipelines.suite.world import World
from experiments.analysis.intervals import Interval
from experiments.applications import FIRST
from experiments.applications.judging.agreement import rate_interval
from experiments.applications.planning.cem import plan_cem
from experiments.applications.planning.control import Planner, Search
from experiments.applications.planning.goals import goal_image_cost
from experiments.applications.planning.models import LearnedModel, Model, TrueModel
from experiments.applications.planning.mppi import plan_mppi
from experiments.applications.planning.search import SearchConfig
from experiments.applications.planning.shooting import plan_shooting
from experiments.applications.policies.cloning import BcConfig, clone
from experiments.applications.policies.closed_loop import goal_distance, run_policy, start_seeds
from experiments.applications.policies.demonstrations import record
from experiments.applications.policies.learning import FitConfig, Report
from experiments.applications.policies.policy import Policy, RandomPolicy
from experiments.applications.policies.scripted import make_expert, noisy
from experiments.applications.policies.tasks import Task, find_task, held, world_of
from experiments.applications.settings_file import pin_settings
from experiments.running.workspace import Workspace
from experiments.simulators import load_simulator
from experiments.tables import make_once, write_table
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.progress import Eta, say, step, wrote
from hma_jax.config import require
from hma_jax.config.base import require_choice
from hma_jax.runtime.files import write_file
from hma_jax.simulator.folder import change_decode, find_decode
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator

OUT = Path("runs/planning")

PLANNERS: dict[str, tuple[Search, str]] = {
    "CEM in the true simulator": (plan_cem, "true"),
    "CEM in the model": (plan_cem, "learned"),
    "random shooting in the model": (plan_shooting, "learned"),
    "MPPI in the model": (plan_mppi, "learned"),
}
CLONED = {f"behaviour cloning of {n} trajectories": n for n in (100, 1000)}
RANDOM = "random actions"
WAYS = (*PLANNERS, *CLONED, RANDOM)
ALL = f"(default: all: {', '.join(WAYS)})"
NAMES = ["way", "start", "success", "distance", "seconds_per_plan"]


@dataclass(frozen=True)
class Settings:
    """Everything that the results depend on besides the world model."""

    robot: str = "pusher_sand"
    task: str = "reach"
    frames: int = 16
    hold: int = 6  # frames in a row at the goal, for success
    starts: int = 30
    skip: int = 0  # number of the task's starts to skip, so that the starts differ from an earlier run's
    execute: int = 2  # frames from one plan to the next
    unmask_steps: int = 2  # unmasking steps per frame: fewer than for viewing, and cheaper in proportion
    temperature: float = 0.0  # of sampling, whatever the run's decode.json says; 0: greedy
    search: SearchConfig = field(default_factory=SearchConfig)
    steps: int = 2000  # of training of the cloned policies
    batch: int = 32
    learning_rate: float = 2e-3
    seed: int = 0  # of the training of the cloned policies

    def __post_init__(self):
        most = self.search.frames
        require(1 <= self.execute <= most, f"--execute must lie in 1..{most}, the frames of a plan, got {self.execute}")
        require(
            self.frames > self.hold,
            f"--frames must be more than the {self.hold} in a row at the goal that make success, or an episode is decided "
            f"before the first plan; got {self.frames}",
        )
        require(self.starts >= 1, f"--starts must be at least 1, got {self.starts}")
        require(self.skip >= 0, f"--skip must not be negative, got {self.skip}")

    def make_task(self) -> Task:
        return find_task(self.robot, self.task, self.frames, self.hold)

    def start_seeds(self) -> np.ndarray:
        """int64 [starts]: seeds of starts that are in no recording."""
        return start_seeds(self.make_task(), self.skip + self.starts)[self.skip :]


def goal_image(task: Task, seed: int, size: int, stride: int) -> np.ndarray:
    """uint8 [H, W, 3]: the frame in which an expert without noise ends, from this start."""
    return fit_image(expert_end(task, seed, stride).render(), size)


def expert_end(task: Task, seed: int, stride: int) -> Environment:
    """Where an expert without noise ends if it has twice the time of an episode."""
    spec = noisy(task, 0.0)
    world, seen = World(spec, [seed]), Environment(spec)
    expert = make_expert(world, 0)
    for _ in range(2 * task.frames * stride):
        world.step(expert.act().astype(np.float64))
    seen.set_state(world.state)
    return seen


def run_planner(way: str, simulator: Simulator, robot: Robot, settings: Settings, seed: int) -> dict:
    """One episode, until it is decided: {success, distance then, seconds of a plan}."""
    task, environment = settings.make_task(), Environment(settings.make_task().spec)
    environment.reset(seed)
    (search, where), size, short = PLANNERS[way], simulator.tokenizer.image_size, seed % 2**32
    model: Model = TrueModel(task.spec, robot, size)
    if where == "learned":
        model = LearnedModel(simulator, robot, short)
    cost = goal_image_cost(goal_image(task, seed, size, robot.stride))
    planner = Planner(search, settings.search, model, robot, cost, short)
    images, actions, reached, seconds = [fit_image(environment.render(), size)], [], [environment.success()], []
    remaining: list[np.ndarray] = []
    while not decided(reached, task):
        if not remaining:
            began = time.perf_counter()
            model.observe(images, actions, environment.get_state())
            remaining = list(planner.plan(settings.execute))
            seconds.append(time.perf_counter() - began)
        actions.append(remaining.pop(0))
        for _ in range(robot.stride):
            environment.step(actions[-1])
        images.append(fit_image(environment.render(), size))
        reached.append(environment.success())
    success = bool(held(np.array([reached]), task.hold).any())
    distance = goal_distance(world_of(task.spec, [environment.get_state()]))
    return {"success": success, "distance": float(distance[0]), "seconds": float(np.median(seconds))}


def decided(reached: Sequence[bool], task: Task) -> bool:
    """Whether the goal was held long enough, or too few frames are left to hold it."""
    run = next((i for i, done in enumerate(reversed(reached)) if not done), len(reached))
    return run >= task.hold or task.frames - len(reached) < task.hold - run


def run_cloned(settings: Settings, robot: Robot, seeds: np.ndarray, size: int, way: str, report: Report) -> list[dict]:
    """Runs the same starts under a policy that does not plan."""
    task = settings.make_task()
    policy: Policy = RandomPolicy(robot)
    if way in CLONED:
        demos = record(task, CLONED[way], stride=robot.stride, image_size=size, only_successes=True)
        fit = FitConfig(settings.steps, settings.batch, settings.learning_rate, ema=0.98)
        policy = clone(demos, BcConfig(frames=1, fit=fit), settings.seed, report)
    outcome = run_policy(task, policy, seeds, size, robot.stride)
    return [
        {"success": bool(s), "distance": float(d), "seconds": 0.0}
        for s, d in zip(outcome.success, outcome.distance, strict=True)
    ]


def outcome_paths(out: Path, way: str, starts: int) -> list[Path]:
    """The files of the outcomes: for a planner one for each start, otherwise one for all."""
    name = out / "trials" / way.replace(" ", "_")
    return [Path(f"{name}-{k}.json") for k in range(starts)] if way in PLANNERS else [Path(f"{name}.json")]


def compare(run: Path, out: Path, settings: Settings, wanted: Collection[str]) -> dict[str, list[dict]]:
    """What `read_trials` reads, for the ways of acting `wanted` and for those in `out`, where all outcomes are kept and
    made once. Raises ConfigError if they were made with other settings."""
    decode = change_decode(find_decode(run), settings.temperature, unmask_steps=settings.unmask_steps)
    simulator = load_simulator(run, episodes=settings.search.candidates, decode=decode, history=1)
    robot, size = simulator.robot(settings.robot), simulator.tokenizer.image_size
    seeds = settings.start_seeds()
    pin_settings(out, run, simulator, settings)
    paths = {way: outcome_paths(out, way, settings.starts) for way in WAYS}
    tried = [way for way in WAYS if way in wanted or all(path.exists() for path in paths[way])]
    trials: dict[str, list[dict]] = {way: [] for way in tried}
    for way in (way for way in tried if way not in PLANNERS):
        with step(way) as update:
            trials[way] = make_once(paths[way][0], run_cloned, settings, robot, seeds, size, way, update)
    planners, eta = [way for way in tried if way in PLANNERS], Eta()
    if planners:
        say_missed_goals(settings, robot, seeds)
        with step(f"{', '.join(planners)}: {settings.starts} episodes each") as update:
            for k, seed in enumerate(seeds.tolist()):
                for way in planners:
                    trials[way].append(make_once(paths[way][k], run_planner, way, simulator, robot, settings, seed))
                update(k + 1, len(seeds), f"starts{eta(k + 1, len(seeds))}")
    return trials


def say_missed_goals(settings: Settings, robot: Robot, seeds: np.ndarray) -> None:
    """Prints a note if an expert from these starts does not end at its goal."""
    missed = sum(not expert_end(settings.make_task(), seed, robot.stride).success() for seed in seeds.tolist())
    if missed:
        say(f"note: {missed} of {len(seeds)} pictures of the goal do not show success: the expert does not end at it")


def summarise(trials: Mapping[str, Sequence[dict]]) -> list[tuple[str, Interval, float]]:
    """Success of each way of acting, over its starts, and seconds per plan (median over starts)."""
    rates = [rate_interval(np.array([t["success"] for t in outcomes], float)) for outcomes in trials.values()]
    seconds = [float(np.median([t["seconds"] for t in outcomes])) for outcomes in trials.values()]
    return list(zip(trials, rates, seconds, strict=True))


def write_results(trials: Mapping[str, Sequence[dict]], out: Path) -> None:
    rows = [
        [way, k, int(t["success"]), f"{t['distance']:.4f}", f"{t['seconds']:.4f}"]
        for way, outcomes in trials.items()
        for k, t in enumerate(outcomes)
    ]
    write_table(out / "trials.csv", NAMES, rows)
    summary = summarise(trials)
    cells = [[way, *(f"{x:.4f}" for x in (r.mean, r.low, r.high, seconds))] for way, r, seconds in summary]
    write_table(out / "summary.csv", ["way", "mean", "low", "high", "seconds_per_plan"], cells)
    write_file(out / "table.md", markdown(summary))
    draw(summary, out / "planning.png")


def markdown(summary: Sequence[tuple[str, Interval, float]]) -> str:
    """The table that docs/planning.md shows."""
    lines = ["| acting | success | 95 % interval | seconds per plan |", "|---|---|---|---|"]
    for way, r, seconds in summary:
        took = f"{seconds:.1f}" if seconds else ""
        lines.append(f"| {way} | {r.mean:.2f} | {r.low:.2f} to {r.high:.2f} | {took} |")
    return "\n".join(lines) + "\n"


def read_trials(path: Path) -> dict[str, list[dict]]:
    """What trials.csv says."""
    trials: dict[str, list[dict]] = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            success, (distance, seconds) = row["success"] == "1", (float(row[name]) for name in NAMES[3:])
            trials.setdefault(row["way"], []).append({"success": success, "distance": distance, "seconds": seconds})
    return trials


def draw(summary: Sequence[tuple[str, Interval, float]], path: Path) -> None:
    """Success by way of acting, with its interval."""
    from experiments.report.plot_style import COLOURS, INK, MUTED, STYLE, plt, save

    with plt.rc_context(STYLE):
        figure, panel = plt.subplots(figsize=(6.4, 2.9), layout="constrained")
        places, mean = np.arange(len(summary))[::-1], np.array([r.mean for _, r, _ in summary])
        low, high = (np.array([getattr(r, end) for _, r, _ in summary]) for end in ("low", "high"))
        colours = [COLOURS["perplexity"] if "in the model" in way else MUTED for way, _, _ in summary]
        panel.barh(places, mean, color=colours, height=0.62)
        panel.errorbar(mean, places, xerr=[mean - low, high - mean], fmt="none", color=INK, capsize=3)
        panel.set_yticks(places, [way for way, _, _ in summary])
        panel.set(xlim=(0, 1), xlabel="success in the true simulator")
        panel.grid(False, axis="y")
        save(figure, path)


def plan_in_run(
    run: Annotated[Positional[Path], arg(metavar="RUN")] = FIRST,
    out: Annotated[Path, arg(metavar="DIR")] = OUT,
    robot: str = Settings.robot,
    task: Literal["own", "reach", "hover"] = Settings.task,
    frames: int = Settings.frames,
    starts: int = Settings.starts,
    skip: int = Settings.skip,
    seed: int = Settings.seed,
    ways: Annotated[tuple[str, ...], arg(metavar="WAY ...", help_behavior_hint=ALL)] = WAYS,
    execute: int = Settings.execute,
    candidates: int = SearchConfig.candidates,
    iterations: int = SearchConfig.iterations,
    unmask_steps: Annotated[int, arg(name="unmask-steps", metavar="M")] = Settings.unmask_steps,
    temperature: float = Settings.temperature,
) -> None:
    """Plans in a model and in the true simulator, and compares how often the goal is reached.

    Args:
        run: Directory of a training run.
        out: Directory for everything that is written.
        robot: One of the model's robots, with a true simulator.
        task: own: the robot's own task. reach: bring the tool to the mark. hover: hold the tool above a puck.
        frames: Length of an episode, in frames of the model.
        starts: Number of starts, the same for every way of acting.
        skip: Starts to leave out before the first, for others than an earlier run had.
        seed: Random seed of the cloned policies' training.
        ways: Ways of acting to compare, each in quotation marks.
        execute: Frames from one plan to the next.
        candidates: Sequences of actions that the model predicts in one batch.
        iterations: Batches of sequences for a plan.
        unmask_steps: Unmasking steps per frame; more are slower.
        temperature: Temperature at which tokens or latents are sampled; 0: greedy decoding.
    """
    require(bool(ways), "--ways needs at least one name")
    for way in ways:
        require_choice(way, WAYS, "--ways")
    fewest = SearchConfig.elites  # whom CEM draws around
    require(candidates >= fewest, f"--candidates must be at least {fewest}, got {candidates}")
    settings = Settings(
        robot=robot,
        task=task,
        frames=frames,
        starts=starts,
        skip=skip,
        execute=execute,
        unmask_steps=unmask_steps,
        temperature=temperature,
        search=SearchConfig(candidates=candidates, iterations=iterations),
        seed=seed,
    )
    with Workspace(out).locked():
        write_results(compare(run, out, settings, ways), out)
        wrote(out / "trials.csv", out / "summary.csv", out / "table.md", out / "planning.png")


def main() -> None:
    run_module(plan_in_run, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
