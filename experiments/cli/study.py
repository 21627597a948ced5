"""Commands that work on a study: all of it, one axis, one step, one model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from experiments.cli.hosts import Hosts
from experiments.cli.how import How, OneModel, Remake
from experiments.commands import model as model_commands
from experiments.commands import study as commands
from experiments.commands import tokenize as tokenize_commands
from experiments.run_options import RunOptions
from experiments.running.launchers.registry import Launching
from experiments.setting import UNSET, Where, make_setting
from hma_jax.config import ConfigError, Weights

Axis = Literal["datasets", "trajectories", "width", "settings", "conditioning", "lr"]


def study(where: OmitArgPrefixes[Where], how: OmitArgPrefixes[How], remake: OmitArgPrefixes[Remake]) -> None:
    """Run a whole scaling study: data, tokenizer, the three sweeps, CSV, figures and a report page.

    Run the same command again after an interruption: only what is missing is done.
    """
    _run("study", where, how, remake, commands.SCALING)


def sweep(
    axis: Positional[Axis],
    where: OmitArgPrefixes[Where],
    how: OmitArgPrefixes[How],
    remake: OmitArgPrefixes[Remake],
) -> None:
    """Run one axis: datasets, trajectories, width; settings, conditioning; or lr.

    The first three are those of `hma study`, the next two its ablations; lr is the transfer of
    learning rates between widths. Shares data and trials with other axes of the same --out.

    Args:
        axis: What varies.
        where: Which study, on which data, in which directory, on which devices.
        how: How trials are run; none of it changes a result.
        remake: What was made with other settings or data is never replaced without being asked for.
    """
    _run(f"sweep {axis}", where, how, remake, (axis,))


def _run(command: str, where: Where, how: How, remake: Remake, axes: tuple[str, ...]) -> None:
    setting = make_setting(where)
    if how.workers is not None and how.workers < 1:
        raise ConfigError(f"--workers must be at least 1, got {how.workers}")
    if how.dry_run:
        commands.dry_run(setting.study, axes)
        return
    commands.run_study(
        setting,
        axes,
        again=setting.command(command, *how.words(), "--retry-failed", *["--accept-code"] * how.accept_code),
        launcher=Launching(how.launcher, how.workers, how.launcher_set),
        retry_failed=how.retry_failed,
        accept_code=how.accept_code,
        replace=remake.replace,
    )


def tokenize(
    where: OmitArgPrefixes[Where],
    remake: OmitArgPrefixes[Remake],
    batch: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 256)")] = None,
    threads: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: one per core, up to 8)")
    ] = None,
) -> None:
    """Prepare everything up to training: suite, tokenizer, token store, evaluation windows.

    Killed at any point, the same command goes on and ends with the same bytes. Started several times, on one
    machine or on many that share the directory, it shares the work: each process takes parts that no other one
    has, any of them may be killed, more may join. Those that join need a tokenizer that is there: --tokenizer,
    or `hma tokenizer train` before.

    Args:
        where: Study, data, output directory and settings. Several processes share the directory.
        remake: What was made with other settings or data is never replaced without being asked for.
        batch: Frames encoded at a time. Changes no token.
        threads: Threads that decode frames.
    """
    tokenize_commands.tokenize(make_setting(where), batch, threads, remake.replace)


def train(
    where: OmitArgPrefixes[Where],
    one: OmitArgPrefixes[OneModel],
    options: OmitArgPrefixes[RunOptions],
    remake: OmitArgPrefixes[Remake],
    hosts: OmitArgPrefixes[Hosts],
) -> None:
    """Train one model: the study's reference trial, on all trajectories unless told otherwise.

    Change it with --set. Says what it trains on, and resumes a run that was interrupted.

    Args:
        where: Study, data, output directory and settings.
        one: How this model is trained; no sweep reads it.
        options: How the run is saved and watched; each start may say it anew.
        remake: What was made with other settings or data is never replaced without being asked for.
        hosts: Several processes that train together, on one host or on many.
    """
    hosts.join()
    setting = make_setting(where)
    model_commands.train(setting, one.directory(), options, trajectories=one.trajectories, replace=remake.replace)


def adapt(
    source: Annotated[Positional[Path], arg(metavar="RUN")],
    where: OmitArgPrefixes[Where],
    one: OmitArgPrefixes[OneModel],
    options: OmitArgPrefixes[RunOptions],
    remake: OmitArgPrefixes[Remake],
    hosts: OmitArgPrefixes[Hosts],
    everything: Annotated[FlagCreatePairsOff[bool], UNSET] = False,
) -> None:
    """Add new robots to a trained model and train them on the study's datasets.

    The model gets a stem, conditioning and head for every dataset it does not know. What it says of
    the robots it knows stays the same, bit for bit, unless everything is trained.

    Args:
        source: Directory of the training run that knows the other robots.
        where: The study with the new datasets. Give --tokenizer: the one of the trained model.
        one: How the new robots are trained.
        options: How the run is saved and watched; each start may say it anew.
        remake: What was made with other settings or data is never replaced without being asked for.
        hosts: Several processes that train together, on one host or on many.
        everything: Train the whole model, not the new robots' own parameters alone.
    """
    hosts.join()
    model_commands.adapt(
        make_setting(where),
        source,
        one.directory(),
        options,
        everything=everything,
        trajectories=one.trajectories,
        replace=remake.replace,
    )


def evaluate(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    where: OmitArgPrefixes[Where],
    hosts: OmitArgPrefixes[Hosts],
    weights: Weights = "auto",
) -> None:
    """Evaluate a trained model on the frozen windows of a study.

    Args:
        run: Directory of the training run.
        where: The study whose windows, tokenizer and protocol are used.
        hosts: Several processes that evaluate together, on one host or on many.
        weights: The last weights, their moving average (train.ema_decay), or the average where there is one.
    """
    hosts.join()
    model_commands.evaluate(make_setting(where), run, weights)


def report(out: Path) -> None:
    """Draw CSV, figures and page again from the trials that are finished.

    Args:
        out: Directory of a study that has run.
    """
    commands.draw_again(out)
