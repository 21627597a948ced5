"""`hma tokenize`: prepares everything up to training, in one process or in many."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import numpy as np
from rich.markup import escape
from tyro.conf import arg

from data_pipelines.errors import MAX_LISTED, without_advice
from data_pipelines.publishing.output_lock import backoff
from experiments.cli.arguments import ReplaceOptions, StudyOptions
from experiments.data_size import read_data
from experiments.preparing.made_from import Step
from experiments.running.workspace import Busy, Workspace
from experiments.study_setup import StudySetup, make_setup
from experiments.sweeps.sweep import reference_trial
from experiments.terminal.progress import console, say, short, tidy_table, wrote
from hma_jax.config import require

if TYPE_CHECKING:
    from experiments.preparing.sources import Source


def tokenize(
    arguments: StudyOptions,
    replacement: ReplaceOptions,
    batch: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: 256)")] = None,
    threads: Annotated[int | None, arg(metavar="N", help_behavior_hint="(default: one per core, up to 8)")] = None,
) -> None:
    """Prepare everything up to training: suite, tokenizer, token store, evaluation windows.

    Run the same command again after an interruption: it continues, and the result has the same bytes. To share the
    work, start it several times, on one machine or on several that share the directory: each process takes the next
    free part. Processes may be killed or added at any time. Those that join need an existing tokenizer: run
    `hma tokenizer train` first, or give --tokenizer.

    Args:
        arguments: Study, data, output directory and settings. Several processes share the directory.
        replacement: Results made with other settings or data are replaced only on request.
        batch: Smallest number of frames encoded at a time: it is rounded up to fill all devices. Does not change any
            token.
        threads: Threads that decode frames, also to train a tokenizer.
    """
    prepare_together(make_setup(arguments), batch, threads, replacement.replace)


def prepare_together(setup: StudySetup, batch: int | None, threads: int | None, replace: Step | None) -> None:
    """Everything up to training. If another command prepares the same directory, takes part in its tokenising."""
    from experiments.preparing.pipeline import prepare

    for option, value in (("--batch", batch), ("--threads", threads)):  # before a tokenizer is trained for hours
        require(value is None or value >= 1, f"{option} must be at least 1, got {value}")
    whole = dataclasses.replace(reference_trial(setup.study, setup.study.seeds[0]), max_trajectories=None)
    if setup.data:
        from experiments.dry_run.notes import say_scale

        say_scale(setup, [whole])
    with ExitStack() as stack:
        try:
            stack.enter_context(setup.workspace.locked())
        except Busy as busy:
            _take_part(setup, busy, batch, threads, replace)
        else:
            prepare(
                setup.study, setup.workspace, setup.data, setup.tokenizer,
                replace=replace, batch=batch, threads=threads,
            )  # fmt: skip
    show_store(setup.workspace, setup.study.rate)
    if any(facts["windows"] for facts in read_data(setup.workspace.data_summary).values()):
        from data_pipelines.tokens.store import TokenStore
        from experiments.cli.mixture import show_mixture

        show_mixture(TokenStore(setup.workspace.store), whole)
    wrote(setup.workspace.store, setup.workspace.manifest, then=setup.command("train"))


def _take_part(setup: StudySetup, busy: Busy, batch: int | None, threads: int | None, replace: Step | None) -> None:
    """Joins in the tokenising, but makes no tokenizer and replaces nothing: the process that holds the directory relies
    on what is there."""
    from experiments.preparing.asked import require_same_asked
    from experiments.preparing.given_tokenizer import require_same_tokenizer
    from experiments.preparing.sources import find_sources, find_suite
    from experiments.preparing.store import make_store
    from experiments.preparing.windows import require_same_windows

    study, workspace = setup.study, setup.workspace
    if replace is not None:
        raise Busy(f"{busy}; with --replace no other command may use the directory", busy.holder)
    tokenizer = setup.tokenizer or workspace.tokenizer
    if not tokenizer.is_dir():
        advice = f"Start this again when the tokenizer exists, or train it first: {setup.command('tokenizer train')}"
        raise Busy(f"{tokenizer}: no tokenizer yet, and {busy}. {advice}", busy.holder)
    require_same_windows(study, workspace, None)
    if setup.data:
        sources = find_sources(study, setup.data)
    else:
        advice = f"Start this again when they exist, or make them first: {setup.command('data suite')}"
        sources = find_suite(study, workspace, advice)
    require_same_asked(study, workspace, sources, setup.tokenizer, busy)
    require_same_tokenizer(setup.tokenizer, study, workspace, sources)
    say(f"sharing the work with {busy.who}, which prepares {short(workspace.root)}")
    make_store(study, workspace, sources, tokenizer=tokenizer, batch=batch, threads=threads)
    _freeze(setup, sources)


def _freeze(setup: StudySetup, sources: Sequence[Source]) -> None:
    """Makes sure that a complete store's windows are frozen, by the process that holds the directory or by this one."""
    from experiments.preparing.given_tokenizer import adopt_tokenizer
    from experiments.preparing.windows import freeze_windows, windows_are_frozen

    study, workspace, announced = setup.study, setup.workspace, False
    for pause in backoff():
        try:
            with workspace.locked():
                if setup.tokenizer is not None:
                    adopt_tokenizer(setup.tokenizer, study, workspace, sources)
                freeze_windows(study, workspace)
            return
        except Busy as busy:
            if windows_are_frozen(study, workspace):
                return
            if not announced:
                say(f"all tokens are made; waiting until {busy.who} has frozen the windows or ends")
                announced = True
        time.sleep(pause)


def show_store(workspace: Workspace, rate: float | None) -> None:
    """Prints what the token store holds for each dataset, and its stride in a study at `rate` Hz (None: native)."""
    from data_pipelines.tokens.manifest import FILE
    from data_pipelines.tokens.store import TokenStore

    store = TokenStore(workspace.store)
    lengths = ("shortest", "median", "longest")
    title = "The token store: episodes, native frames, lengths of training episodes"
    table = tidy_table(title, "dataset", "train", "held out", "lost", "frames", *lengths, "Hz", "stride")
    for name in store.names:
        manifest = store.manifest(name)
        steps = np.asarray(manifest.train.steps)
        table.add_row(
            name,
            f"{len(steps)}",
            f"{len(manifest.val.steps)}",
            f"{manifest.skipped_count}",
            f"{manifest.train.native_frames + manifest.val.native_frames}",
            f"{steps.min()}",
            f"{np.median(steps):g}",
            f"{steps.max()}",
            f"{manifest.spec.hz:g}",
            f"{manifest.spec.stride_at(rate)}",
        )
    console.print(table)
    for name in store.names:
        skipped = store.manifest(name).skipped
        for one in skipped[:MAX_LISTED]:
            console.print(f"[yellow]lost[/] {name}: {escape(without_advice(one.reason))}", soft_wrap=True)
        if rest := sum(one.episodes for one in skipped[MAX_LISTED:]):
            console.print(
                f"[yellow]lost[/] {name}: {rest:,} more, see {short(store.root / name / FILE)}", soft_wrap=True
            )
