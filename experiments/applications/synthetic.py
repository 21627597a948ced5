"""What generated trajectories are worth to a policy.

Question: is a policy that was trained on 10 recorded and 90 generated trajectories as good as one on 100 recorded?
Paper: Table 6.
Command: python -m experiments.applications.synthetic
Cost: half an hour of one core; goes on where it was stopped, also with more seeds or the second control.
Expected: success grows with the generated trajectories; those of a model that is given other actions do not help.

The 100 trajectories are an expert's, from starts that the world model never saw. For each seed ten of them are kept as
recorded; of the others the actions are kept, and replayed from their own first frame in the learned simulator. Policies
are trained on what it shows, not on that frame. Control: the same simulator under another trajectory's actions, so that
pictures and actions do not belong together. With --without-actions RUN there is a second control, what a model
generates that was trained on the same video without actions (`--set train.masking.setting=passive`). All policies are
trained alike (behaviour cloning, as many steps), and judged from the same starts in the true simulator.

The error is that of a policy's actions in held-out recordings, mean squared, in standard deviations. With --actions
DATASET the trajectories are recordings of a robot that no simulator judges (the paper's Language Table): policies are
judged by that error alone.

Writes to OUT: trials.csv, a row per policy and start (not of recordings); errors.csv, one per policy and held-out
trajectory; summary.csv and table.md; synthetic.png; frames.png.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from data_pipelines.publishing.files import remove
from experiments.analysis.bootstrap import Panel, bootstrap_intervals
from experiments.applications import FIRST
from experiments.applications.generating.conditions import (
    ALL,
    BLIND,
    BLIND_KIND,
    CONDITIONS,
    CONTROL,
    FEW,
    KINDS,
    MOST,
    Condition,
    Trials,
    markdown,
    places,
    summarise,
    write_tables,
)
from experiments.applications.generating.figures import draw_conditions, draw_strips
from experiments.applications.generating.lessons import (
    Lessons,
    RecordedLessons,
    ScriptedLessons,
    Settings,
    Training,
    as_trajectories,
    others_actions,
)
from experiments.applications.generating.source import replay
from experiments.applications.generating.trajectories import open_trajectories, require_layout, told_of_frames
from experiments.applications.made_with import claim, write_settings
from experiments.applications.policies.acting import STILL, Scale, scale_of
from experiments.applications.policies.cloning import BcConfig, clone
from experiments.applications.policies.demonstrations import (
    Demonstrations,
    join,
    load_demonstrations,
    save_demonstrations,
)
from experiments.applications.policies.learning import FitConfig, Report
from experiments.applications.policies.network import require_multiples
from experiments.applications.policies.policy import Policy
from experiments.applications.simulators import load_simulator
from experiments.applications.tables import write_table
from experiments.boundary import guarded
from experiments.progress import Pace, say, step
from experiments.running.workspace import Workspace
from experiments.setting import use_entries
from experiments.wrote import wrote
from hma_jax.config import require
from hma_jax.evaluation.metrics import psnr
from hma_jax.runtime.files import write_file
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator

OUT = Path("runs/synthetic")

JUDGED_ON = "held_out"
"""The name of the recordings that nobody is trained on, beside those of `KINDS`."""

UNDER_WAY = "under_way"

SECOND = "without_actions.json"
"""What names the second control's model, in OUT."""

BATCH = 8


def make_data(
    lessons: Lessons, simulator: Simulator, out: Path, blind: Simulator | None = None
) -> dict[str, Demonstrations]:
    """The trajectories as recorded, generated, and generated under shuffled actions, and by a `blind` model if there is
    one; made once, kept in `out`, the batches of a kind that is under way in `out`/UNDER_WAY."""
    kinds = (*KINDS, BLIND_KIND) if blind else KINDS
    sets, given = {kind: out / f"{kind}.npz" for kind in (*kinds, JUDGED_ON)}, lessons.settings.given
    if not sets["recorded"].exists():
        with step(f"record {lessons.settings.trajectories} trajectories"):
            save_demonstrations(lessons.record(), sets["recorded"])
    recorded = load_demonstrations(sets["recorded"])
    acted = dict.fromkeys(kinds, recorded.actions) | {"shuffled": others_actions(recorded)}
    for kind in kinds[1:]:
        if not sets[kind].exists():
            world_model, under_way = blind if kind == BLIND_KIND else simulator, out / UNDER_WAY / kind
            with step(f"replay actions: {kind}") as update:
                replayed = replace(recorded, actions=acted[kind])
                images = imagine(world_model, lessons.robot, replayed, given, under_way, update)
            save_demonstrations(replace(recorded, images=images), sets[kind])
    remove(out / UNDER_WAY)
    if not sets[JUDGED_ON].exists():
        save_demonstrations(lessons.record_held_out(), sets[JUDGED_ON])
    return {kind: load_demonstrations(path) for kind, path in sets.items()}


def imagine(
    simulator: Simulator, robot: Robot, demos: Demonstrations, given: int, kept: Path, update: Report
) -> np.ndarray:
    """Images as `demos` has them, [N, L, H, W, 3], after the `given` ones the simulator's under its actions. Every
    batch is kept in the directory `kept`, and found there again."""
    kept.mkdir(parents=True, exist_ok=True)
    trajectories, images = as_trajectories(demos, robot), np.zeros_like(demos.images)
    for first in range(0, len(demos), len(simulator)):
        rows, path = range(first, min(first + len(simulator), len(demos))), kept / f"{first}.npz"
        if path.exists():
            images[first : rows.stop] = load_demonstrations(path).images
        else:
            made = replay(simulator, robot, [trajectories[i] for i in rows], rows, given)
            for i, frames in zip(rows, made, strict=True):
                images[i, : len(frames)] = frames
            save_demonstrations(replace(demos, images=images).take(rows), path)
        update(rows.stop, len(demos), "trajectories")
    return images


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
    lessons: Lessons, condition: Condition, data: Mapping[str, Demonstrations], seed: int, update: Report
) -> dict[str, list[float]]:
    """Trains one policy and judges it: what the lessons' judge says by start, {error} by held-out trajectory."""
    settings = lessons.settings
    demos = choose(condition, data, seed, 0 if settings.with_given else settings.given)
    fit = FitConfig(settings.steps, settings.batch, settings.learning_rate, ema=0.98)
    policy = clone(demos, BcConfig(frames=1, fit=fit), seed, update)
    judged = lessons.judge(policy)
    errors = action_errors(policy, data[JUDGED_ON], scale_of(data["recorded"]))
    return {**judged, "error": np.round(errors, 5).tolist()}


def action_errors(policy: Policy, demos: Demonstrations, scale: Scale) -> np.ndarray:
    """float [N]: mean squared difference from the recorded actions of each trajectory, in standard deviations, over the
    dimensions that vary in what policies are trained on: in others the smallest difference would be a large one."""
    moving = np.array(scale.std) > STILL
    policy.reset()
    acted = np.stack([policy.act(demos.images[:, t]) for t in range(demos.images.shape[1])], 1)
    apart = (scale.normalise(acted) - scale.normalise(demos.actions))[..., moving]
    squares = (apart**2).mean(2, dtype=np.float64)
    return np.array([row[:length].mean() for row, length in zip(squares, demos.lengths, strict=True)])


def write_results(seeds: tuple[int, ...], trials: Trials, quality: dict, out: Path) -> list[Path]:
    """Returns what it wrote."""
    tables, found = write_tables(trials, seeds, out), summarise(trials, seeds)
    shown = "success" if "success" in found[0].measured else "error"
    measured = [(f"{what}: {one.name}", one.measured[what]) for what in found[0].measured for one in found]
    lines = [[name, *(f"{x:.4f}" for x in (r.mean, r.low, r.high))] for name, r in measured]
    lines += [[f"PSNR of {kind}, dB", *(f"{x:.4f}" for x in three)] for kind, three in quality.items()]
    summary, table, figure = out / "summary.csv", out / "table.md", out / "synthetic.png"
    write_table(summary, ["what", "mean", "low", "high"], lines)
    write_file(table, markdown(found))
    tried = places(trials)
    each = [[float(np.mean(trials[i, s][shown])) for s in seeds if (i, s) in trials] for i in tried]
    named = {one.name: one.measured[shown] for one in found[: len(tried)]}
    draw_conditions(named, each, {CONTROL, BLIND}, {FEW, ALL}, figure, shown)
    return [*tables, summary, table, figure]


def quality_of(data: Mapping[str, Demonstrations], given: int) -> dict[str, tuple[float, float, float]]:
    """PSNR in dB against the recording, of the frames after the given ones: mean, low and high over trajectories."""
    found, recorded = {}, data["recorded"]
    for kind in (kind for kind in ("generated", "shuffled", BLIND_KIND) if kind in data):
        each = psnr(data[kind].images, recorded.images)
        means = np.array([row[given:length].mean() for row, length in zip(each, recorded.lengths, strict=True)])
        names, numbers = np.full(len(means), kind), np.arange(len(means))
        (interval,) = bootstrap_intervals(Panel(names, numbers, (means[None],), ((0,),)))
        found[kind] = interval.mean, interval.low, interval.high
    return found


def find_lessons(args: argparse.Namespace, simulator: Simulator) -> Lessons:
    """Raises ConfigError for options that belong to the other kind of lessons."""
    seeds = tuple(range(args.seeds))
    training = Training(seeds=seeds, steps=args.steps, given=args.given, with_given=args.with_given)
    scripted, recorded = (
        {name: value for name in names if (value := getattr(args, name)) is not None}
        for names in (("task", "frames", "starts"), ("split", "held_out", "registry"))
    )
    if args.actions is None:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in recorded)
        require(not recorded, f"{options}: of recordings, which --actions DATASET names")
        settings = Settings(**vars(training), robot=args.robot or Settings.robot, **scripted)
        return ScriptedLessons(settings, simulator.robot(settings.robot), simulator.tokenizer.image_size)
    require(not scripted, f"--{', --'.join(scripted)}: of the suite's tasks, not of recordings (--actions)")
    use_entries(args.registry)
    robot = simulator.robot(args.robot) if args.robot else None
    place = robot, dict(simulator.robots), simulator.tokenizer, Workspace.of_run(args.run).store
    trained_on, driven = open_trajectories(args.actions, args.split or "train", *place)
    held_out, _ = open_trajectories(args.actions, args.held_out or "val", *place)
    require_layout(trained_on, driven, simulator.model.table)
    for note in filter(None, map(told_of_frames, (trained_on, held_out))):
        say(note)
    return RecordedLessons(training, driven, trained_on, held_out)


def find_blind(run: Path, robot: Robot) -> Simulator:
    """The simulator of a model that was trained without actions. Raises ConfigError for another one."""
    blind = load_simulator(run, own_starts=True, episodes=BATCH, history=1)
    setting = blind.model.run.train.masking.setting
    require(
        setting == "passive", f"{run} was trained with train.masking.setting={setting}, not without actions (passive)"
    )
    blind.describe([robot])
    return blind


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, nargs="?", default=FIRST, help="directory of a training run")
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--actions", metavar="DATASET", help="recordings, as `hma generate` takes them")
    parser.add_argument("--split", help="of DATASET, that policies are trained on (train)")
    parser.add_argument("--held-out", metavar="SPLIT", help="of DATASET, that they are judged on (val)")
    parser.add_argument("--registry", type=Path, metavar="FILE", help="TOML file with entries of your own")
    parser.add_argument("--robot", help=f"of the model; DATASET's, or {Settings.robot}")
    parser.add_argument("--task", help=f"hover, reach, or own: what its recordings do ({Settings.task})")
    parser.add_argument("--frames", type=int, help=f"of an episode ({Settings.frames})")
    parser.add_argument("--starts", type=int, help=f"in the true simulator ({Settings.starts})")
    parser.add_argument("--seeds", type=int, default=len(Training.seeds), help="how many")
    parser.add_argument("--steps", type=int, default=Training.steps, help="of training, of every policy")
    parser.add_argument("--given", type=int, default=Training.given, help="recorded frames that others begin with")
    parser.add_argument("--with-given", action="store_true", help="train on these, too")
    parser.add_argument(
        "--without-actions", type=Path, metavar="RUN", help="second control: of the same video, trained without actions"
    )
    args = parser.parse_args()
    run, out = args.run, args.out
    simulator = load_simulator(run, own_starts=True, episodes=BATCH, history=1)
    lessons = find_lessons(args, simulator)  # a mistyped name claims nothing
    second = out / SECOND
    require(
        bool(args.without_actions) or not second.exists(),
        f"{second} says that policies of a model without actions are here: give --without-actions again, or another --out",
    )
    settings, blind = lessons.settings, args.without_actions and find_blind(args.without_actions, lessons.robot)
    require_multiples(*simulator.tokenizer.image_shape, BcConfig().encoder.size)
    claim(out, run, simulator, asdict(settings), grows=("seeds",))
    if blind:
        claim(out, args.without_actions, blind, {}, file=SECOND)
    trials_dir = out / "trials"
    trials_dir.mkdir(exist_ok=True)
    data = make_data(lessons, simulator, out, blind)
    trials: Trials = {}
    conditions = range(len(CONDITIONS) if blind else BLIND)
    first = sorted(conditions, key=lambda i: i not in (FEW, ALL, MOST, CONTROL, BLIND))  # what counts most
    jobs, pace = [(i, s) for i in first for s in settings.seeds], Pace()
    with step(f"train and judge {len(jobs)} policies") as update:
        for n, (i, seed) in enumerate(jobs):
            path = trials_dir / f"{i}-{seed}.json"
            if not path.exists():
                note = f"{CONDITIONS[i].name}, seed {seed}{pace(n, len(jobs))}"
                report = lambda done, total, said, note=note, n=n: update(n, len(jobs), f"{note}: step {done}, {said}")
                write_file(path, json.dumps(run_trial(lessons, CONDITIONS[i], data, seed, report)))
            trials[i, seed] = json.loads(path.read_text())
    written = write_results(settings.seeds, trials, quality_of(data, settings.given), out)
    write_settings(out, run, simulator, asdict(settings))
    shortest = data["recorded"].lengths[:2].min()
    kinds = [kind for kind in data if kind != JUDGED_ON]
    draw_strips([data[kind].images[:2, :shortest] for kind in kinds], kinds, out / "frames.png")
    wrote(*written, out / "frames.png")


if __name__ == "__main__":
    sys.exit(guarded(main))
