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
generates that was trained on the same video without actions (`--set train.masking.setting=passive`), decoded as the
first model. With --with-given policies are trained on the recorded first frames too, and there is a third control that
has nothing but these of the ninety. All policies are trained alike (behaviour cloning, as many steps), and judged from
the same starts in the true simulator.

The error is that of a policy's actions in held-out recordings, mean squared, in standard deviations. With --actions
DATASET the trajectories are recordings of a robot that no simulator judges (the paper's Language Table): policies are
judged by that error alone.

Writes to OUT: trials.csv, a row per policy and start (not of recordings); errors.csv, one per policy and held-out
trajectory; summary.csv and table.md; synthetic.png; frames.png.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from data_pipelines.publishing.files import remove
from experiments.analysis.bootstrap import Panel, bootstrap_intervals
from experiments.applications import FIRST
from experiments.applications.generating.conditions import (
    ALL,
    CONDITIONS,
    CONTROLS,
    FEW,
    GENERATED_KINDS,
    GIVEN_KIND,
    KINDS,
    PASSIVE_KIND,
    SHARES,
    Condition,
    Trials,
    markdown,
    summarise,
    tried_conditions,
    write_tables,
)
from experiments.applications.generating.demonstration_sources import (
    DemonstrationSource,
    RecordedSource,
    ScriptedSource,
    Settings,
    Training,
    as_trajectories,
    shuffled_actions,
)
from experiments.applications.generating.figures import draw_conditions, draw_strips
from experiments.applications.generating.reconstruction import ThroughTokenizer, reconstruct_recorded
from experiments.applications.generating.source import replay
from experiments.applications.generating.survey import survey
from experiments.applications.generating.trajectories import describe_reconstruction, open_trajectories, require_layout
from experiments.applications.policies.acting import STILL, Scale, scale_of
from experiments.applications.policies.cloning import BcConfig, clone
from experiments.applications.policies.demonstrations import Demonstrations, load_demonstrations, save_demonstrations
from experiments.applications.policies.learning import FitConfig, Report
from experiments.applications.policies.network import require_multiples
from experiments.applications.policies.policy import Policy
from experiments.applications.policies.tasks import join
from experiments.applications.settings_file import pin_settings, write_settings
from experiments.running.workspace import Workspace
from experiments.simulators import load_simulator
from experiments.study_setup import UNSET, use_entries
from experiments.tables import make_once, write_table
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.progress import Eta, say, step, wrote
from hma_jax.config import DecodeConfig, require
from hma_jax.evaluation.metrics import psnr
from hma_jax.runtime.files import write_file
from hma_jax.simulator.folder import change_decode, find_decode
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.tokenizers.base import Tokenizer

OUT = Path("runs/synthetic")

JUDGED_ON = "held_out"
"""The name of the held-out recordings, beside those of `KINDS`."""

UNDER_WAY = "under_way"

SECOND = "without_actions.json"
"""File in OUT that names the model of the second control, which was trained without actions."""

BATCH = 8


def make_data(
    source: DemonstrationSource, simulator: Simulator, out: Path, passive: Simulator | None = None
) -> dict[str, Demonstrations]:
    """The trajectories as recorded, generated, generated under shuffled actions, and generated by a `passive` model if
    there is one; where policies see the recorded first frames, also these alone. Each kind is made once and kept in
    `out`; batches of an unfinished kind are in `out`/UNDER_WAY."""
    kinds = (*KINDS, PASSIVE_KIND) if passive else KINDS
    sets, given = {kind: out / f"{kind}.npz" for kind in (*kinds, JUDGED_ON)}, source.settings.given
    if not sets["recorded"].exists():
        with step(f"record {source.settings.trajectories} trajectories"):
            save_demonstrations(source.record(), sets["recorded"])
    recorded = load_demonstrations(sets["recorded"])
    acted = dict.fromkeys(kinds, recorded.actions) | {"shuffled": shuffled_actions(recorded)}
    for kind in kinds[1:]:
        if not sets[kind].exists():
            world_model, under_way = passive if kind == PASSIVE_KIND else simulator, out / UNDER_WAY / kind
            with step(f"replay actions: {kind}") as update:
                replayed = replace(recorded, actions=acted[kind])
                images = imagine(world_model, source.robot, replayed, given, under_way, update)
            save_demonstrations(replace(recorded, images=images), sets[kind])
    remove(out / UNDER_WAY)
    if not sets[JUDGED_ON].exists():
        save_demonstrations(source.record_held_out(), sets[JUDGED_ON])
    data = {kind: load_demonstrations(path) for kind, path in sets.items()}
    if source.settings.with_given:
        data[GIVEN_KIND] = replace(recorded, lengths=np.minimum(recorded.lengths, given))
    return data


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
    """The training set of one policy; generated trajectories lose their first `dropped` frames. For one seed smaller
    sets are subsets of larger ones."""
    order = np.random.default_rng([seed, 21]).permutation(len(data["recorded"]))
    kept, others = order[: condition.recorded], order[condition.recorded : condition.recorded + condition.generated]
    parts = [data["recorded"].take(kept)]
    return join([*parts, without_first(data[condition.kind].take(others), dropped)] if len(others) else parts)


def without_first(demos: Demonstrations, frames: int) -> Demonstrations:
    """What follows the first frames."""

    def later(x: np.ndarray) -> np.ndarray:
        return np.concatenate([x[:, frames:], np.zeros_like(x[:, :frames])], 1)

    shifted = {name: later(getattr(demos, name)) for name in ("images", "actions", "reached")}
    return replace(demos, lengths=demos.lengths - frames, **shifted)


def run_trial(
    source: DemonstrationSource,
    condition: Condition,
    data: Mapping[str, Demonstrations],
    seed: int,
    update: Report,
    through: Tokenizer | None = None,
) -> dict[str, list[float]]:
    """Trains one policy and judges it: the source's measures for every start, and `error` for every held-out
    trajectory. In the simulator it sees frames as the tokenizer `through` reconstructs them, if there is one."""
    settings = source.settings
    demos = choose(condition, data, seed, 0 if settings.with_given else settings.given)
    fit = FitConfig(settings.steps, settings.batch, settings.learning_rate, ema=0.98)
    policy = clone(demos, BcConfig(frames=1, fit=fit), seed, update)
    judged = source.judge(ThroughTokenizer(policy, through) if through else policy)
    errors = action_errors(policy, data[JUDGED_ON], scale_of(data["recorded"]))
    return {**judged, "error": np.round(errors, 5).tolist()}


def run_trials(
    source: DemonstrationSource, data: Mapping[str, Demonstrations], kept: Path, through: Tokenizer | None = None
) -> Trials:
    """Every condition that there is data of, with every seed, as `run_trial`. Each trial is kept in the directory
    `kept`, and made once."""
    seeds, conditions = source.settings.seeds, [i for i, c in enumerate(CONDITIONS) if c.kind in data]
    first = sorted(conditions, key=lambda i: i not in (FEW, ALL, *SHARES))  # what counts most
    jobs, eta = [(i, s) for i in first for s in seeds], Eta()
    trials: Trials = {}
    with step(f"train and judge {len(jobs)} policies") as update:

        def run_new(n: int, i: int, seed: int) -> dict[str, list[float]]:
            note = f"{CONDITIONS[i].name}, seed {seed}{eta(n, len(jobs))}"
            report = lambda done, total, loss: update(n, len(jobs), f"{note}: step {done}, {loss}")
            return run_trial(source, CONDITIONS[i], data, seed, report, through)

        for n, (i, seed) in enumerate(jobs):
            trials[i, seed] = make_once(kept / f"{i}-{seed}.json", run_new, n, i, seed)
    return trials


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
    tables, summaries = write_tables(trials, seeds, out), summarise(trials, seeds)
    shown = "success" if "success" in summaries[0].measured else "error"
    measured = [(f"{what}: {one.name}", one.measured[what]) for what in summaries[0].measured for one in summaries]
    lines = [[name, *(f"{x:.4f}" for x in (r.mean, r.low, r.high))] for name, r in measured]
    lines += [[f"PSNR of {kind}, dB", *(f"{x:.4f}" for x in three)] for kind, three in quality.items()]
    summary, table, figure = out / "summary.csv", out / "table.md", out / "synthetic.png"
    write_table(summary, ["what", "mean", "low", "high"], lines)
    write_file(table, markdown(summaries))
    tried = tried_conditions(trials)
    each = [[float(np.mean(trials[i, s][shown])) for s in seeds if (i, s) in trials] for i in tried]
    named = {one.name: one.measured[shown] for one in summaries[: len(tried)]}
    controls, ends = ({at for at, i in enumerate(tried) if i in these} for these in (CONTROLS, (FEW, ALL)))
    draw_conditions(named, each, controls, ends, figure, shown)
    return [*tables, summary, table, figure]


def quality_of(data: Mapping[str, Demonstrations], given: int) -> dict[str, tuple[float, float, float]]:
    """PSNR in dB against the recording, of the frames after the given ones: mean, low and high over trajectories."""
    quality, recorded = {}, data["recorded"]
    for kind in (kind for kind in GENERATED_KINDS if kind in data):
        each = psnr(data[kind].images, recorded.images)
        means = np.array([row[given:length].mean() for row, length in zip(each, recorded.lengths, strict=True)])
        names, numbers = np.full(len(means), kind), np.arange(len(means))
        (interval,) = bootstrap_intervals(Panel(names, numbers, (means[None],), ((0,),)))
        quality[kind] = interval.mean, interval.low, interval.high
    return quality


def by_default(value: object) -> Any:
    """For an option of which it matters whether it was given: its help says what holds otherwise."""
    return arg(help_behavior_hint=f"(default: {value})")


@dataclass(frozen=True)
class DemonstrationArguments:
    """Where demonstrations come from: a scripted expert, or with `actions` recordings. Options of the other kind of
    source are refused."""

    robot: Annotated[str | None, by_default(f"that of --actions, or {Settings.robot}")] = None
    """One of the model's robots."""
    task: Annotated[Literal["own", "reach", "hover"] | None, by_default(Settings.task)] = None
    """Task of the scripted expert.
    own: the robot's own task. reach: bring the tool to the mark. hover: hold the tool above a puck."""
    frames: Annotated[int | None, by_default(Settings.frames)] = None
    """Length of an episode, in frames of the model."""
    hold: Annotated[int | None, by_default(Settings.hold)] = None
    """Frames in a row at the goal that make a success."""
    starts: Annotated[int | None, by_default(Settings.starts)] = None
    """Number of starts in the true simulator, the same for every policy."""
    actions: Annotated[str | None, arg(metavar="DATASET"), UNSET] = None
    """Recordings to use instead, as `hma generate` takes them.
    Policies are then judged by their action error alone."""
    split: Annotated[str | None, by_default("train")] = None
    """Split of --actions that policies are trained on."""
    held_out: Annotated[str | None, arg(name="held-out", metavar="SPLIT"), by_default("val")] = None
    """Split of --actions that policies are judged on."""
    registry: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None
    """TOML file with your own registry entries, for --actions."""

    def given(self, *names: str) -> dict[str, Any]:
        """The options among `names` that were given."""
        return {name: value for name in names if (value := getattr(self, name)) is not None}


def make_source(
    run: Path, training: Training, asked: DemonstrationArguments, simulator: Simulator
) -> DemonstrationSource:
    """The source of demonstrations that the arguments name. Raises ConfigError for options of the other kind of
    source."""
    scripted, recorded = asked.given("task", "frames", "hold", "starts"), asked.given("split", "held_out", "registry")
    if asked.actions is None:
        options = ", ".join(f"--{name.replace('_', '-')}" for name in recorded)
        require(not recorded, f"{options}: only for recordings; give these with --actions DATASET")
        settings = Settings(**vars(training), robot=asked.robot or Settings.robot, **scripted)
        return ScriptedSource(settings, simulator.robot(settings.robot), simulator.tokenizer.image_size)
    require(not scripted, f"--{', --'.join(scripted)}: only for tasks of the suite, not with recordings (--actions)")
    use_entries(asked.registry, run)
    robot = simulator.robot(asked.robot) if asked.robot else None
    place = robot, dict(simulator.robots), simulator.tokenizer, Workspace.of_run(run).store
    trained_on, driven = open_trajectories(asked.actions, asked.split or "train", *place)
    held_out, _ = open_trajectories(asked.actions, asked.held_out or "val", *place)
    require_layout(trained_on, driven, simulator.model.table)
    source = RecordedSource(training, driven, trained_on, held_out)
    clipped = survey(trained_on, training.trajectories, driven)
    for note in filter(None, (*map(describe_reconstruction, (trained_on, held_out)), clipped.note())):
        say(note)
    return source


def load_passive(run: Path, robot: Robot, decode: DecodeConfig) -> Simulator:
    """The simulator of a model that was trained without actions (passive). Raises ConfigError for another one."""
    passive = load_simulator(run, own_starts=True, episodes=BATCH, decode=decode, history=1)
    setting = passive.model.run.train.masking.setting
    require(
        setting == "passive", f"{run} was trained with train.masking.setting={setting}, not without actions (passive)"
    )
    passive.update_robots([robot])
    return passive


def compare_in_run(
    run: Annotated[Positional[Path], arg(metavar="RUN")] = FIRST,
    out: Annotated[Path, arg(metavar="DIR")] = OUT,
    demonstrations: OmitArgPrefixes[DemonstrationArguments] = DemonstrationArguments(),
    seeds: int = len(Training.seeds),
    steps: int = Training.steps,
    given: int = Training.given,
    with_given: Annotated[FlagCreatePairsOff[bool], arg(name="with-given"), UNSET] = Training.with_given,
    through_tokenizer: Annotated[FlagCreatePairsOff[bool], arg(name="through-tokenizer"), UNSET] = False,
    temperature: float = Training.temperature,
    without_actions: Annotated[Path | None, arg(name="without-actions", metavar="RUN"), UNSET] = None,
) -> None:
    """Trains policies on recorded and generated trajectories, and judges them.

    Args:
        run: Directory of a training run.
        out: Directory for everything that is written.
        seeds: Number of seeds: of which ten trajectories are kept as recorded, and of the policies' training.
        steps: Training steps of each policy.
        given: Recorded frames with which each generated trajectory begins.
        with_given: Train policies on these recorded frames too. Then there is another control: policies that see
            nothing else of the ninety trajectories.
        through_tokenizer: Policies see every frame as the tokenizer of RUN reconstructs it, in training and in the true
            simulator, so that recorded and generated frames look alike.
        temperature: Temperature at which tokens or latents are sampled; 0: greedy decoding.
        without_actions: Second control: the run of a model that was trained without actions on the same video.
    """
    training = Training(
        seeds=tuple(range(seeds)),
        steps=steps,
        given=given,
        with_given=with_given,
        through_tokenizer=through_tokenizer,
        temperature=temperature,
    )
    with Workspace(out).locked():
        simulator = load_simulator(
            run, own_starts=True, episodes=BATCH, decode=change_decode(find_decode(run), temperature), history=1
        )
        source = make_source(run, training, demonstrations, simulator)  # a mistyped name claims nothing
        second = out / SECOND
        require(
            bool(without_actions) or not second.exists(),
            f"{second} shows that --out already has policies of a model without actions: give --without-actions again, or "
            "another --out",
        )
        settings = source.settings
        passive = load_passive(without_actions, source.robot, simulator.decode) if without_actions else None
        require_multiples(*simulator.tokenizer.image_shape, BcConfig().encoder.size)
        pin_settings(out, run, simulator, settings, may_differ=("seeds",))
        if passive:
            pin_settings(out, without_actions, passive, file=SECOND)
        data = make_data(source, simulator, out, passive)
        through = simulator.tokenizer if settings.through_tokenizer else None
        seen = reconstruct_recorded(data, through, settings.given) if through else data
        trials = run_trials(source, seen, out / "trials", through)
        written = write_results(settings.seeds, trials, quality_of(data, settings.given), out)
        write_settings(out, run, simulator, settings)
        shortest = data["recorded"].lengths[:2].min()
        kinds = [kind for kind in (*KINDS, PASSIVE_KIND) if kind in data]
        draw_strips([data[kind].images[:2, :shortest] for kind in kinds], kinds, out / "frames.png")
        wrote(*written, out / "frames.png")


def main() -> None:
    run_module(compare_in_run, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
