"""What generated trajectories are worth to a policy.

Question: is a policy that was trained on 10 recorded and 90 generated trajectories as good as one on 100 recorded?
Paper: Table 6.
Command: python -m experiments.applications.synthetic
Cost: half an hour of one core; goes on where it was stopped.
Expected: success grows with the generated trajectories; those of a model that is given other actions do not help.

The 100 trajectories are an expert's, from starts that the world model never saw. For each seed ten of them are kept as
recorded; of the others the actions are kept, and replayed from their own first frame in the learned simulator. Policies
are trained on what it shows, not on that frame. Control: the same simulator under another trajectory's actions, so that
pictures and actions do not belong together. All policies are trained alike (behaviour cloning, as many steps), and
judged from the same starts in the true simulator.

The error is that of a policy's actions in held-out recordings, mean squared, in standard deviations.

Writes to OUT: trials.csv, a row per policy and start; errors.csv, one per policy and held-out trajectory; summary.csv
and table.md; synthetic.png; frames.png.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from data_pipelines.publishing.files import write_file
from experiments.analysis.bootstrap import Panel, bootstrap_intervals
from experiments.applications import SHIPPED
from experiments.applications.generating.conditions import (
    ALL,
    CONDITIONS,
    CONTROL,
    ERRORS,
    FEW,
    KINDS,
    MOST,
    TRIALS,
    Condition,
    Trials,
    markdown,
    summarise,
    write_tables,
)
from experiments.applications.generating.figures import draw_conditions, draw_strips
from experiments.applications.generating.source import replay
from experiments.applications.generating.trajectories import Trajectory
from experiments.applications.made_with import claim, write_settings
from experiments.applications.policies.acting import Scale, scale_of
from experiments.applications.policies.cloning import BcConfig, clone
from experiments.applications.policies.closed_loop import MOST_TRIED, away_at_start, run_policy, start_seeds
from experiments.applications.policies.demonstrations import (
    Demonstrations,
    join,
    load_demonstrations,
    record,
    save_demonstrations,
)
from experiments.applications.policies.learning import FitConfig
from experiments.applications.policies.policy import Policy
from experiments.applications.policies.tasks import Task, find_task
from experiments.applications.simulators import load_simulator
from experiments.applications.tables import write_table
from experiments.progress import Pace, step
from experiments.wrote import wrote
from hma_jax.config import require
from hma_jax.evaluation.metrics import psnr
from hma_jax.simulator.simulator import Simulator

OUT = Path("runs/synthetic")

BATCH = 8


@dataclass(frozen=True)
class Settings:
    """All that the results depend on besides the world model."""

    robot: str = "gripper_wood"
    task: str = "hover"
    frames: int = 14
    hold: int = 6  # frames in a row at the goal, for success
    least: float = 0.5  # from the goal, that an episode begins, in halves of the floor's side
    noise: float = 0.05  # of the expert
    trajectories: int = 100
    starts: int = 200
    seeds: tuple[int, ...] = (0, 1, 2)
    steps: int = 2000  # of training, of every policy
    batch: int = 32
    learning_rate: float = 2e-3
    given: int = 1  # recorded frames that a generated trajectory begins with
    with_given: bool = False  # policies are trained on these, too

    def make_task(self) -> Task:
        return find_task(self.robot, self.task, self.frames, self.hold)


def make_data(settings: Settings, simulator: Simulator, out: Path) -> dict[str, Demonstrations]:
    """The 100 trajectories as recorded, generated, and generated under shuffled actions; made once, kept in `out`."""
    sets, size = {kind: out / f"{kind}.npz" for kind in KINDS}, simulator.tokenizer.image_size
    stride = simulator.robot(settings.robot).stride
    if not sets["recorded"].exists():
        with step(f"record {settings.trajectories} trajectories"):
            save_demonstrations(record_far(settings, stride, size), sets["recorded"])
    recorded = load_demonstrations(sets["recorded"])
    for kind, shift in (("generated", 0), ("shuffled", 1)):
        if not sets[kind].exists():
            with step(f"replay actions: {kind}") as update:
                actions = np.roll(recorded.actions, shift, 0)
                images = imagine(simulator, settings.robot, recorded, actions, settings.given, update)
            save_demonstrations(replace(recorded, images=images), sets[kind])
    held_out = out / "held_out.npz"
    if not held_out.exists():
        save_demonstrations(record_far(settings, stride, size, seed=1), held_out)
    return {kind: load_demonstrations(path) for kind, path in {**sets, "held_out": held_out}.items()}


def record_far(settings: Settings, stride: int, image_size: int, seed: int = 0) -> Demonstrations:
    """Successes of the expert that begin far enough from the goal."""
    task = settings.make_task()
    count = MOST_TRIED * settings.trajectories
    how = {"noise": settings.noise, "only_successes": True, "stride": stride, "image_size": image_size}
    made = record(task, count, seed=seed, **how)
    far = np.flatnonzero(away_at_start(task, made.seeds) >= settings.least)[: settings.trajectories]
    enough = len(far) == settings.trajectories
    require(enough, f"{task.robot}: hardly an episode begins {settings.least:g} from its goal")
    return made.take(far)


def imagine(
    simulator: Simulator, robot: str, demos: Demonstrations, actions: np.ndarray, given: int, update
) -> np.ndarray:
    """Images as `demos` has them, [N, L, H, W, 3], after the `given` ones the simulator's under `actions` [N, L, A]."""
    driven, made = simulator.robot(robot), []
    for first in range(0, len(demos), len(simulator)):
        rows = range(first, min(first + len(simulator), len(demos)))
        batch = [Trajectory(str(i), demos.images[i], np.repeat(actions[i][:, None], driven.stride, 1)) for i in rows]
        made += replay(simulator, driven, batch, list(rows), given)
        update(len(made), len(demos), "trajectories")
    return np.stack(made)


def choose(condition: Condition, data: Mapping[str, Demonstrations], seed: int, dropped: int) -> Demonstrations:
    """What one policy is trained on, of generated trajectories without the first `dropped` frames. For one seed fewer
    trajectories are among the more."""
    order = np.random.default_rng([seed, 21]).permutation(len(data["recorded"]))
    kept, others = order[: condition.recorded], order[condition.recorded : condition.recorded + condition.generated]
    parts = [data["recorded"].take(kept)]
    return join([*parts, without_first(data[condition.more].take(others), dropped)] if len(others) else parts)


def without_first(demos: Demonstrations, frames: int) -> Demonstrations:
    """What follows the first frames."""

    def later(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x[:, frames:], np.zeros_like(x[:, :frames])], 1)

    shifted = {name: later(getattr(demos, name)) for name in ("images", "actions", "reached")}
    return replace(demos, lengths=demos.lengths - frames, **shifted)


def run_trial(
    settings: Settings, condition: Condition, data: Mapping[str, Demonstrations], stride: int, seed: int, update
) -> dict:
    """Trains one policy and judges it: {success, distance} by start, {error} by held-out trajectory."""
    dropped, task = 0 if settings.with_given else settings.given, settings.make_task()
    demos = choose(condition, data, seed, dropped)
    fit = FitConfig(settings.steps, settings.batch, settings.learning_rate, ema=0.98)
    policy = clone(demos, BcConfig(frames=1, fit=fit), seed, update)
    starts = start_seeds(task, settings.starts, least=settings.least)
    found = run_policy(task, policy, starts, demos.images.shape[2], stride)
    errors = action_errors(policy, data["held_out"], scale_of(data["recorded"]))
    return {
        "success": found.success.astype(int).tolist(),
        "distance": np.round(found.distance, 4).tolist(),
        "error": np.round(errors, 5).tolist(),
    }


def action_errors(policy: Policy, demos: Demonstrations, scale: Scale) -> np.ndarray:
    """float [N]: mean squared difference from the recorded actions of each trajectory, in standard deviations."""
    policy.reset()
    acted = np.stack([policy.act(demos.images[:, t]) for t in range(demos.images.shape[1])], 1)
    return ((scale.normalise(acted) - scale.normalise(demos.actions)) ** 2).mean((1, 2), dtype=np.float64)


def write_results(settings: Settings, trials: Trials, quality: dict, out: Path) -> None:
    write_tables(trials, settings.seeds, out)
    found = summarise(trials, settings.seeds)
    measured = [(f"{what}: {one.name}", getattr(one, what)) for what in ("success", "error") for one in found]
    lines = [[name, *(f"{x:.4f}" for x in (r.mean, r.low, r.high))] for name, r in measured]
    lines += [[f"PSNR of {kind}, dB", *(f"{x:.4f}" for x in three)] for kind, three in quality.items()]
    write_table(out / "summary.csv", ["what", "mean", "low", "high"], lines)
    write_file(out / "table.md", markdown(found))
    places = range(len(CONDITIONS))
    seeds = [[float(np.mean(trials[i, s]["success"])) for s in settings.seeds if (i, s) in trials] for i in places]
    named = {one.name: one.success for one in found[: len(CONDITIONS)]}
    draw_conditions(named, seeds, {CONTROL}, {FEW, ALL}, out / "synthetic.png")


def quality_of(data: Mapping[str, Demonstrations], given: int) -> dict[str, tuple[float, float, float]]:
    """PSNR in dB against the recording, of the frames after the given ones: mean, low and high over trajectories."""
    found = {}
    for kind in ("generated", "shuffled"):
        means = psnr(data[kind].images[:, given:], data["recorded"].images[:, given:]).mean(1)
        names, each = np.full(len(means), kind), np.arange(len(means))
        (interval,) = bootstrap_intervals(Panel(names, each, (means[None],), ((0,),)))
        found[kind] = interval.mean, interval.low, interval.high
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?", default=SHIPPED, help="directory of a training run")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--robot", default=Settings.robot)
    parser.add_argument("--task", default=Settings.task, help="hover, reach, or own: what its recordings do")
    parser.add_argument("--frames", type=int, default=Settings.frames, help="of an episode")
    parser.add_argument("--starts", type=int, default=Settings.starts)
    parser.add_argument("--seeds", type=int, default=len(Settings.seeds), help="how many")
    parser.add_argument("--steps", type=int, default=Settings.steps, help="of training, of every policy")
    parser.add_argument("--given", type=int, default=Settings.given, help="recorded frames that others begin with")
    parser.add_argument("--with-given", action="store_true", help="train on these, too")
    asked = vars(parser.parse_args())
    run, out, seeds = asked.pop("run"), asked.pop("out"), tuple(range(asked.pop("seeds")))
    settings = Settings(seeds=seeds, **asked)
    simulator = load_simulator(run, episodes=BATCH, history=1)
    stride = simulator.robot(settings.robot).stride  # a mistyped name claims nothing
    settings.make_task()
    claim(out, run, simulator.model.params, asdict(settings), grows=("seeds",))
    trials_dir = out / "trials"
    trials_dir.mkdir(exist_ok=True)
    data = make_data(settings, simulator, out)
    trials: Trials = {}
    first = sorted(range(len(CONDITIONS)), key=lambda i: i not in (FEW, ALL, MOST, CONTROL))  # what counts most
    jobs, pace = [(i, s) for i in first for s in settings.seeds], Pace()
    with step(f"train and judge {len(jobs)} policies") as update:
        for n, (i, seed) in enumerate(jobs):
            path = trials_dir / f"{i}-{seed}.json"
            if not path.exists():
                note = f"{CONDITIONS[i].name}, seed {seed}{pace(n, len(jobs))}"
                report = lambda done, total, said, note=note, n=n: update(n, len(jobs), f"{note}: step {done}, {said}")
                write_file(path, json.dumps(run_trial(settings, CONDITIONS[i], data, stride, seed, report)))
            trials[i, seed] = json.loads(path.read_text())
    write_results(settings, trials, quality_of(data, settings.given), out)
    write_settings(out, run, simulator.model.params, asdict(settings))
    draw_strips([data[kind].images[:2] for kind in KINDS], KINDS, out / "frames.png")
    wrote(out / TRIALS, out / ERRORS, out / "summary.csv", out / "table.md", out / "synthetic.png", out / "frames.png")


if __name__ == "__main__":
    main()
