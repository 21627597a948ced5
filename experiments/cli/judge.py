"""`hma judge`: does success in the learned simulator predict success in the true one?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from experiments.study_setup import UNSET, command, use_entries
from experiments.terminal.progress import console, say, tidy_table, wrote
from hma_jax.config import require

if TYPE_CHECKING:
    from experiments.applications.judging.judge import Judgement
    from experiments.applications.judging.real import Count


def judge(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    robot: Annotated[str, arg(metavar="NAME")],
    out: Annotated[Path, arg(metavar="DIR")],
    task: Literal["own", "reach", "hover"] = "own",
    policies: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
    recordings: Annotated[str | None, arg(metavar="DATASET"), UNSET] = None,
    split: Annotated[str | None, arg(metavar="NAME"), UNSET] = None,
    reward: Annotated[float | None, arg(metavar="LEAST"), UNSET] = None,
    registry: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
    real: Annotated[Path | None, arg(metavar="CSV"), UNSET] = None,
    starts: int = 50,
    batch: Annotated[int | None, UNSET] = None,
    frames: Annotated[int | None, UNSET] = None,
    hold: Annotated[int | None, UNSET] = None,
    demonstrations: Annotated[int | None, UNSET] = None,
    steps: Annotated[int | None, UNSET] = None,
    head_episodes: int = 3000,
    head_steps: int = 6000,
    cloned: Annotated[int | None, UNSET] = None,
    diffusion: Annotated[int | None, UNSET] = None,
    seed: int = 0,
    labels: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
) -> None:
    """Evaluate policies of different quality in the true and in the learned simulator, and compare their success rates.

    All policies begin at the same starts and act on images. They are checkpoints from the training of behaviour cloning
    and of a Diffusion Policy, a random policy, the model itself if it was trained to predict actions, and your own. In
    the true simulator, success is read from the state. In the model, a success head (a small network) recognises it in
    the frames. To test the head, it also judges true frames; as a control, a policy's actions are replaced by those of
    another episode. A robot without a true simulator is evaluated in the model only, with a head trained on recordings.
    Writes a table, the agreement with intervals, a page with clips, and a page on which a person can label successes
    without knowing the policy. Run the same command again after an interruption: it continues. docs/judging.md
    explains the results.

    Args:
        run: Directory of a training run, or experiments/results/simulator_grown.
        robot: One of the model's robots. It must have a true simulator (robots of the suite, metaworld_drawer and
            others) or recordings.
        out: Directory for everything that is written.
        task: own: the robot's own task. For robots of the suite also reach: bring the tool to the mark, or hover: hold
            the tool above a puck.
        policies: Python file with a function policies(robot) that returns your own policies by name. If it also has a
            function success(images, first), this recognises success in place of a trained head.
        recordings: Dataset (RLDS, LeRobot, robomimic) of a robot without a true simulator, whose episodes say whether
            they succeeded. The head is trained on them; policies start where held-out recordings start.
        split: Split of --recordings. Default: train.
        reward: With --recordings that have a reward in every step: the goal is reached in steps with at least this
            reward. The head is then trained frame by frame, which gave better labels.
        registry: TOML file with your own registry entries, besides those of the study of RUN.
        real: CSV file with results of the policies on the real robot, with --recordings: columns policy, successes,
            episodes.
        starts: Number of starts of every policy, each the beginning of a held-out episode; with --recordings at most as
            many as are held out.
        batch: Episodes run at the same time. Default: all starts.
        frames: Length of an episode. Default: the task's; with --recordings what nine of ten successes needed.
        hold: Frames in a row at the goal that make a success. Default: the task's; with --recordings 2: the last 2
            frames of a successful recording are taken to show the goal.
        demonstrations: Episodes of the scripted expert that the policies are trained on. Default: 3000.
        steps: Training steps of each kind of policy. Default: 6000.
        head_episodes: Recorded episodes that the success head is trained on; with --recordings the largest number.
        head_steps: Training steps of the success head.
        cloned: Number of checkpoints of behaviour cloning, 0 for none. Default: 6, with --recordings none.
        diffusion: Number of checkpoints of the Diffusion Policy, 0 for none. Default: 3, with --recordings none.
        seed: Random seed of recordings, training and episodes.
        labels: File that the blind page saved. Only prints how often that person agrees with the results in --out;
            --robot must be given, and all other options are ignored.
    """
    if labels is not None:
        _show_agreement_with_labels(labels, out)
        return
    from experiments.applications.judging.config import JudgeConfig
    from experiments.applications.judging.head import HeadConfig
    from experiments.applications.judging.judge import judge_recorded, judge_run
    from experiments.applications.judging.ladder import LadderConfig
    from experiments.applications.judging.real import read_real
    from experiments.applications.policies.kinds import KINDS
    from experiments.applications.policies.tasks import ROBOTS, AnyTask, RecordedTask, find_task
    from experiments.running.workspace import Workspace
    from hma_jax.simulator.robots import require_robot
    from hma_jax.training.runs import load_run

    require(starts >= 2, f"--starts must be at least 2, got {starts}")
    require(frames is None or frames >= 1, f"--frames must be at least 1, got {frames}")
    expert = {"demonstrations": demonstrations, "steps": steps, "cloned": cloned, "diffusion": diffusion}
    expert = {option: n for option, n in expert.items() if n is not None}
    _require_options_of(recordings, task, expert, {
        "--real": real, "--registry": registry, "--split": split, "--reward": reward
    })  # fmt: skip
    if recordings is None:
        if robot not in ROBOTS:
            require_robot(robot, load_run(run, "auto").table.names)
        judged_task: AnyTask = find_task(robot, task, frames, hold)
    else:
        expert = dict.fromkeys(KINDS, 0) | expert  # with recordings there is no expert to clone
        split = split or "train"
        judged_task = RecordedTask(robot, frames or 0, RecordedTask.hold if hold is None else hold, reward)
    config = JudgeConfig(
        judged_task,
        starts,
        starts if batch is None else batch,
        seed,
        demonstrations=expert.pop("demonstrations", JudgeConfig.demonstrations),
        ladder=LadderConfig(**expert),
        head=replace(HeadConfig(), fit=replace(HeadConfig().fit, steps=head_steps)),
        head_episodes=head_episodes,
    )
    counts = None if real is None else read_real(real)
    with Workspace(out).locked():
        if recordings is None:
            judged = judge_run(run, out, config, policies)
        else:
            use_entries(registry, run)
            judged = judge_recorded(run, out, config, recordings, policies, split, tuple(counts or ()))
        ladder = judged.config.ladder
        trained = {"--demonstrations": judged.config.demonstrations, "--steps": ladder.steps}
        trained |= {f"--{kind}": n for kind, n in ladder.counts.items()}
        given: dict[str, Any] = {
            "--robot": robot, "--task": task if recordings is None else None, "--policies": policies,
            "--recordings": recordings, "--split": split, "--reward": reward, "--registry": registry, "--real": real,
            "--starts": judged.config.starts, "--batch": judged.config.batch, "--frames": judged.config.task.frames,
            "--hold": judged.config.task.hold, **(trained if recordings is None else {}),
            "--head-episodes": head_episodes, "--head-steps": head_steps, "--seed": seed, "--out": out,
        }  # fmt: skip
        words = [x for flag, value in given.items() if value is not None for x in (flag, value)]
        _write_results(judged, counts, out, command("judge", run, *words))


def _show_agreement_with_labels(labels: Path, out: Path) -> None:
    """Prints how often a person's labels agree with the judges of the results in `out`."""
    from experiments.applications.judging.blind import compare_labels, read_labels
    from experiments.applications.judging.outcomes import read_outcomes

    agreed = compare_labels(read_labels(labels, out), read_outcomes(out / "outcomes.csv"))
    table = tidy_table(f"{labels}: agreement with a person", "judge", "share alike", "clips")
    for name, share in agreed.items():
        table.add_row(name, f"{share.mean:.2f} ({share.low:.2f} to {share.high:.2f})", str(share.n))
    console.print(table)
    say(f"agreement with the results in {out}; nothing was evaluated again, and all other options were ignored")


def _require_options_of(
    recordings: str | None, task: str, of_expert: dict[str, int], of_recordings: dict[str, Any]
) -> None:
    """Raises ConfigError for options that need --recordings if it is not given, and for options that need an expert if
    it is."""
    if recordings is None:
        for flag, value in of_recordings.items():
            require(
                value is None, f"{flag} is only for robots without a true simulator: add --recordings, or remove {flag}"
            )
        return
    require(task == "own", f"--task {task} is only for robots with a true simulator, not with --recordings")
    unused = [f"--{option}" for option, n in of_expert.items() if n]
    require(
        not unused,
        f"with --recordings there is no scripted expert to train policies on: remove {', '.join(unused)}, or set it "
        "to 0",
    )


def _write_results(judged: Judgement, counts: Mapping[str, Count] | None, out: Path, again: str) -> None:
    """Writes tables, figure and pages of a judgement. `counts`: of the real robot; `again`: the command that repeats
    it."""
    from experiments.applications.judging.blind import write_blind
    from experiments.applications.judging.outcomes import write_outcomes
    from experiments.applications.judging.page import write_page
    from experiments.applications.judging.scatter import draw_scatter
    from experiments.applications.judging.summary import summarise, write_summary

    summary = summarise(judged, counts)
    write_outcomes(judged.outcomes, out / "outcomes.csv")
    write_summary(summary, out / "agreement.json")
    draw_scatter(summary, out / "scatter.png")
    page = write_page(judged, summary, out, again)
    blind = write_blind(judged, out)
    _print_summary(summary)
    about = f"a person can label the clips of {blind}; the same command with --labels labels.json compares the labels"
    wrote(out / "outcomes.csv", out / "agreement.json", page, blind, about=about)


def _print_summary(summary: dict) -> None:
    from experiments.applications.judging.doubts import NOTHING, describe_head, describe_recorded_head, doubts_of_rates
    from experiments.applications.judging.summary import shown

    columns = list(next(iter(summary["policies"].values())))
    table = tidy_table(f"{summary['robot']}: {summary['task']}", "policy", *columns)
    for name, rates in summary["policies"].items():
        table.add_row(name, *(shown(rates[column]) for column in columns))
    console.print(table)
    agreement = summary["agreement"]
    say(f"The success head. {describe_head(summary)}")
    for text in (describe_recorded_head(summary["head"]), *doubts_of_rates(summary), "" if agreement else NOTHING):
        if text:
            say(text)
    if not agreement:
        return
    measures = list(next(iter(agreement.values()))["starts"])
    table = tidy_table(
        f"agreement with {summary['compared with']}, intervals over other policies and starts", "compared", *measures
    )
    for name, agreed in agreement.items():
        table.add_row(name, *(shown(agreed["policies and starts"][m]) for m in measures))
    console.print(table)
