"""`hma judge`: does success in the learned simulator tell success in the true one?"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from experiments.progress import console, step, tidy_table
from experiments.setting import UNSET, command
from experiments.wrote import wrote
from hma_jax.config import require


def judge(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    robot: Annotated[str, arg(metavar="NAME")],
    out: Annotated[Path, arg(metavar="DIR")],
    task: Literal["own", "reach", "hover"] = "own",
    policies: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
    starts: int = 50,
    batch: Annotated[int | None, UNSET] = None,
    frames: Annotated[int | None, UNSET] = None,
    demonstrations: int = 3000,
    steps: int = 6000,
    head_episodes: int = 3000,
    head_steps: int = 6000,
    cloned: int = 6,
    diffusion: int = 3,
    seed: int = 0,
    labels: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
) -> None:
    """Run policies of many strengths from the same starts in the true and in the learned simulator, and compare.

    Policies are trained on images: checkpoints of behaviour cloning and of a Diffusion Policy along their training, and
    a random one; the model itself, where it has action heads; your own. Success in the model is told by a head, in the truth by
    the state; the head looks at true frames too, and a control executes what a policy does in another episode. Writes
    table, agreement with intervals, a page with clips, and a page on which a person can label successes blindly. Goes
    on where it was stopped. docs/judging.md says how to read it.

    Args:
        run: Directory of a training run, or experiments/results/simulator.
        robot: Which of its robots; it must have a true simulator (of the suite, or metaworld_drawer and others).
        out: Where everything is written.
        task: The robot's own task; of the suite's robots also reaching the mark with the tool, or hovering
            with the tool above a puck.
        policies: Python file with policies(robot), policies of your own by name, which are judged too.
        starts: Held-out episodes at whose beginning every policy starts.
        batch: Of these, run at once. Default: all.
        frames: Of an episode, instead of the task's.
        demonstrations: Episodes of the scripted expert that the policies are trained on.
        steps: Of training of each kind of policy.
        head_episodes: Recorded episodes that the success head is trained on.
        head_steps: Of training of the success head.
        cloned: Checkpoints of behaviour cloning; 0 for none.
        diffusion: Checkpoints of the Diffusion Policy; 0 for none.
        seed: Of recordings, training and episodes.
        labels: Saved by the blind page: only says how often that person agrees with the judges of --out.
    """
    from experiments.applications.judging.blind import compare_labels, read_labels, write_blind
    from experiments.applications.judging.head import HeadConfig
    from experiments.applications.judging.judge import JudgeConfig, judge_run
    from experiments.applications.judging.ladder import LadderConfig
    from experiments.applications.judging.outcomes import read_outcomes, write_outcomes
    from experiments.applications.judging.page import draw_scatter, write_page
    from experiments.applications.judging.summary import summarise, write_summary
    from experiments.applications.policies.tasks import find_task

    if labels is not None:
        agreed = compare_labels(read_labels(labels, out), read_outcomes(out / "outcomes.csv"))
        table = tidy_table(f"{labels}: agreement with a person", "judge", "share alike", "clips")
        for name, found in agreed.items():
            table.add_row(name, f"{found.mean:.2f} ({found.low:.2f} to {found.high:.2f})", str(found.n))
        console.print(table)
        return
    require(starts >= 2, f"--starts must be at least 2, got {starts}")
    ladder = replace(LadderConfig(), cloned=cloned, diffusion=diffusion, steps=steps)
    config = JudgeConfig(
        find_task(robot, task, frames),
        starts,
        starts if batch is None else batch,
        seed,
        demonstrations=demonstrations,
        ladder=ladder,
        head=replace(HeadConfig(), fit=replace(HeadConfig().fit, steps=head_steps)),
        head_episodes=head_episodes,
    )
    judged = judge_run(run, out, config, step, policies)
    summary = summarise(judged)
    write_outcomes(judged.outcomes, out / "outcomes.csv")
    write_summary(summary, out / "agreement.json")
    draw_scatter(summary, out / "scatter.png")
    asked: list[str | Path] = [
        run, "--robot", robot, "--task", task, *(["--policies", policies] if policies else []),
        "--starts", f"{starts}", "--batch", f"{config.batch}", "--frames", f"{config.task.frames}",
        "--demonstrations", f"{demonstrations}", "--steps", f"{steps}", "--head-episodes", f"{head_episodes}",
        "--head-steps", f"{head_steps}", "--cloned", f"{cloned}", "--diffusion", f"{diffusion}",
        "--seed", f"{seed}", "--out", out,
    ]  # fmt: skip
    page = write_page(judged, summary, out, command("judge", *asked))
    blind = write_blind(judged, out)
    _say(summary)
    then = f"label the clips of {blind}, and the same command with --labels labels.json"
    wrote(out / "outcomes.csv", out / "agreement.json", page, blind, then=then)


def _say(summary: dict) -> None:
    from experiments.applications.judging.page import say_beyond
    from experiments.applications.judging.summary import COLUMNS, shown

    table = tidy_table(f"{summary['robot']}: {summary['task']}", "policy", *COLUMNS)
    for name, rates in summary["policies"].items():
        table.add_row(name, *(shown(rates[column]) for column in COLUMNS))
    console.print(table)
    if beyond := say_beyond(summary):
        console.print(beyond, markup=False, soft_wrap=True)
    measures = list(next(iter(summary["agreement"].values()))["starts"])
    table = tidy_table("agreement, intervals over other policies and starts", "compared", *measures)
    for name, found in summary["agreement"].items():
        table.add_row(name, *(shown(found["policies and starts"][m]) for m in measures))
    console.print(table)
