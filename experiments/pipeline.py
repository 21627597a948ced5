"""From datasets to everything a trial needs: suite, tokenizer, token store, frozen windows.

Each step is skipped when its output is there and was made from the same inputs; a step that
was cut short is made again. What was prepared is named by the hashes of `Provenance`.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.markup import escape

from experiments.atomic import write_atomically
from experiments.progress import Pace, console, step
from experiments.provenance import Provenance, source_hash
from experiments.study import StoreConfig, Study
from experiments.trial import CHECKPOINTS
from experiments.workspace import Workspace
from hma_jax.config import TokenizerConfig, require
from hma_jax.config.json import stable_hash, to_dict

if TYPE_CHECKING:
    from data_pipelines.registry import DatasetSpec
    from data_pipelines.rlds.dataset import RldsDataset
    from data_pipelines.rlds.location import Location
    from data_pipelines.tokens.share import Share
    from data_pipelines.tokens.store import TokenStore
    from hma_jax.tokenizers.base import Tokenizer

STAMP = "made_from.txt"
"""Holds the hash of a directory's inputs."""

QUALITY = "quality.json"
QUALITY_FRAMES = 1024
"""Held-out frames by which a tokenizer is judged; drawn at random from all datasets."""

Source = tuple["DatasetSpec", "Location"]
"""A dataset: how it is read, and its RLDS directory."""


def prepare(
    study: Study,
    workspace: Workspace,
    data: Sequence[str] = (),
    tokenizer: Path | None = None,
    *,
    batch: int | None = None,
    threads: int | None = None,
) -> Provenance:
    """Makes what is missing and returns what trials depend on.

    `data` are RLDS directories of the user, in the study's order; () simulates the suite. Instead
    of training one, a trained `tokenizer` is taken from its directory. `batch` and `threads` as
    in `make_store`.
    Raises ConfigError or DataError.
    """
    sources = find_sources(study, data) if data else make_suite(study, workspace)
    if tokenizer is None:
        make_tokenizer(study, workspace, sources)
    else:
        adopt_tokenizer(tokenizer, study, workspace)
    make_store(study, workspace, sources, batch=batch, threads=threads)
    return freeze_windows(study, workspace)


def name_datasets(data: Sequence[str]) -> tuple[str, ...]:
    """The names that RLDS directories give themselves. Raises DataError for one that is none."""
    from data_pipelines.rlds.schema import dataset_name

    return tuple(map(dataset_name, data))


def find_sources(study: Study, data: Sequence[str]) -> list[Source]:
    """User directories with their registry entries. Raises ConfigError for unknown names."""
    from data_pipelines.registry import get_spec
    from data_pipelines.rlds.location import locate

    named = dict(zip(name_datasets(data), map(locate, data), strict=True))
    missing = [n for n in study.dataset_names() if n not in named]
    require(not missing, f"no --data directory for {', '.join(missing)}; given: {', '.join(named)}")
    return [(get_spec(name), named[name]) for name in study.dataset_names()]


def require_simulated(names: Sequence[str]) -> None:
    """Raises ConfigError unless every dataset is one of the suite, which needs no --data."""
    from data_pipelines.suite.embodiments import EMBODIMENTS

    simulated = {e.name for e in EMBODIMENTS}
    real = [name for name in names if name not in simulated]
    require(
        not real,
        f"{', '.join(real[:3])}{' and others' if len(real) > 3 else ''}: not simulated. Give RLDS directories "
        "with --data, or add --dry-run to see the plan",
    )


def make_suite(study: Study, workspace: Workspace) -> list[Source]:
    """The simulated datasets of the study, written once."""
    from data_pipelines.registry import get_spec
    from data_pipelines.suite import generate_suite

    names = study.dataset_names()
    specs = [get_spec(name) for name in names]  # a mistyped name is refused before any work
    require_simulated(names)
    with step(f"simulate {len(names)} datasets") as update:
        paths = generate_suite(
            workspace.suite,
            scale=study.suite.scale,
            seed=study.suite.seed,
            names=names,
            workers=_cores(),
            progress=lambda name, done, total: update(done, total, name),
        )
    return list(zip(specs, paths, strict=True))


def open_source(source: Source, settings: StoreConfig) -> RldsDataset:
    """Indexes a dataset's shards. Raises DataError for damage that `settings` do not allow."""
    from data_pipelines.rlds.dataset import RldsDataset

    spec, path = source
    return RldsDataset(path, spec.split, corrupt=settings.corrupt, max_skipped=settings.max_skipped)


def make_tokenizer(study: Study, workspace: Workspace, sources: Sequence[Source]) -> None:
    """A tokenizer trained on frames of all sources, skipped if nothing it depends on changed.

    Beside it lies quality.json: its reconstruction PSNR on held-out frames.
    """
    from data_pipelines.loading.frames import make_frame_loader
    from hma_jax.tokenizers.train import train_tokenizer
    from hma_jax.training.loop import LoopOptions

    config, train, settings = study.tokenizer, study.tokenizer_train, study.store
    require(
        isinstance(config, TokenizerConfig),
        "the study's tokenizer is not one that is trained here; give its directory with --tokenizer",
    )
    inputs = {
        "config": to_dict(config),
        "train": to_dict(train),
        "held_out": [settings.val_fraction, settings.min_val, settings.max_val],
        "data": [open_source(source, settings).fingerprint() for source in sources],
        "code": source_hash(("hma_jax/tokenizers",)),
    }
    made_from = stable_hash(inputs)
    stamp = workspace.tokenizer / STAMP
    if _reads(stamp, made_from):
        console.print("[green]done[/] train the tokenizer [dim](before)[/]")
        return

    def frames(start: int, split: str = "train") -> Iterator[np.ndarray]:
        return make_frame_loader(
            sources, config.image_size, train.batch, train.seed, start_step=start, tau=study.tau, split=split,
            val_fraction=settings.val_fraction, min_val=settings.min_val, max_val=settings.max_val,
            corrupt=settings.corrupt, max_skipped=settings.max_skipped,
        )  # fmt: skip

    aside = workspace.root / f"tokenizer.{made_from}"  # never resumed with other inputs
    with step("train the tokenizer") as update:
        tokenizer = train_tokenizer(
            config, train, frames, aside, provenance=inputs,
            options=LoopOptions(checkpoint_every=max(train.steps // CHECKPOINTS, 1)),
            progress=lambda done, total, metrics: update(done, total, f"PSNR {metrics['psnr']:.1f} dB"),
        )  # fmt: skip
        quality = reconstruction_psnr(tokenizer, frames(0, "val"))
    console.print(f"its reconstruction of held-out frames: {quality['mean']:.2f} ± {quality['sem']:.2f} dB PSNR")
    write_atomically(aside / QUALITY, json.dumps(quality))
    write_atomically(aside / STAMP, made_from)
    shutil.rmtree(workspace.tokenizer, ignore_errors=True)
    os.replace(aside, workspace.tokenizer)


def adopt_tokenizer(source: Path, study: Study, workspace: Workspace) -> None:
    """A copy of a tokenizer that was trained elsewhere. Raises ConfigError if it is not the kind
    that the study is made for."""
    from hma_jax.tokenizers.io import load_tokenizer, save_tokenizer

    tokenizer = load_tokenizer(source, expect=study.tokenizer)
    made_from = f"adopted {tokenizer.identity}"
    if _reads(workspace.tokenizer / STAMP, made_from):
        return
    aside = workspace.root / "tokenizer.adopted"
    shutil.rmtree(aside, ignore_errors=True)
    save_tokenizer(tokenizer, aside)
    write_atomically(aside / STAMP, made_from)
    shutil.rmtree(workspace.tokenizer, ignore_errors=True)
    os.replace(aside, workspace.tokenizer)


def reconstruction_psnr(tokenizer: Tokenizer, batches: Iterator[np.ndarray]) -> dict[str, float]:
    """PSNR in dB of encoding and decoding, over at least QUALITY_FRAMES frames: mean, sem, n."""
    from hma_jax.evaluation.metrics import mean_and_sem, psnr

    values: list[float] = []
    while len(values) < QUALITY_FRAMES:
        images = next(batches)
        values += np.asarray(psnr(tokenizer.decode(tokenizer.encode(images)), images)).tolist()
    return dataclasses.asdict(mean_and_sem(values))


def find_suite(study: Study, workspace: Workspace) -> list[Source]:
    """The simulated datasets, which must be there. Raises ConfigError otherwise."""
    from data_pipelines.registry import get_spec

    sources = [(get_spec(name), workspace.suite / name) for name in study.dataset_names()]
    missing = [spec.name for spec, path in sources if not path.is_dir()]
    require(
        not missing,
        f"{workspace.suite}: {', '.join(missing)} not simulated yet. Run `hma data suite` and `hma tokenizer "
        "train` once with the same --preset and --out, then share the tokenising; or give --data",
    )
    return sources


def make_store(
    study: Study,
    workspace: Workspace,
    sources: Sequence[Source],
    *,
    tokenizer: Path | None = None,
    share: Share | None = None,
    batch: int | None = None,
    threads: int | None = None,
) -> list[str]:
    """Tokens of every source, or of a `share` of their parts; those made in the same way are kept.

    Other tokens in their place are removed, unless several processes are at work. Returns the
    datasets that still lack parts of other processes. `tokenizer`: a directory, if it is not
    the workspace's. `batch` and `threads` as in `tokenize_dataset`.
    """
    from data_pipelines.tokens.share import Share
    from data_pipelines.tokens.tokenize_job import tokenize_dataset
    from hma_jax.tokenizers.io import load_tokenizer

    made_with = load_tokenizer(tokenizer or workspace.tokenizer)
    settings, share = to_dict(study.store), share or Share()
    how = {k: v for k, v in (("batch", batch), ("threads", threads)) if v is not None}
    workspace.store.mkdir(parents=True, exist_ok=True)
    unfinished = []
    mine = f", share {share.process + 1} of {share.processes}" if share.processes > 1 else ""
    with step(f"tokenise {len(sources)} dataset(s){mine}") as update:
        for i, (spec, path) in enumerate(sources):
            pace, note = Pace(), f"{spec.name} ({i + 1} of {len(sources)})"
            manifest = tokenize_dataset(
                spec, path, made_with, workspace.store, **settings, **how,
                share=share, overwrite=share.processes == 1,
                progress=lambda done, total, note=note, pace=pace: update(
                    done, total, f"{note}{pace(done, total)}"
                ),
            )  # fmt: skip
            if manifest is None:
                unfinished.append(spec.name)
    return unfinished


def freeze_windows(study: Study, workspace: Workspace) -> Provenance:
    """The validation windows that all trials share, and a summary of the data."""
    from data_pipelines.loading.evalset import freeze_manifest
    from data_pipelines.tokens.store import TokenStore

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
    from data_pipelines.loading.windows import train_windows

    summary = {}
    for name in names:
        manifest, windows = store.manifest(name), train_windows(store, name, frames)
        summary[name] = {
            "episodes": len(manifest.train.episodes),
            "too_short": windows.too_short,
            "windows": len(windows),
            "skipped": manifest.lost,
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
