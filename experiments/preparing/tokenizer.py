"""The tokenizer of a study, trained on its datasets; `given_tokenizer` handles tokenizers that are not."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from data_pipelines.publishing.files import publish
from data_pipelines.registry import DatasetSpec, get_spec
from data_pipelines.sampling.order import ORDER_VERSION
from experiments.preparing.made_from import (
    ORIGIN,
    MadeFrom,
    Step,
    differences,
    read_stamp,
    require_same,
    say_recorded,
)
from experiments.preparing.sources import Source, Unopened, open_source
from experiments.running.closure import closure_hash, trace
from experiments.running.machine import describe_machine
from experiments.running.run_options import CHECKPOINTS
from experiments.running.workspace import Workspace
from experiments.study import Study
from experiments.terminal.progress import console, step
from experiments.terminal.words import plus_minus
from hma_jax.config import AnyTokenizerConfig, TokenizerConfig, require
from hma_jax.config.json import identity_of
from hma_jax.runtime.files import write_file

if TYPE_CHECKING:
    from data_pipelines.loading.frames import FrameLoader
    from data_pipelines.sources.joined import Parts
    from data_pipelines.sources.rlds.location import Location
    from hma_jax.evaluation.statistics import Stat
    from hma_jax.tokenizers.base import Tokenizer

QUALITY = "quality.json"
QUALITY_FRAMES = 1024
"""Number of held-out frames by which a tokenizer is judged; drawn at random from all datasets."""

OF_FRAMES = ("split", "val_split")
"""Facts of a registry entry, besides its camera, that say which frames a dataset has for a tokenizer."""

SOURCES = ("hma_jax.tokenizers.train", "data_pipelines.loading.frames", "data_pipelines.sources.open")
"""The modules that train it, with everything that they import (`running.closure`). For these three, imports inside
functions count too: readers are imported when a dataset needs them."""

TRAINED = "trained here"
"""The origin of a tokenizer that was not given."""


def tokenizer_made_from(study: Study, workspace: Workspace, sources: Sequence[Source]) -> MadeFrom:
    """What the tokenizer of a study is trained from, under the names that --set uses.

    Steps, batch and objective of the model are not part of it; the mixture's temperature is, and what the registry says
    about where a dataset's frames are.
    """
    inputs = {
        ORIGIN: TRAINED,
        **training_settings(study),
        **frames_made_from(study, sources, read_stamp(workspace.tokenizer)),
    }
    recorded = {"code": closure_hash(trace(SOURCES))}
    return MadeFrom(inputs, recorded, describe_machine())


def training_settings(study: Study) -> dict[str, Any]:
    """The inputs of a tokenizer's training that are settings of a study, as a stamp has them."""
    return {name: identity_of(getattr(study, name)) for name in ("tokenizer", "tokenizer_train")}


def frames_made_from(
    study: Study, sources: Sequence[Source] | Sequence[Unopened], existing: MadeFrom | None
) -> dict[str, Any]:
    """Inputs of a stamp that say which frames a tokenizer is trained on and judged by. Recordings that are not opened
    are assumed to be those of the `existing` stamp."""
    settings, known = study.store, existing.inputs.get("data", {}) if existing else {}

    def shards(spec: DatasetSpec, path: Location | Parts | None) -> str:
        if path is None:
            return known.get(spec.name, {}).get("shards", "")
        return open_source((spec, path), settings).fingerprint()

    data = {
        spec.name: {
            "shards": shards(spec, path),
            "image_key": spec.camera_key,
            **{name: getattr(spec, name) for name in OF_FRAMES},
        }
        for spec, path in sources
    }
    return {
        "store": identity_of(settings.held_out),
        "tau": study.tau,
        "order": ORDER_VERSION,
        "datasets": list(data),
        "data": data,
    }


def make_tokenizer(
    study: Study,
    workspace: Workspace,
    sources: Sequence[Source],
    replace: Step | None = None,
    *,
    threads: int | None = None,
) -> None:
    """Trains a tokenizer on frames of all sources; nothing is done if it exists.

    Beside it lies quality.json: its reconstruction PSNR on held-out frames. `threads` as in `make_frame_loader`. Raises
    ConfigError if one is there that was made from other inputs, unless `replace` allows it.
    """
    from hma_jax.tokenizers.train import train_tokenizer
    from hma_jax.training.loop import LoopOptions

    config, train = study.tokenizer, study.tokenizer_train
    require_trainable_tokenizer(config)
    sources = seen(study, sources)
    made_from = tokenizer_made_from(study, workspace, sources)
    if _in_place(workspace.tokenizer, made_from, replace):
        return
    frames = partial(make_frames, study, sources, config.image_size, threads=threads)
    held_out = frames(split="val")  # raises before hours of training if there are none
    aside = workspace.root / f"tokenizer.{made_from.id}"  # never resumed with other inputs
    with step("train the tokenizer") as update:
        tokenizer = train_tokenizer(
            config, train, frames, aside, provenance=made_from.identity(),
            options=LoopOptions(checkpoint_every=train.steps // CHECKPOINTS),
            progress=lambda done, total, metrics: update(done, total, f"PSNR {metrics['psnr']:.1f} dB"),
            records=lambda index: frames().describe(index),
        )  # fmt: skip
        quality = reconstruction_psnr(tokenizer, held_out)
    save_quality(quality, aside)
    made_from.save(aside)
    publish(aside, workspace.tokenizer)


def make_frames(
    study: Study,
    sources: Sequence[Source],
    size: int,
    start: int = 0,
    *,
    split: Literal["train", "val"] = "train",
    threads: int | None = None,
) -> FrameLoader:
    """Batches of frames of `size` x `size` pixels for the tokenizer of a study, from batch `start` on."""
    from data_pipelines.loading.frames import make_frame_loader

    train, settings = study.tokenizer_train, study.store
    return make_frame_loader(
        sources, size, train.batch, train.seed, start_step=start, tau=study.tau, split=split,
        held_out=settings.held_out, corrupt=settings.corrupt, max_skipped=settings.max_skipped, threads=threads,
    )  # fmt: skip


def save_quality(quality: Stat, directory: Path) -> None:
    """Prints the PSNR of a tokenizer's reconstruction, and writes it beside the tokenizer."""
    console.print(f"its reconstruction of held-out frames: {plus_minus(quality.mean, quality.sem)} dB PSNR")
    write_file(directory / QUALITY, json.dumps(dataclasses.asdict(quality)))


def require_same_trained(study: Study, workspace: Workspace, sources: Sequence[Source]) -> None:
    """Raises ConfigError if the workspace's tokenizer is not the one that the study would train."""
    _in_place(workspace.tokenizer, tokenizer_made_from(study, workspace, seen(study, sources)), None)


def require_trainable_tokenizer(config: AnyTokenizerConfig) -> None:
    """Raises ConfigError for a kind of tokenizer that can only be imported or given."""
    require(
        isinstance(config, TokenizerConfig),
        "the study's tokenizer cannot be trained here: make one of published weights with `hma tokenizer import`, and give "
        "its directory with --tokenizer",
    )


def trained_changes(study: Study, workspace: Workspace) -> list[str]:
    """How the workspace's tokenizer was made differently from the one that the study would train, as far as is known
    before a dataset is opened; [] if there is none."""
    place, existing = workspace.tokenizer, read_stamp(workspace.tokenizer)
    if not place.exists():
        return []
    unopened: list[Unopened] = [(get_spec(name), None) for name in study.all_names() if name not in study.unseen]
    inputs = {ORIGIN: TRAINED, **training_settings(study), **frames_made_from(study, unopened, existing)}
    return _made_otherwise(place, existing, inputs)


def seen(study: Study, sources: Sequence[Source]) -> list[Source]:
    """The sources that a tokenizer is trained on and judged by: all except those of unseen robots."""
    return [(spec, path) for spec, path in sources if spec.name not in study.unseen]


def _in_place(place: Path, made_from: MadeFrom, replace: Step | None) -> bool:
    """Whether the tokenizer that is to be trained exists. Raises ConfigError if another one is in its place, unless
    `replace` allows it."""
    if not place.exists():
        return False
    existing = read_stamp(place)
    lines = _made_otherwise(place, existing, made_from.inputs)
    require_same("tokenizer", place, lines, replace, unchanged(place))
    if existing is None or lines:
        return False
    say_recorded("the tokenizer", place, existing.recorded, made_from.recorded)
    console.print("[green]done[/] train the tokenizer [dim](before)[/]")
    return True


def _made_otherwise(place: Path, existing: MadeFrom | None, inputs: Mapping[str, Any]) -> list[str]:
    if existing is None:
        return ["it is not recorded there"]
    return differences(existing.inputs, inputs)


def unchanged(place: Path) -> str:
    """How to continue with a tokenizer that was made from other inputs."""
    return f"use it unchanged with --tokenizer {place}"


def reconstruction_psnr(
    tokenizer: Tokenizer, frames: FrameLoader, progress: Callable[[int, int], None] | None = None
) -> Stat:
    """PSNR in dB of encoding and decoding, over at least QUALITY_FRAMES frames from the first batch of `frames` on.

    Every frame counts equally; the standard error is over episodes, within each dataset. `progress` is called with the
    number of frames that are done and the number of all frames.
    """
    from hma_jax.evaluation.metrics import psnr
    from hma_jax.evaluation.statistics import mean_and_sem, stratified

    values, datasets, episodes = [], [], []
    for number in itertools.count():
        images = next(frames)
        values.append(np.asarray(psnr(tokenizer.reconstruct(images), images)))
        for column, own in zip((datasets, episodes), frames.episodes(number), strict=True):
            column.append(own)
        done = sum(map(len, values))
        if progress is not None:
            progress(done, QUALITY_FRAMES)
        if done >= QUALITY_FRAMES:
            break
    value, dataset, episode = (np.concatenate(parts) for parts in (values, datasets, episodes))
    stats = [mean_and_sem(value[dataset == d], episode[dataset == d]) for d in np.unique(dataset)]
    return stratified(stats, [s.n for s in stats])
