"""The tokenizer of a study, trained on its datasets; `given_tokenizer` has those that are not."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_pipelines.publishing.files import publish
from experiments.preparing.made_from import (
    OLD_STAMP,
    ORIGIN,
    MadeFrom,
    Step,
    differences,
    read_stamp,
    require_same,
    say_recorded,
)
from experiments.preparing.sources import Source, open_source
from experiments.running.closure import closure_hash, trace
from experiments.running.machine import describe_machine
from experiments.running.run_options import CHECKPOINTS
from experiments.running.workspace import Workspace
from experiments.study import Study
from experiments.terminal.progress import console, step
from experiments.terminal.words import plus_minus
from hma_jax.config import TokenizerConfig, require
from hma_jax.config.json import to_dict
from hma_jax.runtime.files import write_file

if TYPE_CHECKING:
    from data_pipelines.loading.frames import FrameLoader
    from hma_jax.evaluation.statistics import Stat
    from hma_jax.tokenizers.base import Tokenizer

QUALITY = "quality.json"
QUALITY_FRAMES = 1024
"""Held-out frames by which a tokenizer is judged; drawn at random from all datasets."""

OF_FRAMES = ("split", "val_split")
"""Facts of a registry entry that say which frames a dataset has for a tokenizer, beside its camera."""

SOURCES = ("hma_jax.tokenizers.train", "data_pipelines.loading.frames", "data_pipelines.sources.open")
"""The modules that train it; what they import follows (`running.closure`), of these three in functions as well: readers
are imported when a dataset needs them."""

TRAINED = "trained here"
"""The origin of a tokenizer that was not given."""

FRAMES, ENCODED, SHRUNK = "frames", "those that are encoded", "JPEG images of RLDS shrunk while they were decoded"
"""Recorded: on which frames a tokenizer was trained and judged. Earlier versions, which record none, took smaller ones
where a decoder could make them, by another filter than that of the frames that are encoded."""


def tokenizer_made_from(study: Study, workspace: Workspace, sources: Sequence[Source]) -> MadeFrom:
    """What the tokenizer of a study is trained from, under the names that --set has for it. Recordings are named as the
    tokenizer that is there names them, if by earlier versions.

    Steps, batch or objective of the model are no part of it; the mixture's temperature is, and what the registry says
    of where a dataset's frames are.
    """
    from data_pipelines.sampling.order import ORDER_VERSION

    settings, existing = study.store, read_stamp(workspace.tokenizer)
    known = existing.inputs.get("data", {}) if existing else {}
    data = {
        spec.name: {
            "shards": open_source((spec, path), settings).fingerprint_as(known.get(spec.name, {}).get("shards", "")),
            "image_key": spec.camera_key,
            **{name: getattr(spec, name) for name in OF_FRAMES},
        }
        for spec, path in sources
    }
    inputs = {
        ORIGIN: TRAINED,
        "tokenizer": to_dict(study.tokenizer),
        "tokenizer_train": to_dict(study.tokenizer_train),
        "store": to_dict(settings.held_out),
        "tau": study.tau,
        "order": ORDER_VERSION,
        "datasets": list(data),
        "data": data,
    }
    recorded = {"code": closure_hash(trace(SOURCES)), FRAMES: ENCODED}
    return MadeFrom(inputs, recorded, describe_machine())


def make_tokenizer(
    study: Study,
    workspace: Workspace,
    sources: Sequence[Source],
    replace: Step | None = None,
    *,
    threads: int | None = None,
) -> None:
    """A tokenizer trained on frames of all sources; nothing is done if it is there.

    Beside it lies quality.json: its reconstruction PSNR on held-out frames. `threads` as in `make_frame_loader`. Raises
    ConfigError if one is there that was made from other inputs, unless `replace` allows it.
    """
    from data_pipelines.loading.frames import make_frame_loader
    from hma_jax.tokenizers.train import train_tokenizer
    from hma_jax.training.loop import LoopOptions

    config, train, settings = study.tokenizer, study.tokenizer_train, study.store
    require(
        isinstance(config, TokenizerConfig),
        "the study's tokenizer cannot be trained here; give the directory of an imported one with --tokenizer",
    )
    sources = _seen(study, sources)
    made_from = tokenizer_made_from(study, workspace, sources)
    if _in_place(workspace.tokenizer, made_from, replace):
        return

    def frames(start: int, split: str = "train") -> FrameLoader:
        return make_frame_loader(
            sources, config.image_size, train.batch, train.seed, start_step=start, tau=study.tau, split=split,
            held_out=settings.held_out, corrupt=settings.corrupt, max_skipped=settings.max_skipped, threads=threads,
        )  # fmt: skip

    held_out = frames(0, "val")  # raises before hours of training if there are none
    aside = workspace.root / f"tokenizer.{made_from.id}"  # never resumed with other inputs
    with step("train the tokenizer") as update:
        tokenizer = train_tokenizer(
            config, train, frames, aside, provenance=made_from.identity(),
            options=LoopOptions(checkpoint_every=train.steps // CHECKPOINTS),
            progress=lambda done, total, metrics: update(done, total, f"PSNR {metrics['psnr']:.1f} dB"),
            records=lambda index: frames(0).describe(index),
        )  # fmt: skip
        quality = reconstruction_psnr(tokenizer, held_out)
    console.print(f"its reconstruction of held-out frames: {plus_minus(quality.mean, quality.sem)} dB PSNR")
    write_file(aside / QUALITY, json.dumps(dataclasses.asdict(quality)))
    made_from.save(aside)
    publish(aside, workspace.tokenizer)


def require_same_trained(study: Study, workspace: Workspace, sources: Sequence[Source]) -> None:
    """Raises ConfigError if the workspace has another tokenizer than the study would train."""
    _in_place(workspace.tokenizer, tokenizer_made_from(study, workspace, _seen(study, sources)), None)


def _seen(study: Study, sources: Sequence[Source]) -> list[Source]:
    return [(spec, path) for spec, path in sources if spec.name not in study.unseen]


def _in_place(place: Path, made_from: MadeFrom, replace: Step | None) -> bool:
    """Whether the tokenizer that is to be trained is there. ConfigError if another one is, unless allowed."""
    if not place.exists():
        return False
    existing = read_stamp(place)
    if existing is None:
        lines = ["it is not recorded there" + (", as of earlier versions" if (place / OLD_STAMP).exists() else "")]
    else:
        lines = differences(existing.inputs, made_from.inputs)
    require_same("tokenizer", place, lines, replace, f"use it unchanged with --tokenizer {place}")
    if lines:
        return False
    say_recorded("the tokenizer", place, {FRAMES: SHRUNK} | existing.recorded, made_from.recorded)
    console.print("[green]done[/] train the tokenizer [dim](before)[/]")
    return True


def reconstruction_psnr(tokenizer: Tokenizer, frames: FrameLoader) -> Stat:
    """PSNR in dB of encoding and decoding, over at least QUALITY_FRAMES frames from the first batch of `frames` on.

    Every frame counts equally; the error counts episodes, within each dataset.
    """
    from hma_jax.evaluation.metrics import psnr
    from hma_jax.evaluation.statistics import mean_and_sem, stratified

    values, datasets, episodes = [], [], []
    for number in itertools.count():
        images = next(frames)
        values.append(np.asarray(psnr(tokenizer.decode(tokenizer.encode(images)), images)))
        for column, own in zip((datasets, episodes), frames.episodes(number), strict=True):
            column.append(own)
        if sum(map(len, values)) >= QUALITY_FRAMES:
            break
    value, dataset, episode = (np.concatenate(parts) for parts in (values, datasets, episodes))
    stats = [mean_and_sem(value[dataset == d], episode[dataset == d]) for d in np.unique(dataset)]
    return stratified(stats, [s.n for s in stats])
