"""The tokenizer of a study: trained on its datasets, or one that is given."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import shutil
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
from experiments.progress import console, say, step
from experiments.running.closure import closure_hash, trace
from experiments.running.machine import describe_machine
from experiments.running.run_options import CHECKPOINTS
from experiments.running.workspace import Workspace
from experiments.study import Study
from experiments.words import few, plus_minus
from hma_jax.config import ConfigError, TokenizerConfig, require
from hma_jax.config.json import to_dict
from hma_jax.runtime.files import write_file

if TYPE_CHECKING:
    from data_pipelines.loading.frames import FrameLoader
    from hma_jax.evaluation.statistics import Stat
    from hma_jax.tokenizers.base import Tokenizer

QUALITY = "quality.json"
QUALITY_FRAMES = 1024
"""Held-out frames by which a tokenizer is judged; drawn at random from all datasets."""

HELD_OUT = ("val_fraction", "min_val", "max_val", "max_val_fraction")
"""Settings of the store that say which episodes no tokenizer is trained on."""

OF_FRAMES = ("split", "val_split")
"""Facts of a registry entry that say which frames a dataset has for a tokenizer, beside its camera."""

SOURCES = ("hma_jax.tokenizers.train", "data_pipelines.loading.frames", "data_pipelines.sources.open")
"""The modules that train it; what they import follows (`running.closure`), of these three in functions as well: readers
are imported when a dataset needs them."""

TRAINED, GIVEN = "trained here", "given with --tokenizer, identity"

FRAMES, ENCODED, SHRUNK = "frames", "those that are encoded", "JPEG images of RLDS shrunk while they were decoded"
"""Recorded: on which frames a tokenizer was trained and judged. Earlier versions, which record none, took smaller ones
where a decoder could make them, by another filter than that of the frames that are encoded."""


def tokenizer_made_from(study: Study, sources: Sequence[Source]) -> MadeFrom:
    """What the tokenizer of a study is trained from, under the names that --set has for it.

    Steps, batch or objective of the model are no part of it; the mixture's temperature is, and what the registry says
    of where a dataset's frames are.
    """
    from data_pipelines.sampling.order import ORDER_VERSION

    settings = study.store
    data = {
        spec.name: {
            "shards": open_source((spec, path), settings).fingerprint(),
            "image_key": spec.camera_key,
            **{name: getattr(spec, name) for name in OF_FRAMES},
        }
        for spec, path in sources
    }
    inputs = {
        ORIGIN: TRAINED,
        "tokenizer": to_dict(study.tokenizer),
        "tokenizer_train": to_dict(study.tokenizer_train),
        "store": {name: getattr(settings, name) for name in HELD_OUT},
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
    made_from = tokenizer_made_from(study, sources)
    if _in_place(workspace.tokenizer, made_from, replace):
        return

    def frames(start: int, split: str = "train") -> FrameLoader:
        return make_frame_loader(
            sources, config.image_size, train.batch, train.seed, start_step=start, tau=study.tau, split=split,
            **{name: getattr(settings, name) for name in HELD_OUT},
            corrupt=settings.corrupt, max_skipped=settings.max_skipped, threads=threads,
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


def require_same_tokenizer(source: Path | None, study: Study, workspace: Workspace, sources: Sequence[Source]) -> None:
    """Raises ConfigError if the workspace has another tokenizer than the one that is given by its directory `source`
    or, without, than the study would train."""
    from hma_jax.tokenizers.io import load_tokenizer

    if source is None:
        _in_place(workspace.tokenizer, tokenizer_made_from(study, _seen(study, sources)), None)
    else:
        _adopted(load_tokenizer(source, expect=study.tokenizer), source, workspace, None)


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


def adopt_tokenizer(
    source: Path, study: Study, workspace: Workspace, sources: Sequence[Source], replace: Step | None = None
) -> None:
    """A copy of a tokenizer that was trained elsewhere; nothing is done if the same one is there already. A note says
    of which `sources` it may know held-out frames.

    Raises ConfigError if it is not the kind that the study is made for, or if another one is there, unless
    `replace` allows it.
    """
    from hma_jax.tokenizers.io import load_tokenizer, save_tokenizer

    tokenizer = load_tokenizer(source, expect=study.tokenizer)
    if _adopted(tokenizer, source, workspace, replace):
        return
    _say_held_out_elsewhere(read_stamp(source), study, sources)
    aside = workspace.root / "tokenizer.adopted"
    shutil.rmtree(aside, ignore_errors=True)
    save_tokenizer(tokenizer, aside)
    _given(tokenizer).save(aside)
    publish(aside, workspace.tokenizer)


def _adopted(tokenizer: Tokenizer, source: Path, workspace: Workspace, replace: Step | None) -> bool:
    """Whether the tokenizer that is given, by its directory `source`, is there. ConfigError if another one is, unless
    allowed."""
    from hma_jax.tokenizers.io import load_tokenizer

    place = workspace.tokenizer
    if not place.exists():
        return False
    existing = read_stamp(place)
    if existing == _given(tokenizer):
        return True
    try:
        identity = load_tokenizer(place).identity
    except ConfigError as error:
        lines = [str(error)]
    else:
        if identity == tokenizer.identity:  # trained here, or the very directory that is given
            return True
        origin = existing.inputs[ORIGIN] if existing else "not written down"
        lines = [f"tokenizer: {identity} ({origin}) -> {tokenizer.identity} ({source})"]
    require_same("tokenizer", place, lines, replace)
    return False


def _given(tokenizer: Tokenizer) -> MadeFrom:
    return MadeFrom({ORIGIN: f"{GIVEN} {tokenizer.identity}"})


def _say_held_out_elsewhere(trained_from: MadeFrom | None, study: Study, sources: Sequence[Source]) -> None:
    """Of a tokenizer that was trained on datasets of the study with fewer episodes held out (those are among these), or
    as they were before they grew: the hold-out is drawn among all episodes of a dataset."""
    inputs = trained_from.inputs if trained_from is not None else {}
    trained_with, study_settings = inputs.get("store", {}), to_dict(study.store)
    more = [
        f"store.{name}: {trained_with[name]} -> {study_settings[name]}"
        for name in HELD_OUT
        if study_settings[name] > trained_with.get(name, math.inf)
    ]
    names = [name for name in study.all_names() if name in inputs.get("data", {})]
    if names and more:
        say(
            f"note: the tokenizer was trained on {few(names)} with fewer episodes held out ({'; '.join(more)}): it "
            "may have been trained on frames that are held out here"
        )
    shards = {name: facts["shards"] for name, facts in inputs.get("data", {}).items() if facts.get("shards")}
    changed = [
        spec.name
        for spec, path in sources
        if spec.name in shards and shards[spec.name] != open_source((spec, path), study.store).fingerprint()
    ]
    if changed:
        say(
            f"note: the tokenizer was trained on other recordings of {few(changed)}: unless they only `joins` more "
            "directories now, it may have been trained on frames that are held out here"
        )


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
