"""HMA itself as a policy, beside behaviour cloning and a Diffusion Policy.

Question: how good is the model's own action head in closed loop, in the true simulator and past its window?
Paper: paper section 3.1, policies as one of the settings that the model is trained in.
Command: python -m experiments.applications.own_policy
Cost: forty minutes of one core; continues where it was stopped.
Expected: well above random actions; no better than policies that are made only for this task.

The world model gets action heads and is post-trained, all of it, to predict what an expert does next (`masking.setting`
is policy). The others are trained on the same episodes. All begin at the same starts, which are in no recording.
`--policies` takes some of them; with `--predicts chunk` the Diffusion Policy predicts the clean chunk of actions
instead of the noise in it, with `--limits spread` it gives no action beyond three standard deviations.

Writes to OUT: trials.csv, a row per policy and start; summary.csv and table.md, success with intervals over starts;
run, the post-trained model, and its tokenizer: a policy, no longer a simulator.
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
from tyro.conf import Positional, arg

from experiments.applications import FIRST
from experiments.applications.judging.agreement import rate_interval
from experiments.applications.policies.cloning import BcConfig, clone
from experiments.applications.policies.closed_loop import run_policy, start_seeds
from experiments.applications.policies.demonstrations import (
    Demonstrations,
    load_demonstrations,
    record,
    save_demonstrations,
)
from experiments.applications.policies.diffusion import DiffusionConfig, Limits, Predicts, train_diffusion
from experiments.applications.policies.learning import FitConfig, Report
from experiments.applications.policies.network import require_multiples
from experiments.applications.policies.own_head import OwnHeadPolicy
from experiments.applications.policies.policy import Policy, RandomPolicy
from experiments.applications.policies.tasks import Task, find_task
from experiments.applications.settings_file import pin_settings
from experiments.running.workspace import Workspace
from experiments.simulators import load_simulator
from experiments.tables import make_once, write_table
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.progress import step, wrote
from hma_jax.config import ExecutionConfig, MaskingConfig, ModelConfig, OptimizerConfig, TrainConfig, require
from hma_jax.config.base import later, require_choice
from hma_jax.model.hma import declare_model
from hma_jax.model.params import Params, path_name
from hma_jax.runtime.files import write_file
from hma_jax.simulator.folder import TOKENIZER
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.tokenizers.io import save_tokenizer
from hma_jax.training.runs import Model, load_model
from hma_jax.training.train import train_model

OUT = Path("runs/own_policy")
OWN, CLONED, DIFFUSION, RANDOM = "HMA's own action head", "behaviour cloning", "Diffusion Policy", "random actions"
POLICIES = OWN, CLONED, DIFFUSION, RANDOM
ALL = f"(default: all: {', '.join(POLICIES)})"
NAMES = ("policy", "start", "success", "distance")


@dataclass(frozen=True)
class Settings:
    """Everything that the results depend on besides the world model."""

    robot: str = "pusher_sand"
    task: str = "reach"
    frames: int = 20  # frames of an episode: more than the model's window
    hold: int = 4
    demonstrations: int = 1500
    noise: float = 0.1  # noise of the expert
    starts: int = 100
    steps: int = 3000  # steps of training, for every policy
    batch: int = 12  # windows of the model
    learning_rate: float = 1e-3
    predicts: Predicts = later("noise")  # of the Diffusion Policy, like the next
    limits: Limits = later("range", before="spread")
    seed: int = 0

    def __post_init__(self):
        require(self.steps >= 1, f"--steps must be at least 1, got {self.steps}")
        require(self.starts >= 1, f"--starts must be at least 1, got {self.starts}")
        require(self.demonstrations >= 1, f"--demonstrations must be at least 1, got {self.demonstrations}")

    def make_task(self) -> Task:
        return find_task(self.robot, self.task, self.frames, self.hold)


def windows(
    tokens: np.ndarray, demos: Demonstrations, model: Model, robot: Robot, batch: int, seed: int
) -> Callable[[int], Iterator[dict[str, np.ndarray]]]:
    """make_batches(start): random windows of tokens [N, L, ...] with their actions; a function of seed and step."""
    (episodes, longest), frames = tokens.shape[:2], model.config.frames
    chunks = np.tile(demos.actions, robot.stride)  # an action is held for the whole frame
    chunks = np.pad(chunks, [(0, 0), (0, 0), (0, model.table.action_width - chunks.shape[-1])])
    embodiment = model.table.index(robot.name)

    def make(start: int) -> Iterator[dict[str, np.ndarray]]:
        number = start
        while True:
            rng = np.random.default_rng([seed, number])
            episode = rng.integers(episodes, size=(batch, 1))
            at = rng.integers(longest - frames + 1, size=(batch, 1)) + np.arange(frames)
            yield {
                "tokens": tokens[episode, at], "actions": chunks[episode, at],
                "embodiment": np.full(batch, embodiment, np.int32),
            }  # fmt: skip
            number += 1

    return make


def with_heads(model: Model, seed: int) -> tuple[Params, ModelConfig]:
    """(parameters, configuration) of a model with the same frame predictions and with untrained action heads."""
    config = replace(model.config, action_heads=True)
    known = {path_name(path): x for path, x in jax.tree_util.tree_leaves_with_path(model.params)}
    fresh = declare_model(config, model.table).init(seed)
    return jax.tree_util.tree_map_with_path(lambda path, x: known.get(path_name(path), x), fresh), config


def post_train(
    simulator: Simulator, robot: Robot, demos: Demonstrations, settings: Settings, run: Path, report: Report
) -> Model:
    """The world model as a policy, trained or further trained in `run`, with its tokenizer beside it."""
    model, tokenizer = simulator.model, simulator.tokenizer
    flat = demos.images.reshape(-1, *demos.images.shape[2:])
    tokens = np.concatenate([np.asarray(tokenizer.encode(flat[i : i + 256])) for i in range(0, len(flat), 256)])
    tokens = tokens.reshape(*demos.images.shape[:2], *tokens.shape[1:])
    params, config = with_heads(model, settings.seed)
    make = windows(tokens, demos, model, robot, settings.batch, settings.seed)
    warmup = min(100, settings.steps // 4)
    optimizer = OptimizerConfig(learning_rate=settings.learning_rate, warmup_steps=warmup, schedule="wsd")
    training = TrainConfig(
        steps=settings.steps, batch=settings.batch, optimizer=optimizer, seed=settings.seed, ema_decay=0.99,
        masking=MaskingConfig(setting="policy"),
    )  # fmt: skip
    execution = ExecutionConfig(remat="none")
    train_model(
        config, model.table, training, make, run_dir=run, initial=params, execution=execution,
        provenance={"data": f"demonstrations of {settings.robot}, {settings.task}", "tokenizer": tokenizer.identity},
        progress=lambda done, total, values: report(done, total, ""),
    )  # fmt: skip
    save_tokenizer(tokenizer, run / TOKENIZER)
    return load_model(run, execution)


def make_policy(
    name: str, simulator: Simulator, robot: Robot, demos: Demonstrations, settings: Settings, out: Path, report: Report
) -> Policy:
    fit = FitConfig(settings.steps)
    if name == OWN:
        model = post_train(simulator, robot, demos, settings, out / "run", report)
        return OwnHeadPolicy(model, simulator.tokenizer, robot)
    if name == CLONED:
        return clone(demos, BcConfig(frames=1, fit=fit), settings.seed, report)
    if name == DIFFUSION:
        config = DiffusionConfig(frames=1, predicts=settings.predicts, limits=settings.limits, fit=fit)
        return train_diffusion(demos, config, settings.seed, report)[settings.steps]
    return RandomPolicy(robot)


def read_trials(path: Path) -> dict[str, list[tuple[bool, float]]]:
    """{policy: (success, distance) of each start} of trials.csv."""
    trials: dict[str, list[tuple[bool, float]]] = {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            trials.setdefault(row["policy"], []).append((row["success"] == "1", float(row["distance"])))
    return trials


def summarise(trials: Mapping[str, list[tuple[bool, float]]]) -> list[tuple[str, float, float, float]]:
    """(policy, success, its 95 % interval) over starts."""
    rates = {name: rate_interval(np.array([success for success, _ in ends])) for name, ends in trials.items()}
    return [(name, rate.mean, rate.low, rate.high) for name, rate in rates.items()]


def markdown(rows: list[tuple[str, float, float, float]]) -> str:
    """The table that docs/policies.md shows."""
    lines = ["| policy | success | 95 % interval |", "|---|---|---|"]
    lines += [f"| {name} | {mean:.2f} | {low:.2f} to {high:.2f} |" for name, mean, low, high in rows]
    return "\n".join(lines) + "\n"


def compare(
    run: Path, out: Path, settings: Settings, policies: Collection[str] = POLICIES
) -> dict[str, list[tuple[bool, float]]]:
    """What `read_trials` reads, for `policies` and for those in `out`, where every policy's outcomes are kept and made
    once. Raises ConfigError if they were made with other settings, and for a model that sees more frames than there are
    to train it on."""
    simulator = load_simulator(run)
    robot, size, task = simulator.robot(settings.robot), simulator.tokenizer.image_size, settings.make_task()
    window = simulator.model.config.frames
    require(
        window <= settings.frames,
        f"{run} has a window of {window} frames, but an episode here has only {settings.frames}, so there are no "
        "windows to train on; give a run with a shorter window",
    )
    require_multiples(*simulator.tokenizer.image_shape, BcConfig().encoder.size)
    pin_settings(out, run, simulator, settings, unused=("simulator.decode",))  # no frame is made
    seeds, kept = start_seeds(task, settings.starts), out / "demonstrations.npz"
    if not kept.exists():
        with step(f"record {settings.demonstrations} demonstrations"):
            made = record(
                task, settings.demonstrations, stride=robot.stride, image_size=size, noise=settings.noise,
                only_successes=True, seed=settings.seed,
            )  # fmt: skip
        save_demonstrations(made, kept)
    demos, trials = load_demonstrations(kept), {}

    def run_new(name: str) -> tuple[list[bool], list[float]]:
        with step(name) as report:
            policy = make_policy(name, simulator, robot, demos, settings, out, report)
            outcome = run_policy(task, policy, seeds, size, robot.stride)
        return outcome.success.tolist(), outcome.distance.tolist()

    for name in POLICIES:
        path = out / "outcomes" / f"{name.replace(' ', '_')}.json"
        if name in policies or path.exists():
            trials[name] = list(zip(*make_once(path, run_new, name), strict=True))
    return trials


def write_results(trials: Mapping[str, list[tuple[bool, float]]], out: Path) -> None:
    rows = [[name, k, int(s), f"{d:.4f}"] for name, outcomes in trials.items() for k, (s, d) in enumerate(outcomes)]
    write_table(out / "trials.csv", NAMES, rows)
    summary = summarise(trials)
    cells = [[name, *(f"{x:.4f}" for x in numbers)] for name, *numbers in summary]
    write_table(out / "summary.csv", ("policy", "mean", "low", "high"), cells)
    write_file(out / "table.md", markdown(summary))
    print(markdown(summary))


def compare_in_run(
    run: Annotated[Positional[Path], arg(metavar="RUN")] = FIRST,
    out: Annotated[Path, arg(metavar="DIR")] = OUT,
    steps: int = Settings.steps,
    starts: int = Settings.starts,
    demonstrations: int = Settings.demonstrations,
    predicts: Predicts = Settings.predicts,
    limits: Limits = Settings.limits,
    policies: Annotated[tuple[str, ...], arg(metavar="POLICY ...", help_behavior_hint=ALL)] = POLICIES,
) -> None:
    """Trains the policies and runs them in the true simulator.

    Args:
        run: Directory of a training run.
        out: Directory for everything that is written.
        steps: Training steps of each policy.
        starts: Number of starts, the same for every policy.
        demonstrations: Episodes of the scripted expert that the policies are trained on.
        predicts: What the Diffusion Policy's network predicts: the noise, or the chunk of actions without noise.
        limits: Limits of the Diffusion Policy's actions. range: the smallest and largest demonstrated values. spread:
            three standard deviations.
        policies: Policies to compare, each in quotation marks.
    """
    require(bool(policies), "--policies needs at least one name")
    for policy in policies:
        require_choice(policy, POLICIES, "--policies")
    settings = Settings(steps=steps, starts=starts, demonstrations=demonstrations, predicts=predicts, limits=limits)
    with Workspace(out).locked():
        write_results(compare(run, out, settings, policies), out)
        wrote(out / "trials.csv", out / "summary.csv", out / "table.md")


def main() -> None:
    run_module(compare_in_run, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
