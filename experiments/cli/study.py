"""Commands that work on a study: all of it, one axis, one step, one model."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import OmitArgPrefixes, Positional

from experiments.cli.where import How, Where
from experiments.commands import model as model_commands
from experiments.commands import study as commands
from experiments.commands import tokenize as tokenize_commands
from hma_jax.config import ConfigError

Axis = Literal["datasets", "trajectories", "width", "settings", "conditioning", "lr"]


def study(where: OmitArgPrefixes[Where], how: OmitArgPrefixes[How]) -> None:
    """Run a whole scaling study: data, tokenizer, the three sweeps, CSV, figures and a report page.

    Run the same command again after an interruption: only what is missing is done.
    """
    _run(where, how, commands.SCALING)


def sweep(axis: Positional[Axis], where: OmitArgPrefixes[Where], how: OmitArgPrefixes[How]) -> None:
    """Run one axis: datasets, trajectories, width; settings, conditioning; or lr.

    The first three are those of `hma study`, the next two its ablations; lr is the transfer of
    learning rates between widths. Shares data and trials with other axes of the same --out.
    """
    _run(where, how, (axis,))


def _run(where: Where, how: How, axes: tuple[str, ...]) -> None:
    setting = where.setting()
    if how.workers < 1:
        raise ConfigError(f"--workers must be at least 1, got {how.workers}")
    if how.dry_run:
        commands.dry_run(setting.study, axes)
        return
    commands.run_study(
        commands.on_mesh(setting, how.mesh), axes, workers=how.workers, retry_failed=how.retry_failed
    )


def tokenize(
    where: OmitArgPrefixes[Where],
    process: int | None = None,
    processes: int | None = None,
    batch: int | None = None,
    threads: int | None = None,
) -> None:
    """Prepare everything up to training: suite, tokenizer, token store, evaluation windows.

    Killed at any point, the same command goes on and ends with the same bytes. Several processes
    or machines share the work if each gets its number; SLURM's arrays and tasks, and Open MPI's, are
    understood by themselves. The tokenizer must be there then: --tokenizer, or `hma tokenizer train` before.

    Args:
        where: Study, data, output directory and settings. The output must be shared by all processes.
        process: Number of this process, from 0 on.
        processes: How many processes share the work; 1 for all of it, whatever SLURM says.
        batch: Frames encoded at a time; 256 if not given. Changes no token.
        threads: Threads that decode frames; one per core up to 8 if not given.
    """
    tokenize_commands.tokenize(where.setting(), process, processes, batch, threads)


def train(
    where: OmitArgPrefixes[Where],
    run: Path | None = None,
    mesh: tuple[int, int, int] | None = None,
) -> None:
    """Train one model, the study's reference trial; change it with --set.

    Args:
        where: Study, data, output directory and settings.
        run: Directory of the training run; OUT/model if not given. Resumed if it exists.
        mesh: Devices for data, fsdp and tensor parallelism; -1 takes those that are left. Short for --set
            execution.mesh.data=... and so on.
    """
    model_commands.train(commands.on_mesh(where.setting(), mesh), run)


def adapt(
    source: Positional[Path],
    where: OmitArgPrefixes[Where],
    run: Path | None = None,
    everything: bool = False,
    mesh: tuple[int, int, int] | None = None,
) -> None:
    """Add new robots to a trained model and train them on the study's datasets.

    The model gets a stem, conditioning and head for every dataset it does not know. What it says of
    the robots it knows stays the same, bit for bit, unless everything is trained.

    Args:
        source: Directory of the training run that knows the other robots.
        where: The study with the new datasets. Give --tokenizer: the one of the trained model.
        run: Directory of the new training run; OUT/model if not given. Resumed if it exists.
        everything: Train the whole model, not the new robots' own parameters alone.
        mesh: Devices for data, fsdp and tensor parallelism; -1 takes those that are left. Short for --set
            execution.mesh.data=... and so on.
    """
    model_commands.adapt(commands.on_mesh(where.setting(), mesh), source, run, everything)


def evaluate(run: Positional[Path], where: OmitArgPrefixes[Where]) -> None:
    """Evaluate a trained model on the frozen windows of a study.

    Args:
        run: Directory of the training run.
        where: The study whose windows, tokenizer and protocol are used.
    """
    model_commands.evaluate(where.setting(), run)


def report(out: Path) -> None:
    """Draw CSV, figures and page again from the trials that are finished.

    Args:
        out: Directory of a study that has run.
    """
    commands.draw_again(out)
