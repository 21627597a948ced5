"""`hma evaluate`: evaluates a trained model on the frozen windows of a study, if the model was made for them."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from experiments.cli.arguments import StudyOptions
from experiments.cli.hosts import Hosts
from experiments.preparing.evaluation_stamp import STAMP, UNFINISHED, describe_evaluation, require_same_evaluation
from experiments.running.attempts import EVALUATING, JOB
from experiments.running.provenance import closure_hash, trial_closure
from experiments.running.result_file import SAMPLES
from experiments.study_setup import UNSET, StudySetup, make_setup, require_local, under_another_name
from experiments.terminal.progress import TidyTable, console, say, short, step, tidy_table, wrote
from experiments.terminal.words import few, plus_minus
from hma_jax.config import ConfigError, Weights, require
from hma_jax.config.json import from_dict, to_dict, to_strict_json
from hma_jax.evaluation.measures import METRICS
from hma_jax.evaluation.windows import FILE
from hma_jax.runtime.files import sync, write_file
from hma_jax.training.run_lock import CHECKPOINTS, EVALUATION, locked_run

if TYPE_CHECKING:
    from data_pipelines.tokens.store import TokenStore
    from experiments.preparing.made_from import MadeFrom
    from experiments.running.run_trial import PreparedData
    from hma_jax.evaluation.evaluate import Evaluation
    from hma_jax.evaluation.summary import Summary
    from hma_jax.tokenizers.base import Tokenizer
    from hma_jax.training.runs import Run

MEANS = "evaluation.json"
"""Every metric's mean per dataset, with its error."""


def evaluate(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    arguments: StudyOptions,
    hosts: OmitArgPrefixes[Hosts],
    weights: Weights = "auto",
    to: Annotated[Path | None, arg(metavar="DIR", help_behavior_hint="(default: RUN)")] = None,
    replace: Annotated[FlagCreatePairsOff[bool], UNSET] = False,
) -> None:
    """Evaluate a trained model on the frozen windows of a study.

    Args:
        run: Directory of the training run.
        arguments: The study whose windows, tokenizer and protocol are used.
        hosts: Several processes that evaluate together, on one host or on many.
        weights: last: the last weights; ema: their moving average (train.ema_decay); auto: the average if there is one.
        to: Directory for the results, to keep those of several sets of windows.
        replace: Overwrite existing results of other data, windows or settings.
            Without it they are kept, and the command is refused.
    """
    hosts.join()
    evaluate_model(make_setup(arguments), run, weights, to, replace)


def evaluate_model(setup: StudySetup, run: Path, weights: Weights, to: Path | None, replace: bool) -> None:
    """Writes results into `to`, or else into `run`. Raises ConfigError if other results exist there, unless they may be
    replaced."""
    from hma_jax.runtime.processes import is_writer
    from hma_jax.training.runs import load_run

    require_local("--to", to)
    require(
        to is None or not (to / JOB).is_file(),
        f"--to {to} is the directory of a trial, whose results must not be changed; choose another --to",
    )
    trained = load_run(run, weights)  # into host memory: it may be too large for one device
    # Before the work, make sure that its results can be written, and that no other process writes there.
    with locked_run(to or run, EVALUATION) if is_writer() else nullcontext():
        _evaluate(setup, run, trained, to or run, replace)


def _evaluate(setup: StudySetup, run: Path, trained: Run, place: Path, replace: bool) -> None:
    from experiments.running.run_trial import evaluate_on, open_prepared_data
    from hma_jax.evaluation.parts import Parts
    from hma_jax.runtime.processes import is_writer
    from hma_jax.training.hashes import read_list

    _require_known_data(setup, trained)
    require_prepared(setup)
    prepared = open_prepared_data(setup.workspace)
    check_fits(trained, prepared)
    names = _choose_datasets(setup, trained, prepared)
    execution, protocol = setup.study.execution, setup.study.eval
    made_from = describe_evaluation(trained, names, prepared, protocol)
    if not replace:
        require_same_evaluation(place, made_from)
    # More than the stamp holds: the batch size decides which windows share a batch, and a run that was trained again
    # may have other weights at the same step.
    weights = read_list(run / CHECKPOINTS / str(trained.step))
    depends = lambda: [made_from.identity(), weights, protocol.batch, to_dict(execution), closure_hash(trial_closure())]
    parts = Parts(place / EVALUATING, depends)
    with step(f"evaluate {short(run)}") as update:
        evaluation = evaluate_on(
            names,
            trained.params,
            trained.model,
            trained.table,
            prepared,
            protocol,
            trained.train.masking.setting,
            execution=execution,
            progress=lambda phase, done, total: update(done, total, phase),
            parts=parts,
        )
    if not is_writer():
        return
    summary = evaluation.summary
    which = ", averaged weights" if trained.weights == "ema" else ""
    of = "" if trained.finished else f" of {trained.train.steps:,}"
    when = f", step {trained.step:,}{of}" if trained.step else ""  # a converted run has made no step here
    console.print(table_of(summary, f"{short(run)}{when}{which}"))
    write_results(place, evaluation, made_from)
    parts.remove()
    wrote(place / MEANS, place / FILE, *[place / SAMPLES] * bool(evaluation.samples))


def write_results(place: Path, evaluation: Evaluation, made_from: MadeFrom) -> None:
    """Writes the files of an evaluation into `place`. Earlier files there stay until all new ones are on the disk;
    OSError is raised, and they are kept, if that fails."""
    from experiments.running.run_trial import write_evaluation

    made, moving = place / UNFINISHED, False
    try:
        shutil.rmtree(made, ignore_errors=True)  # a killed process left it
        made.mkdir()
        write_evaluation(made, evaluation, place.name)
        write_file(made / MEANS, to_strict_json(evaluation.summary.to_dict()))
        made_from.save(made, STAMP)
        moving = True
        for name in (STAMP, MEANS, SAMPLES):  # if killed here, no file may be left beside files of another evaluation
            (place / name).unlink(missing_ok=True)
        for name in (FILE, SAMPLES, MEANS, STAMP):
            if (made / name).exists():
                os.replace(made / name, place / name)
        sync(place)
        moving = False
    except OSError as error:
        error.filename = str(place)  # the only path that the user knows
        raise
    finally:
        if not moving:  # otherwise what is left there says of what the files in `place` are
            shutil.rmtree(made, ignore_errors=True)


def _choose_datasets(setup: StudySetup, trained: Run, prepared: PreparedData) -> tuple[str, ...]:
    """The datasets on whose windows a model is evaluated. Prints notes on datasets that are left out, and what a reader
    of the results should know about the others."""
    frozen, empty = set(prepared.manifest.names), prepared.manifest.empty
    known, untrained = trained.table.names, _not_trained_on(trained, prepared)
    if not trained.train.masking.predicts_frames:
        say(
            f"note: the model was trained with train.masking.setting {trained.train.masking.setting!r}, which predicts no "
            "frames, so only its actions are evaluated"
        )
    if absent := [name for name in known if name not in frozen and name not in empty]:
        say(f"note: not evaluated, because the study does not have them: {', '.join(absent)}")
    for name in [name for name in known if name in empty]:
        say(f"note: {name} is not evaluated: {empty[name]}")
    if unseen := [name for name in untrained if name in frozen]:
        say(f"note: not evaluated, because the model was not trained on them: {', '.join(unseen)}")
    names = tuple(name for name in known if name in frozen - set(untrained))
    besides = [name for name in names if setup.data and name not in setup.study.dataset_names()]
    if besides:
        say(
            f"note: all windows frozen in {short(setup.workspace.root)} are evaluated, also those of "
            f"{few(besides)}, which --data does not name"
        )
    _note_other_data(setup, prepared)
    note_possible_leakage(trained, names, prepared.store)
    return names


def table_of(summary: Summary, title: str) -> TidyTable:
    """The displayed metrics, per dataset and over all."""
    metrics = [name for name, metric in METRICS.items() if metric.evaluated and name in summary.overall]
    table = tidy_table(title, "dataset", *metrics)
    for name, stats in [*summary.datasets.items(), ("overall", summary.overall)]:
        table.add_row(name, *(plus_minus(stats[m].mean, stats[m].sem) if m in stats else "" for m in metrics))
    judged = {name: stats for name, stats in summary.datasets.items() if stats}
    if alone := [name for name, stats in judged.items() if all(s.clusters == 1 for s in stats.values())]:
        table.caption = f"No standard error for {few(alone)}: there is only one held-out episode."
    return table


def _note_other_data(setup: StudySetup, prepared: PreparedData) -> None:
    """Prints a note if the windows were frozen on recordings other than those that --data and --registry give."""
    from experiments.preparing.store import data_differences

    if lines := data_differences(setup.study, setup.workspace, setup.data, prepared.tokenizer):
        say(
            f"note: the windows frozen in {short(setup.workspace.root)} are evaluated, whose tokens were made "
            f"from other data than --data and the registry give (there -> given): {'; '.join(lines)}"
        )


def _not_trained_on(trained: Run, prepared: PreparedData) -> list[str]:
    """Datasets that a model was to be trained on, but that had no training window."""
    from data_pipelines.loading.selection import LoaderConfig, select_windows

    loader = trained.provenance.get("loader")
    if loader is None:  # it was converted
        return []
    config = from_dict(LoaderConfig, loader)
    if not set(config.datasets) <= set(prepared.store.names):
        return []
    return list(select_windows(prepared.store, config).mixture.dropped)


def note_possible_leakage(trained: Run, names: Sequence[str], store: TokenStore) -> None:
    """Prints a note if a model may have been trained on episodes that are held out in `store` (data leakage)."""
    if elsewhere := trained_on_other_tokens(trained, names, store):
        say(
            f"note: {few(elsewhere)}: the model, or the one that it was initialised from, was trained on other tokens than "
            "those of this study, so it may have been trained on episodes that are held out here; not if only "
            "store.max_train, or what an entry `joins`, differs. In the --out that it was trained in, held-out episodes "
            "are new to it"
        )


def trained_on_other_tokens(trained: Run, names: Sequence[str], store: TokenStore) -> list[str]:
    """The robots of `names` for which the model, or the model that it was initialised from, was trained on tokens other
    than those of `store`, as far as can be told. Another choice of held-out episodes makes another store. A run keeps
    one hash for all its datasets: if one dataset differs or is missing here, all are listed."""
    found: list[str] = []
    provenance = trained.provenance
    while "loader" in provenance:
        datasets = provenance["loader"]["datasets"]
        same = set(datasets) <= set(store.names) and store.hash(datasets) == provenance["store"]
        found += [] if same else [name for name in names if name in datasets]
        provenance = provenance.get("origin", {}).get("provenance", {})
    return found


def require_prepared(setup: StudySetup) -> None:
    """Raises ConfigError, with the command that makes it, if something that evaluation reads is missing."""
    workspace = setup.workspace
    missing = [str(p) for p in (workspace.store, workspace.tokenizer, workspace.manifest) if not p.exists()]
    require(not missing, f"{', '.join(missing)}: not made yet; run `{setup.command('tokenize')}`")


def _require_known_data(setup: StudySetup, trained: Run) -> None:
    """Raises ConfigError if the tokens do not exist yet and the model knows none of the study's datasets."""
    known, given = trained.table.names, setup.study.dataset_names()
    require(
        not setup.data or setup.workspace.manifest.exists() or bool(set(known) & set(given)),
        f"the model knows {few(known)}, but --data has {few(given)}. {under_another_name(given)}",
    )


def check_fits(trained: Run, prepared: PreparedData) -> None:
    """Raises ConfigError if a model was trained for tokens, windows or datasets other than these."""
    frames, manifest = trained.model.frames, prepared.manifest
    tokens = windows = data = "; evaluate it with the --out it was trained in"
    if _converted(trained):  # it was trained in none
        tokens = "; prepare a study with --tokenizer and the directory of the one that it was trained with"
        windows = f"; prepare a study with --set model.frames={frames}"
        data = "; prepare a study with --data of one of them"
    check_tokenizer(trained, prepared.tokenizer, tokens)
    if frames != manifest.frames:
        raise ConfigError(
            f"the model has windows of {frames} frames, but those frozen for evaluation here have "
            f"{manifest.frames}{windows}"
        )
    if not set(trained.table.names) & {d.dataset for d in manifest.datasets}:
        raise ConfigError(
            f"the model was trained on {', '.join(trained.table.names)}, but the study has no windows of these{data}"
        )


def check_tokenizer(trained: Run, tokenizer: Tokenizer, advice: str) -> None:
    """Raises ConfigError, with `advice`, if the model was not trained on the tokenizer's tokens."""
    if why := tokenizer_mismatch(trained, tokenizer):
        raise ConfigError(why + advice)
    if _converted(trained):
        say(
            "note: the model was read in the official release's format, which does not say on which tokens it was "
            f"trained; it is assumed that they are those of the tokenizer here, {tokenizer.identity}"
        )


def tokenizer_mismatch(trained: Run, tokenizer: Tokenizer) -> str:
    """Why a model was not trained on the tokens of this tokenizer; '' if it was. A converted model does not record its
    tokenizer: then the form of its tokens decides."""
    from hma_jax.tokenizers.base import token_mismatch

    if not _converted(trained):
        own, here = trained.provenance.get("tokenizer"), tokenizer.identity
        return "" if own == here else f"the model was trained on tokens of tokenizer {own}, but the study uses {here}"
    return token_mismatch(trained.model, tokenizer)


def _converted(trained: Run) -> bool:
    return "official" in trained.provenance and "tokenizer" not in trained.provenance
