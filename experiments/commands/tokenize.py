"""What `hma tokenize` does: everything up to training, by one process or by many."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from rich.markup import escape

from experiments.commands.study import wrote
from experiments.preparing.made_from import Step
from experiments.progress import console, tidy_table
from experiments.setting import Setting
from experiments.workspace import Busy, Workspace
from hma_jax.config import require

if TYPE_CHECKING:
    from data_pipelines.tokens.share import Share


def tokenize(
    setting: Setting,
    process: int | None = None,
    processes: int | None = None,
    batch: int | None = None,
    threads: int | None = None,
    replace: Step | None = None,
) -> None:
    """Everything up to training, or this process's share of the tokens."""
    from data_pipelines.tokens.share import find_share
    from experiments.pipeline import prepare

    share = find_share(process, processes, os.environ)
    if share.processes > 1:
        _tokenize_share(setting, share, batch, threads, replace)
        return
    with setting.workspace.claimed():
        prepare(
            setting.study, setting.workspace, setting.data, setting.tokenizer,
            replace=replace, batch=batch, threads=threads,
        )  # fmt: skip
    _finish(setting)


def _tokenize_share(
    setting: Setting, share: Share, batch: int | None, threads: int | None, replace: Step | None
) -> None:
    """Makes no tokenizer and removes nothing: other processes rely on what is there."""
    from experiments.preparing.sources import find_sources, find_suite
    from experiments.preparing.store import make_store
    from experiments.preparing.tokenizer import adopt_tokenizer
    from experiments.preparing.windows import freeze_windows, require_same_windows

    study, workspace = setting.study, setting.workspace
    if share.told_by:
        console.print(f"process {share.process} of {share.processes}, says {share.told_by}")
    tokenizer = setting.tokenizer or workspace.tokenizer
    advice = f"Make it before the work is shared: {setting.command('tokenizer train')}"
    require(tokenizer.is_dir(), f"{tokenizer}: no tokenizer. {advice}")
    require_same_windows(study, workspace, None)
    if setting.data:
        sources = find_sources(study, setting.data)
    else:
        advice = f"Make them before the work is shared: {setting.command('data suite')}; or give --data"
        sources = find_suite(study, workspace, advice)
    unfinished = make_store(
        study, workspace, sources, tokenizer=tokenizer, share=share, batch=batch, threads=threads, replace=replace
    )
    if unfinished:
        console.print(
            f"this share is done; {', '.join(unfinished)} will be complete when the others are. The last "
            "process to end completes the store; the same command makes up for one that was lost",
            soft_wrap=True,
        )
        return
    try:
        with workspace.claimed():
            if setting.tokenizer is not None:
                adopt_tokenizer(setting.tokenizer, study, workspace)
            freeze_windows(study, workspace)
    except Busy:
        console.print("this share is done, and so is the store; another process is freezing the windows")
        return
    _finish(setting)


def _finish(setting: Setting) -> None:
    workspace = setting.workspace
    show_store(workspace)
    wrote(workspace.store, workspace.manifest, then=setting.command("train"))


def show_store(workspace: Workspace) -> None:
    """What the token store holds, per dataset."""
    import numpy as np

    from data_pipelines.tokens.store import TokenStore

    store = TokenStore(workspace.store)
    lengths = ("shortest", "median", "longest")
    title = "The token store: episodes, native frames, lengths of training episodes"
    table = tidy_table(title, "dataset", "train", "held out", "lost", "frames", *lengths, "Hz", "stride")
    for name in store.names:
        manifest = store.manifest(name)
        steps = manifest.train.steps
        table.add_row(
            name,
            f"{len(steps)}",
            f"{len(manifest.val.steps)}",
            f"{manifest.lost}",
            f"{manifest.train.native_frames + manifest.val.native_frames}",
            f"{min(steps)}",
            f"{np.median(steps):g}",
            f"{max(steps)}",
            f"{manifest.spec.hz:g}",
            f"{manifest.spec.stride}",
        )
    console.print(table)
    for name in store.names:
        for loss in store.manifest(name).skipped:
            console.print(f"[yellow]lost[/] {name}: {escape(loss.reason)}", soft_wrap=True)
