"""What generated trajectories are worth to a policy.

Question: is a policy that was trained on 10 recorded and 90 generated trajectories as good as one on 100 recorded?
Paper: Table 6.
Command: python -m experiments.applications.synthetic
Cost: half an hour of one core; goes on where it was stopped.
Expected: success grows with the generated trajectories; those of a model that is given other actions do not help.

The 100 trajectories are an expert's, from starts that the world model never saw. For each seed ten of them are kept as
recorded; of the others the actions are kept, and replayed from their own first frames in the learned simulator.
Control: the same simulator under another trajectory's actions, so that pictures and actions do not belong together. All
policies are trained alike (behaviour cloning, as many steps), and judged from the same starts in the true simulator.

Writes to OUT: trials.csv, a row per policy and start; summary.csv and table.md; synthetic.png.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_pipelines.publishing.files import write_file
from experiments.analysis.bootstrap import Panel, bootstrap_intervals, resample
from experiments.analysis.intervals import Interval
from experiments.applications.generating.source import replay
from experiments.applications.generating.trajectories import Trajectory
from experiments.applications.policies.acting import scale_of
from experiments.applications.policies.cloning import BcConfig, ClonedPolicy, train_bc
from experiments.applications.policies.closed_loop import MOST_TRIED, away_at_start, run_policy, start_seeds
from experiments.applications.policies.demonstrations import (
    Demonstrations,
    join,
    load_demonstrations,
    record,
    save_demonstrations,
)
from experiments.applications.policies.learning import FitConfig
from experiments.applications.policies.tasks import Task, find_task
from experiments.applications.simulators import load_simulator
from experiments.applications.tables import write_table
from experiments.progress import Pace, step
from experiments.wrote import wrote
from hma_jax.config import require
from hma_jax.evaluation.metrics import psnr
from hma_jax.simulator.simulator import Simulator

RUN, OUT = Path("experiments/results/simulator"), Path("runs/synthetic")

BATCH, GIVEN = 8, 3


class Condition(NamedTuple):
    """What a policy is trained on: so many recorded trajectories, and so many of the kind `more`."""

    name: str
    recorded: int
    generated: int = 0
    more: str = "generated"


CONDITIONS = (
    Condition("10 recorded", 10),
    Condition("10 + 10 generated", 10, 10),
    Condition("10 + 50 generated", 10, 50),
    Condition("10 + 90 generated", 10, 90),
    Condition("10 + 90, other actions", 10, 90, "shuffled"),
    Condition("100 recorded", 100),
)
NAMES = ["condition", "recorded", "generated", "kind", "seed", "start", "success", "distance"]

FEW, MOST, CONTROL, ALL = 0, 3, 4, 5
"""Places in `CONDITIONS` that the share of the gap is made of."""


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

    def make_task(self) -> Task:
        return find_task(self.robot, self.task, self.frames, self.hold)


def make_data(settings: Settings, simulator: Simulator, out: Path) -> dict[str, Demonstrations]:
    """The 100 trajectories as recorded, generated, and generated under shuffled actions; made once, kept in `out`."""
    sets = {kind: out / f"{kind}.npz" for kind in ("recorded", "generated", "shuffled")}
    if not sets["recorded"].exists():
        with step(f"record {settings.trajectories} trajectories"):
            save_demonstrations(record_far(settings), sets["recorded"])
    recorded = load_demonstrations(sets["recorded"])
    for kind, shift in (("generated", 0), ("shuffled", 1)):
        if not sets[kind].exists():
            with step(f"replay actions: {kind}") as update:
                images = imagine(simulator, settings.robot, recorded, np.roll(recorded.actions, shift, 0), update)
            save_demonstrations(replace(recorded, images=images), sets[kind])
    return {kind: load_demonstrations(path) for kind, path in sets.items()}


def record_far(settings: Settings) -> Demonstrations:
    """Successes of the expert that begin far enough from the goal."""
    task = settings.make_task()
    made = record(task, MOST_TRIED * settings.trajectories, noise=settings.noise, only_successes=True)
    far = np.flatnonzero(away_at_start(task, made.seeds) >= settings.least)[: settings.trajectories]
    enough = len(far) == settings.trajectories
    require(enough, f"{task.robot}: hardly an episode begins {settings.least:g} from its goal")
    return made.take(far)


def imagine(simulator: Simulator, robot: str, demos: Demonstrations, actions: np.ndarray, update) -> np.ndarray:
    """Images as `demos` has them, [N, L, H, W, 3], after the first frames the simulator's under `actions` [N, L, A]."""
    driven, made = simulator.robot(robot), []
    for first in range(0, len(demos), len(simulator)):
        rows = range(first, min(first + len(simulator), len(demos)))
        batch = [Trajectory(str(i), demos.images[i], np.repeat(actions[i][:, None], driven.stride, 1)) for i in rows]
        made += replay(simulator, driven, batch, list(rows), GIVEN)
        update(len(made), len(demos), "trajectories")
    return np.stack(made)


def choose(condition: Condition, data: Mapping[str, Demonstrations], seed: int) -> Demonstrations:
    """What one policy is trained on. For one seed fewer trajectories are among the more."""
    order = np.random.default_rng([seed, 21]).permutation(len(data["recorded"]))
    kept, others = order[: condition.recorded], order[condition.recorded : condition.recorded + condition.generated]
    parts = [data["recorded"].take(kept)]
    return join([*parts, data[condition.more].take(others)] if len(others) else parts)


def run_trial(settings: Settings, condition: Condition, data: Mapping[str, Demonstrations], seed: int, update) -> dict:
    """Trains one policy and judges it: {success, distance} by start."""
    demos, task = choose(condition, data, seed), settings.make_task()
    fit = FitConfig(settings.steps, settings.batch, settings.learning_rate, ema=0.98)
    config = BcConfig(frames=1, fit=fit)
    params = train_bc(demos, config, seed, update)[settings.steps]
    policy = ClonedPolicy(config, params, scale_of(demos))
    starts = start_seeds(task, settings.starts, least=settings.least)
    found = run_policy(task, policy, starts, demos.images.shape[2])
    return {"success": found.success.astype(int).tolist(), "distance": np.round(found.distance, 4).tolist()}


# --- What comes of it --------------------------------------------------------------------------


def make_panel(trials: Mapping[tuple[int, int], dict], settings: Settings) -> Panel:
    """Success of every condition, seed and start."""
    points = [np.array([trials[i, s]["success"] for s in settings.seeds], float) for i in range(len(CONDITIONS))]
    names = np.full(settings.starts, settings.robot)
    return Panel(names, np.arange(settings.starts), tuple(points), (settings.seeds,) * len(points))


def share_closed(panel: Panel, at: int, draws: int = 2000) -> Interval:
    """Which share of the gap between few and all recorded trajectories condition `at` closes; the interval holds 95 %
    of the draws over seeds and starts."""
    found = resample(panel, draws)

    def share(points: np.ndarray) -> np.ndarray:
        gap = points[..., ALL] - points[..., FEW]
        return (points[..., at] - points[..., FEW]) / np.where(np.abs(gap) < 1e-9, np.nan, gap)

    drawn = share(found.drawn)
    low, high = np.nanquantile(drawn, [0.025, 0.975])
    return Interval(float(share(found.value)), float(np.nanstd(drawn)), float(low), float(high))


def summarise(trials: Mapping[tuple[int, int], dict], settings: Settings) -> list[tuple[str, Interval]]:
    """Success of every condition; which share of the gap 90 generated trajectories close, and 90 of the control."""
    panel = make_panel(trials, settings)
    found = [(c.name, r) for c, r in zip(CONDITIONS, bootstrap_intervals(panel), strict=True)]
    shares = (("share of the gap: 10 + 90 generated", MOST), ("share of the gap: other actions", CONTROL))
    return found + [(name, share_closed(panel, at)) for name, at in shares]


def write_results(settings: Settings, trials: Mapping[tuple[int, int], dict], quality: dict, out: Path) -> None:
    rows = [
        [c.name, c.recorded, c.generated, c.more if c.generated else "", s, k, done, away]
        for i, c in enumerate(CONDITIONS)
        for s in settings.seeds
        for k, (done, away) in enumerate(zip(trials[i, s]["success"], trials[i, s]["distance"], strict=True))
    ]
    write_table(out / "trials.csv", NAMES, rows)
    found = summarise(trials, settings)
    measured = [(name, r.mean, r.low, r.high) for name, r in found]
    measured += [(f"PSNR {kind}, dB", *three) for kind, three in quality.items()]
    summary = [[name, *(f"{x:.4f}" for x in three)] for name, *three in measured]
    write_table(out / "summary.csv", ["what", "mean", "low", "high"], summary)
    write_file(out / "table.md", markdown(found))
    write_file(out / "settings.json", json.dumps(asdict(settings), indent=1) + "\n")
    draw([r for _, r in found[: len(CONDITIONS)]], trials, settings, out / "synthetic.png")


def markdown(found: Sequence[tuple[str, Interval]]) -> str:
    """The table that docs/generating.md shows; an interval of a share of episodes ends at 0 and 1."""
    lines = ["| trained on | success | 95 % interval |", "|---|---|---|"]
    for name, r in found:
        low, high = (r.low, r.high) if name.startswith("share") else (max(r.low, 0.0), min(r.high, 1.0))
        lines.append(f"| {name} | {r.mean:.2f} | {low:.2f} to {high:.2f} |")
    return "\n".join(lines) + "\n"


def read_trials(path: Path) -> dict[tuple[int, int], dict]:
    """What trials.csv says: {(place of the condition, seed): {success, distance} by start}."""
    places, trials = {c.name: i for i, c in enumerate(CONDITIONS)}, {}
    with open(path, newline="") as file:
        for row in csv.DictReader(file):
            one = trials.setdefault((places[row["condition"]], int(row["seed"])), {"success": [], "distance": []})
            one["success"].append(int(row["success"]))
            one["distance"].append(float(row["distance"]))
    return trials


def draw(found: Sequence[Interval], trials: Mapping[tuple[int, int], dict], settings: Settings, path: Path) -> None:
    """Success by condition: a bar with its interval, a dot for every seed."""
    from experiments.report.plot_style import COLOURS, INK, MUTED, STYLE, plt, save

    with plt.rc_context(STYLE):
        figure, panel = plt.subplots(figsize=(7.2, 3.4), layout="constrained")
        colours = [COLOURS["delta_psnr"] if i == CONTROL else MUTED if i in (FEW, ALL) else COLOURS["perplexity"]
                   for i in range(len(CONDITIONS))]  # fmt: skip
        places = np.arange(len(CONDITIONS))
        panel.bar(places, [r.mean for r in found], color=colours, width=0.62)
        low = [r.mean - max(r.low, 0) for r in found]
        high = [min(r.high, 1) - r.mean for r in found]
        panel.errorbar(places, [r.mean for r in found], [low, high], fmt="none", color=INK, capsize=3)
        for i in places:
            means = [np.mean(trials[i, s]["success"]) for s in settings.seeds]
            panel.plot(np.full(len(means), i + 0.2), means, "o", color=INK, markersize=3)
        panel.set_xticks(places, [c.name.replace(" generated", "\ngenerated").replace(", ", ",\n") for c in CONDITIONS])
        panel.set(ylim=(0, 1), ylabel="success in the true simulator")
        panel.grid(False, axis="x")
        save(figure, path)


def quality_of(data: Mapping[str, Demonstrations]) -> dict[str, tuple[float, float, float]]:
    """PSNR in dB against the recording, of the frames after the given ones: mean, low and high over trajectories."""
    found = {}
    for kind in ("generated", "shuffled"):
        means = psnr(data[kind].images[:, GIVEN:], data["recorded"].images[:, GIVEN:]).mean(1)
        names, each = np.full(len(means), kind), np.arange(len(means))
        (interval,) = bootstrap_intervals(Panel(names, each, (means[None],), ((0,),)))
        found[kind] = interval.mean, interval.low, interval.high
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?", default=RUN, help="directory of a training run")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--robot", default=Settings.robot)
    parser.add_argument("--task", default=Settings.task, help="hover, reach, or own: what its recordings do")
    parser.add_argument("--frames", type=int, default=Settings.frames, help="of an episode")
    parser.add_argument("--starts", type=int, default=Settings.starts)
    parser.add_argument("--seeds", type=int, default=len(Settings.seeds), help="how many")
    parser.add_argument("--steps", type=int, default=Settings.steps, help="of training, of every policy")
    asked = vars(parser.parse_args())
    run, out, seeds = asked.pop("run"), asked.pop("out"), tuple(range(asked.pop("seeds")))
    settings = Settings(seeds=seeds, **asked)
    trials_dir = out / "trials"
    trials_dir.mkdir(parents=True, exist_ok=True)
    simulator = load_simulator(run, episodes=BATCH, history=1)
    data = make_data(settings, simulator, out)
    trials: dict[tuple[int, int], dict] = {}
    jobs, pace = [(i, s) for s in settings.seeds for i in range(len(CONDITIONS))], Pace()
    with step(f"train and judge {len(jobs)} policies") as update:
        for n, (i, seed) in enumerate(jobs):
            path = trials_dir / f"{i}-{seed}.json"
            if not path.exists():
                note = f"{CONDITIONS[i].name}, seed {seed}{pace(n, len(jobs))}"
                report = lambda done, total, said, note=note, n=n: update(n, len(jobs), f"{note}: step {done}, {said}")
                write_file(path, json.dumps(run_trial(settings, CONDITIONS[i], data, seed, report)))
            trials[i, seed] = json.loads(path.read_text())
    write_results(settings, trials, quality_of(data), out)
    wrote(out / "trials.csv", out / "summary.csv", out / "table.md", out / "synthetic.png")


if __name__ == "__main__":
    main()
