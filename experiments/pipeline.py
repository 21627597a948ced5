"""From datasets to everything a trial needs: suite, tokenizer, token store, frozen windows.

Each step is skipped when its output is there and was made from the same inputs; a step that
was cut short is made again. What was prepared is named by the hashes of `Provenance`.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.markup import escape

from experiments.progress import console, step
from experiments.study import Study
from experiments.trial import Provenance, source_hash, write_atomically
from experiments.workspace import Workspace
from hma_jax.config import require, stable_hash, to_dict

if TYPE_CHECKING:
    from data_pipelines.registry import DatasetSpec
    from data_pipelines.store import TokenStore

STAMP = "made_from.txt"
"""Holds the hash of a directory's inputs."""

Source = tuple["DatasetSpec", Path]
"""A dataset: how it is read, and its RLDS directory."""


def prepare(study: Study, workspace: Workspace, data: Sequence[str] = ()) -> Provenance:
    """Makes what is missing and returns what trials depend on.

    `data` are RLDS directories of the user, in the study's order; () simulates the suite.
    Raises ConfigError or DataError.
    """
    sources = find_sources(study, data) if data else make_suite(study, workspace)
    make_tokenizer(study, workspace, sources)
    make_store(study, workspace, sources)
    return freeze_windows(study, workspace)


def name_datasets(data: Sequence[str]) -> tuple[str, ...]:
    """The names that RLDS directories give themselves. Raises DataError for one that is none."""
    from data_pipelines.rlds import RldsDataset

    return tuple(RldsDataset(Path(directory)).name for directory in data)


def find_sources(study: Study, data: Sequence[str]) -> list[Source]:
    """User directories with their registry entries. Raises ConfigError for unknown names."""
    from data_pipelines.registry import get_spec

    named = dict(zip(name_datasets(data), map(Path, data), strict=True))
    missing = [n for n in study.dataset_names() if n not in named]
    require(not missing, f"no --data directory for {', '.join(missing)}; given: {', '.join(named)}")
    return [(get_spec(name), named[name]) for name in study.dataset_names()]


def make_suite(study: Study, workspace: Workspace) -> list[Source]:
    """The simulated datasets of the study, written once."""
    from data_pipelines.registry import get_spec
    from data_pipelines.suite import generate_suite

    names = study.dataset_names()
    with step(f"simulate {len(names)} datasets") as update:
        paths = generate_suite(
            workspace.suite,
            scale=study.suite.scale,
            seed=study.suite.seed,
            names=names,
            workers=_cores(),
            progress=lambda name, done, total: update(done, total, name),
        )
    return [(get_spec(name), path) for name, path in zip(names, paths, strict=True)]


def make_tokenizer(study: Study, workspace: Workspace, sources: Sequence[Source]) -> None:
    """A tokenizer trained on frames of all sources, skipped if nothing it depends on changed."""
    from data_pipelines.rlds import RldsDataset
    from hma_jax.tokenizers.train import train_tokenizer

    corrupt = study.store.corrupt
    made_from = stable_hash(
        {
            "config": to_dict(study.tokenizer),
            "training": to_dict(study.tokenizer_training),
            "store": to_dict(study.store),  # decides which episodes are held out
            "data": [RldsDataset(path, spec.split, corrupt=corrupt).fingerprint() for spec, path in sources],
            "code": source_hash(("hma_jax/tokenizers",)),
        }
    )
    stamp = workspace.tokenizer / STAMP
    if _reads(stamp, made_from):
        console.print("[green]done[/] train the tokenizer [dim](before)[/]")
        return
    aside = workspace.root / f"tokenizer.{made_from}"  # another configuration never resumes this one
    with step("train the tokenizer") as update:
        train_tokenizer(study, sources, aside, update)
    write_atomically(aside / STAMP, made_from)
    shutil.rmtree(workspace.tokenizer, ignore_errors=True)
    os.replace(aside, workspace.tokenizer)


def make_store(study: Study, workspace: Workspace, sources: Sequence[Source]) -> None:
    """Tokens of every source. Those made in the same way from the same shards are kept."""
    from data_pipelines.rlds import RldsDataset
    from data_pipelines.tokenize_job import tokenize_dataset
    from hma_jax.tokenizers.io import load_tokenizer

    tokenizer, settings = load_tokenizer(workspace.tokenizer), to_dict(study.store)
    workspace.store.mkdir(exist_ok=True)
    with step(f"tokenise {len(sources)} dataset(s)") as update:
        for i, (spec, path) in enumerate(sources):
            note = f"{spec.name} ({i + 1} of {len(sources)})"
            shards = RldsDataset(path, spec.split, corrupt=study.store.corrupt).fingerprint()
            made_from = stable_hash([tokenizer.identity, settings, to_dict(spec), shards])
            stamp = workspace.store / f"{spec.name}.{STAMP}"
            if not _reads(stamp, made_from):  # tokens of other data or another tokenizer are of no use
                shutil.rmtree(workspace.store / spec.name, ignore_errors=True)
                write_atomically(stamp, made_from)
            tokenize_dataset(
                spec, path, tokenizer, workspace.store, **settings,
                progress=lambda done, total, note=note: update(done, total, note),
            )  # fmt: skip


def freeze_windows(study: Study, workspace: Workspace) -> Provenance:
    """The validation windows that all trials share, and a summary of the data."""
    from data_pipelines.evalset import freeze_manifest
    from data_pipelines.store import TokenStore

    store = TokenStore(workspace.store)
    names, frames = study.dataset_names(), study.model.frames
    manifest = freeze_manifest(store, names, frames, study.eval.windows_per_dataset, study.eval.seed)
    manifest.save(workspace.manifest)
    judged = names[: study.dataset_counts[0]]
    require(
        bool(set(judged) & set(manifest.names)),
        f"none of {', '.join(judged)}, by which the datasets axis is judged, has a held-out window of "
        f"{frames} frames; choose fewer with --set model.frames=... or put other datasets first",
    )
    summary = summarise(store, names, frames)
    write_atomically(workspace.data_summary, json.dumps(summary, indent=1))
    for name, facts in summary.items():
        _remark(name, facts, manifest.empty.get(name, ""), frames)
    (identity,) = {store.manifest(name).tokenizer.identity for name in names}
    return Provenance(store.hash(names), manifest.hash(), identity, source_hash())


def summarise(store: TokenStore, names: Sequence[str], frames: int) -> dict[str, dict[str, int]]:
    """Per dataset: training episodes, those too short for a window, windows, episodes skipped."""
    from data_pipelines.windows import train_windows

    summary = {}
    for name in names:
        manifest, windows = store.manifest(name), train_windows(store, name, frames)
        summary[name] = {
            "episodes": len(manifest.train.episodes),
            "too_short": windows.too_short,
            "windows": len(windows),
            "skipped": sum(manifest.skipped.values()),
        }
    return summary


def _remark(name: str, facts: dict[str, int], no_evaluation: str, frames: int) -> None:
    """Says what of a dataset is not used."""
    remarks = []
    if facts["too_short"]:
        remarks.append(
            f"{facts['too_short']} of {facts['episodes']} training episodes are too short for {frames} frames"
        )
    if facts["skipped"]:
        remarks.append(f"{facts['skipped']} damaged episodes are left out")
    if no_evaluation:
        remarks.append(f"it is not evaluated: {no_evaluation}")
    if remarks:
        console.print(f"[yellow]note[/] {name}: {escape('; '.join(remarks))}", soft_wrap=True)


def _reads(path: Path, text: str) -> bool:
    return path.exists() and path.read_text() == text


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
