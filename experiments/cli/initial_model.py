"""The trained model from which a training run starts: the study that follows from its architecture, tokenizer and
robots, and what the run records of it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from data_pipelines.registry import get_spec
from experiments.cli.evaluate import check_tokenizer, tokenizer_mismatch
from experiments.running.workspace import Workspace
from experiments.study_setup import StudyArguments, StudySetup, make_setup
from experiments.terminal.progress import say, short
from experiments.terminal.words import few
from hma_jax.config import require
from hma_jax.config.json import diff
from hma_jax.training.run_lock import CHECKPOINTS

if TYPE_CHECKING:
    from hma_jax.training.runs import Run


def setup_of(source: Path, trained: Run, arguments: StudyArguments) -> StudySetup:
    """The study that continues from the model `trained`, which is in the directory `source`. Writes nothing.

    Raises ConfigError, before any work, for a model, tokens or actions other than those that it was made for.
    """
    arguments = arguments.anywhere()
    arguments = dataclasses.replace(arguments, tokenizer=_find_tokenizer(source, trained, arguments))
    setup = make_setup(arguments, trained.model)
    lines = diff(trained.model, setup.study.model, "model")
    require(
        not lines,
        f"{short(source)} is another model than --set asks for (there -> asked for): {'; '.join(lines)}. Leave out "
        "settings of the model: they are taken from there",
    )
    for name in known_datasets(trained, setup):
        get_spec(name).check_compatible(trained.table.entries[trained.table.index(name)], setup.study.rate)
    return setup


def known_datasets(trained: Run, setup: StudySetup) -> list[str]:
    """The datasets in a study whose robots the model knows."""
    return [name for name in setup.study.dataset_names() if name in trained.table.names]


def new_datasets(trained: Run, setup: StudySetup) -> list[str]:
    """The datasets in a study whose robots the model does not know."""
    return [name for name in setup.study.dataset_names() if name not in trained.table.names]


def require_known(source: Path, trained: Run, setup: StudySetup) -> None:
    """Raises ConfigError unless a model knows every robot of the study."""
    new = new_datasets(trained, setup)
    require(
        not new,
        f"{short(source)} knows {few(trained.table.names)}, not {few(new)}. To add them: "
        f"{setup.command('adapt', source)} --run NEW",
    )


def require_other_directory(source: Path, run: Path) -> None:
    """Raises ConfigError if the new run would have the directory of the model that it begins with."""
    require(
        run.resolve() != source.resolve(),
        f"{short(source)} holds the model that the new run begins with; give the new run a directory of its own with "
        "--run NEW",
    )


def _find_tokenizer(source: Path, trained: Run, arguments: StudyArguments) -> Path:
    """The directory of the tokenizer whose tokens a model takes: the one that is asked for, or one in the study's
    directory or beside the run. Raises ConfigError if none of these is the model's tokenizer."""
    from hma_jax.simulator.folder import TOKENIZER
    from hma_jax.tokenizers.io import load_tokenizer

    places: Sequence[Path] = (
        Workspace(arguments.out).tokenizer,
        source / TOKENIZER,
        Workspace.of_run(source).tokenizer,
    )
    places = [arguments.tokenizer] if arguments.tokenizer else [place for place in places if place.is_dir()]
    advice = f"; add --tokenizer with the directory of the one that {short(source)} was trained with"
    require(bool(places), f"{short(source)}: its tokenizer is neither beside it nor in {short(arguments.out)}{advice}")
    tokenizers = {place: load_tokenizer(place) for place in places}
    found = next((place for place in places if not tokenizer_mismatch(trained, tokenizers[place])), places[0])
    check_tokenizer(trained, tokenizers[found], advice)
    return found


def newest_description(run: Path) -> tuple[int, dict[str, Any]]:
    """(step, description) of the newest checkpoint of a run that has a description; (0, {}) without any."""
    from hma_jax.training.reading import CheckpointError, list_steps, read_description

    checkpoints = run.absolute() / CHECKPOINTS
    for newest in reversed(list_steps(checkpoints)):
        with suppress(CheckpointError):  # damage is reported, or skipped, by the code that restores the checkpoint
            return newest, read_description(checkpoints / str(newest))
    return 0, {}


def origin_of(run: Path, initial: Run | None) -> dict[str, Any] | None:
    """The origin of a run: step and provenance of the model `initial` that it begins with. For an existing run: those
    that it began with, which may be of an earlier step of that model. None without an initial model. Raises ConfigError
    for a run that began with another model."""
    _, described = newest_description(run)
    origin = None if initial is None else {"step": initial.step, "provenance": initial.provenance}
    if "table" not in described:  # not begun yet, or no model: then restoring reports it
        return origin
    taken, place = described["provenance"].get("origin"), "give the new run a directory of its own with --run NEW"
    if taken is None or origin is None:
        began, how = "with the weights of another model", "name that model again, as `hma train --from` or `hma adapt`"
        if taken is None:
            began, how = "by itself, not with the weights of another model", "leave out --from"
        require(taken == origin, f"{short(run)} began {began}: {how}, or {place}")
        return None
    lines = diff(taken["provenance"], origin["provenance"])
    lines += [f"step: {taken['step']:,} -> {origin['step']:,}"] if taken["step"] > origin["step"] else []
    require(
        not lines,
        f"{short(run)} began with another model than the one that is asked for (there -> asked for): "
        f"{'; '.join(lines)}; name that one, or {place}",
    )
    if taken["step"] < origin["step"]:
        say(
            f"note: {short(run)} began with step {taken['step']:,} of a model that has {origin['step']:,} by now, and "
            "goes on from its own checkpoint"
        )
    return taken


def load_initial(source: Path, run: Path) -> Run:
    """The trained model in `source`. If that was removed and `run` began with it: what the run recorded of it, which
    together with the run's own checkpoint is enough to continue."""
    from hma_jax.training.runs import load_run

    origin = None if source.exists() else newest_description(run)[1].get("provenance", {}).get("origin")
    if origin is None:
        return load_run(source, "auto")
    say(f"note: {short(source)} is gone; {short(run)} goes on from its own checkpoint, and was not compared with it")
    return dataclasses.replace(load_run(run), step=origin["step"], provenance=origin["provenance"])
