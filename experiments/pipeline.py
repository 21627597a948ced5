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
from typing import TYPE_CHECKING, Any

from experiments.progress import console, step
from experiments.study import Study
from experiments.trial import Provenance, source_hash, write_atomically
from experiments.workspace import Workspace
from hma_jax.config import require, stable_hash, to_dict

if TYPE_CHECKING:
    from data_pipelines.registry import DatasetSpec

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

    made_from = stable_hash(
        {
            "config": to_dict(study.tokenizer),
            "training": to_dict(study.tokenizer_training),
            "store": to_dict(study.store),  # decides which episodes are held out
            "data": [RldsDataset(path, spec.split).fingerprint() for spec, path in sources],
            "code": source_hash(("hma_jax/tokenizers",)),
        }
    )
    stamp = workspace.tokenizer / "made_from.txt"
    if stamp.exists() and stamp.read_text() == made_from:
        console.print("[green]done[/] train the tokenizer [dim](before)[/]")
        return
    stamp.unlink(missing_ok=True)
    aside = workspace.root / f"tokenizer.{made_from}"  # another configuration never resumes this one
    with step("train the tokenizer") as update:
        train_tokenizer(study, sources, aside, update)
    shutil.rmtree(workspace.tokenizer, ignore_errors=True)
    os.replace(aside, workspace.tokenizer)
    write_atomically(stamp, made_from)


def make_store(study: Study, workspace: Workspace, sources: Sequence[Source]) -> None:
    """Tokens of every source; a dataset already tokenised from the same input is kept."""
    from data_pipelines.tokenize_job import tokenize_dataset
    from hma_jax.tokenizers.io import load_tokenizer

    tokenizer = load_tokenizer(workspace.tokenizer)
    options = to_dict(study.store)
    with step(f"tokenise {len(sources)} dataset(s)") as update:
        for done, (spec, path) in enumerate(sources):
            update(done, len(sources), spec.name)
            tokenize_dataset(spec, path, tokenizer, workspace.store, **options)


def freeze_windows(study: Study, workspace: Workspace) -> Provenance:
    """The validation windows that all trials share, and a summary of the data."""
    from data_pipelines.evalset import freeze_manifest
    from data_pipelines.store import TokenStore

    store = TokenStore(workspace.store)
    names, frames = study.dataset_names(), study.model.frames
    manifest = freeze_manifest(store, names, frames, study.eval.windows_per_dataset, study.eval.seed)
    manifest.save(workspace.manifest)
    summary = summarise(store, names, frames)
    write_atomically(workspace.data_summary, json.dumps(summary, indent=1))
    for name, facts in summary.items():
        if facts["too_short"]:
            console.print(
                f"[yellow]note[/] {name}: {facts['too_short']} of {facts['episodes']} episodes are shorter than "
                f"a window of {frames} frames and are left out"
            )
    identity = {store.manifest(name).tokenizer for name in names}
    require(len(identity) == 1, f"the token store {workspace.store} mixes tokenizers; delete it")
    return Provenance(store.hash(), manifest.hash, identity.pop(), source_hash())


def summarise(store: Any, names: Sequence[str], frames: int) -> dict[str, dict[str, int]]:
    """Training episodes, those too short for a window, and windows, per dataset."""
    from data_pipelines.windows import train_windows

    summary = {}
    for name in names:
        windows = train_windows(store, name, frames)
        summary[name] = {
            "episodes": len(store.manifest(name).train_frames),
            "too_short": windows.too_short,
            "windows": len(windows.start),
        }
    return summary


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
