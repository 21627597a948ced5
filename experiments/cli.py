"""The `hma` command line: arguments, help and error messages. What commands do is in `commands`.

Exit codes: 0 done; 1 the work failed (data, a trial, a full disk); 2 wrong arguments or
configuration; 130 interrupted. `--debug` or HMA_DEBUG=1 shows the traceback of an error.
Imports no JAX, so that --help is instant.
"""

from __future__ import annotations

import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import OmitArgPrefixes, Positional, UseAppendAction, arg
from tyro.extras import SubcommandApp

from experiments import (
    cli_bench,
    cli_convert,
    cli_data,
    commands,
    model_commands,
    registry_commands,
    tokenize_commands,
)
from experiments.cli_fit import fit
from experiments.cli_sim import data_sim, data_sim_table
from experiments.cli_tokenizer import tokenizer_app
from experiments.program import PROGRAM
from experiments.progress import errors
from hma_jax.config import ConfigError, MeshConfig

Preset = Literal["smoke", "cpu", "accelerator", "paper", "smoke-continuous", "cpu-continuous"]
Axis = Literal["datasets", "trajectories", "width", "settings", "conditioning", "lr"]


@dataclass(frozen=True)
class Where:
    """Which study, on which data, in which directory."""

    preset: Preset = "cpu"
    """Named study: smoke (seconds), cpu (minutes), accelerator (one GPU), paper (as published); with
    -continuous, on latents instead of ids."""
    out: Path | None = None
    """Directory for everything that is written; runs/PRESET if not given."""
    data: Annotated[tuple[str, ...], arg(metavar="[DIR ...]")] = ()
    """Your RLDS directories, paths or URLs such as gs://..., instead of the simulated suite. Their names must
    be in the registry."""
    registry: Path | None = None
    """TOML file with registry entries of your own, as `hma data inspect --entry` writes it."""
    mixture: str | None = None
    """Named list of datasets, such as dataset10; --data then takes the directories that hold them."""
    tokenizer: Path | None = None
    """Directory of a tokenizer to use, instead of training one on the data. The model's tokens follow it."""
    set: Annotated[UseAppendAction[tuple[str, ...]], arg(metavar="PATH=VALUE")] = ()
    """Change one setting, such as --set model.frames=4 --set train.steps=100; may be repeated."""

    def setting(self) -> commands.Setting:
        return commands.make_setting(
            self.preset, self.out, self.data, self.set, self.tokenizer, self.registry, self.mixture
        )


@dataclass(frozen=True)
class How:
    """How trials are run; none of it changes a result."""

    workers: int = 1
    """Trials at a time, each in its own process with its share of the cores."""
    retry_failed: Annotated[bool, arg(name="retry-failed")] = False
    """Run trials again that failed or diverged; otherwise they stay as they are, and visible."""
    dry_run: Annotated[bool, arg(name="dry-run")] = False
    """Print trials, parameters, FLOPs and expected time, and stop."""
    mesh: tuple[int, int, int] = (-1, 1, 1)
    """Devices for data, fsdp and tensor parallelism; -1 takes those that are left."""


app = SubcommandApp()
data_app = SubcommandApp()


@app.command(name="study")
def study(where: OmitArgPrefixes[Where], how: OmitArgPrefixes[How]) -> None:
    """Run a whole scaling study: data, tokenizer, the three sweeps, CSV, figures and a report page.

    Run the same command again after an interruption: only what is missing is done.
    """
    _run(where, how, commands.SCALING)


@app.command(name="sweep")
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
    mesh = MeshConfig(*how.mesh)
    if how.dry_run:
        commands.dry_run(setting.study, axes)
        return
    commands.run_study(setting, axes, workers=how.workers, retry_failed=how.retry_failed, mesh=mesh)


@data_app.command(name="list")
def data_list(
    words: Annotated[Positional[tuple[str, ...]], arg(metavar="[WORD ...]")] = (),
    mixture: str | None = None,
    registry: Path | None = None,
) -> None:
    """List the datasets that the registry knows: camera, action size, rate.

    Args:
        words: Only entries with all these words in name, note, camera or group ("open-x", "franka").
        mixture: Only the datasets of this mixture: dataset5, 10, 20, 30, 40 or dataset30_vae.
        registry: TOML file with entries of your own.
    """
    registry_commands.list_datasets(words, mixture, registry)


@data_app.command(name="inspect")
def data_inspect(
    directory: Positional[Path],
    hz: float | None = None,
    split: str = "train",
    out: Path | None = None,
    episodes: int = 32,
    frames: int = 12,
    json: Path | None = None,
    entry: Path | None = None,
    registry: Path | None = None,
) -> None:
    """Show what an RLDS directory holds, draw a contact sheet, and suggest its registry entry.

    Args:
        directory: The dataset: <name> or <name>/<version>, as tfds wrote it.
        hz: Native rate of its frames; no file says it.
        split: The split to look at.
        out: Directory for contact_sheet.png; runs/inspect/NAME if not given.
        episodes: Read so many episodes, drawn at random; fewer if they come to more than 2 GB.
        frames: Frames of the model's window, to count windows.
        json: Write everything there as JSON.
        entry: Add the suggested entry to this TOML file, for --registry.
        registry: TOML file with entries of your own.
    """
    registry_commands.inspect(
        directory, split=split, hz=hz, out=out, episodes=episodes, frames=frames, as_json=json,
        entry=entry, registry=registry,
    )  # fmt: skip


@data_app.command(name="suite")
def data_suite(where: OmitArgPrefixes[Where]) -> None:
    """Write the study's simulated datasets as RLDS directories."""
    commands.write_suite(where.setting())


data_app.command(name="sim")(data_sim)
data_app.command(name="sim-table")(data_sim_table)


@tokenizer_app.command(name="train")
def tokenizer_train(where: OmitArgPrefixes[Where]) -> None:
    """Train the study's image tokenizer on its datasets."""
    commands.train_tokenizer(where.setting())


@app.command(name="tokenize")
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


@app.command(name="train")
def train(
    where: OmitArgPrefixes[Where],
    run: Path | None = None,
    mesh: tuple[int, int, int] = (-1, 1, 1),
) -> None:
    """Train one model, the study's reference trial; change it with --set.

    Args:
        where: Study, data, output directory and settings.
        run: Directory of the training run; OUT/model if not given. Resumed if it exists.
        mesh: Devices for data, fsdp and tensor parallelism; -1 takes those that are left.
    """
    model_commands.train(where.setting(), run, MeshConfig(*mesh))


@app.command(name="adapt")
def adapt(
    source: Positional[Path],
    where: OmitArgPrefixes[Where],
    run: Path | None = None,
    everything: bool = False,
    mesh: tuple[int, int, int] = (-1, 1, 1),
) -> None:
    """Add new robots to a trained model and train them on the study's datasets.

    The model gets a stem, conditioning and head for every dataset it does not know. What it says of
    the robots it knows stays the same, bit for bit, unless everything is trained.

    Args:
        source: Directory of the training run that knows the other robots.
        where: The study with the new datasets. Give --tokenizer: the one of the trained model.
        run: Directory of the new training run; OUT/model if not given. Resumed if it exists.
        everything: Train the whole model, not the new robots' own parameters alone.
        mesh: Devices for data, fsdp and tensor parallelism; -1 takes those that are left.
    """
    model_commands.adapt(where.setting(), source, run, everything, MeshConfig(*mesh))


@app.command(name="evaluate")
def evaluate(run: Positional[Path], where: OmitArgPrefixes[Where]) -> None:
    """Evaluate a trained model on the frozen windows of a study.

    Args:
        run: Directory of the training run.
        where: The study whose windows, tokenizer and protocol are used.
    """
    model_commands.evaluate(where.setting(), run)


@app.command(name="report")
def report(out: Path) -> None:
    """Draw CSV, figures and page again from the trials that are finished.

    Args:
        out: Directory of a study that has run.
    """
    commands.draw_again(out)


data_app.command(cli_data.convert_app, name="convert", help=cli_data.HELP)
data_app.command(cli_data.import_tokens, name="import-tokens")
app.command(fit, name="fit")
app.command(data_app, name="data", help="The registry, what a directory holds, other formats, the simulated suite.")
app.command(tokenizer_app, name="tokenizer", help="The image tokenizer.")
app.command(cli_convert.convert_app, name="convert", help=cli_convert.HELP)
app.command(cli_bench.bench_app, name="bench", help=cli_bench.HELP)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs a command and returns the exit code; errors become one message on stderr.

    Without `arguments`, those of the process, which is then taken to be this program's own.
    """
    own_process = arguments is None
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    debug = os.environ.get("HMA_DEBUG", "0") not in ("", "0")
    if "--debug" in arguments:
        arguments.remove("--debug")
        debug = True
    if own_process and not debug:
        _silence_background()
    try:
        app.cli(
            prog=PROGRAM,
            description="HMA-JAX: scaling studies of an action-conditioned video model over many robots.",
            args=arguments or ["--help"],
        )
        return 0
    except KeyboardInterrupt:
        _say("interrupted; the same command goes on from here")
        return 130
    except Exception as error:  # the boundary of the program
        code = _exit_code(error)
        if debug or code is None:
            raise
        _say(f"error: {_words(error)}")
        return code


def _silence_background() -> None:
    """For the rest of this process: reader tasks of a checkpoint that turns out damaged report it in
    pages of their own, from threads and destructors where nothing can catch it, until the very
    end. The error message says it once.
    """
    sys.unraisablehook = lambda _: None
    logging.getLogger("asyncio").setLevel(logging.CRITICAL)


def _exit_code(error: Exception) -> int | None:
    """None for what is not the user's business: a bug, shown with its traceback."""
    from data_pipelines.errors import DataError

    if isinstance(error, ConfigError):
        return 2
    if isinstance(error, (DataError, commands.TrialsFailed, OSError)):
        return 1
    if "jax" in sys.modules:  # otherwise none of these can have been raised
        from hma_jax.training.loop import DivergedError, Interrupted

        if isinstance(error, (DivergedError, Interrupted)):
            return 130 if isinstance(error, Interrupted) else 1
    return None


def _words(error: Exception) -> str:
    """The message of an error, and what it cannot know: how its advice is followed from here."""
    from data_pipelines.errors import EpisodeError

    if isinstance(error, EpisodeError):
        return f"{error} (Here: --set store.corrupt=skip.)"
    if isinstance(error, OSError) and error.strerror:
        place = f"{error.filename}: " if error.filename else ""
        return f"{place}{error.strerror}; check the path, its permissions and the space on its disk"
    return str(error)


def _say(message: str) -> None:
    errors.print(message, markup=False, soft_wrap=True)


if __name__ == "__main__":
    sys.exit(main())
