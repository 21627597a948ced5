"""A tokenizer that is given to a study: it is copied from where it was trained, or refused. Reports held-out data that
it may have been trained on, and how well it reconstructs the study's frames."""

from __future__ import annotations

import dataclasses
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from data_pipelines.publishing.files import publish
from data_pipelines.registry import DatasetSpec
from experiments.preparing.made_from import ORIGIN, MadeFrom, Step, differences, read_stamp, require_same
from experiments.preparing.sources import Source, open_source
from experiments.preparing.tokenizer import (
    OF_FRAMES,
    QUALITY,
    TRAINED,
    frames_made_from,
    make_frames,
    reconstruction_psnr,
    require_same_trained,
    save_quality,
    seen,
)
from experiments.running.workspace import Workspace
from experiments.study import Study
from experiments.terminal.progress import say, step
from experiments.terminal.words import few
from hma_jax.config import ConfigError, DiffusionConfig
from hma_jax.config.json import diff, to_dict

if TYPE_CHECKING:
    from hma_jax.tokenizers.base import Tokenizer

GIVEN = "given with --tokenizer, identity"
"""The origin of a copy, followed by what the tokenizer is."""

TRAINED_FROM = "trained_from"
"""In the stamp of a copy: the inputs of the training, if they are known. Only its identity distinguishes it from other
tokenizers."""

JUDGED = "judged_on.json"
"""File beside a tokenizer that was given: the frames by which it was judged, as the inputs of a stamp."""

USUAL_STD = (0.5, 2.0)
"""Standard deviations of latents that count as about 1; others are reported."""

USUAL_MEAN = 1.0
"""The largest absolute mean of latents that counts as about 0."""


def require_same_tokenizer(source: Path | None, study: Study, workspace: Workspace, sources: Sequence[Source]) -> None:
    """Raises ConfigError if the workspace's tokenizer is not the one in the given directory `source` or, without
    `source`, not the one that the study would train."""
    from hma_jax.tokenizers.io import load_tokenizer

    if source is None:
        require_same_trained(study, workspace, sources)
    else:
        _adopted(load_tokenizer(source, expect=study.tokenizer), source, workspace, None)


def adopt_tokenizer(
    source: Path, study: Study, workspace: Workspace, sources: Sequence[Source], replace: Step | None = None
) -> None:
    """Copies a tokenizer that was trained elsewhere; nothing is done if the same one is there already. Notes say which
    `sources` have held-out frames that it may have been trained on, or that this is not known, and which unseen robots
    it was trained on. The stamp of the copy records what was known about the training.

    Raises ConfigError if it is not the kind that the study is made for, or if another one is there, unless
    `replace` allows it.
    """
    from hma_jax.tokenizers.io import load_tokenizer, save_tokenizer
    from hma_jax.tokenizers.pixels import PixelTokenizer

    tokenizer = load_tokenizer(source, expect=study.tokenizer)
    if _adopted(tokenizer, source, workspace, replace):
        return
    training = _training(read_stamp(source))
    if "data" in training.inputs:
        _say_what_it_may_know(training, study, sources)
    elif tokenizer.kind != PixelTokenizer.kind:
        say(
            "note: it is not written down on which frames the tokenizer was trained. If on datasets of this study, it may "
            "know frames that are held out here, and its PSNR of them, like that of models of its tokens, is too high"
        )
    aside = workspace.root / "tokenizer.adopted"
    shutil.rmtree(aside, ignore_errors=True)
    save_tokenizer(tokenizer, aside)
    known = {TRAINED_FROM: training.inputs} if training.inputs else {}
    dataclasses.replace(training, inputs={ORIGIN: _given(tokenizer.identity)} | known).save(aside)
    publish(aside, workspace.tokenizer)


def judge_tokenizer(
    study: Study, workspace: Workspace, sources: Sequence[Source], *, threads: int | None = None
) -> None:
    """Measures how well the workspace's tokenizer, which was given, reconstructs frames that the study holds out;
    prints the result and writes it beside the tokenizer. Nothing is done if it was judged by the same frames before. A
    note reports latents with an unusual mean or scale. `threads` as in `make_frame_loader`."""
    from hma_jax.tokenizers.io import load_tokenizer

    place, sources = workspace.tokenizer, seen(study, sources)
    before = read_stamp(place, JUDGED) or read_stamp(place)  # one that was trained here was judged after training
    frames = frames_made_from(study, sources, before)
    known = {name: before.inputs[name] for name in frames if name in before.inputs} if before else {}
    if (place / QUALITY).exists() and not differences(known, frames):
        return
    tokenizer = load_tokenizer(place)
    held_out = make_frames(study, sources, tokenizer.image_size, split="val", threads=threads)
    with step("judge the tokenizer") as update:
        quality = reconstruction_psnr(tokenizer, held_out, lambda done, total: update(done, total, "frames"))
        latents = tokenizer.encode(next(held_out)) if tokenizer.channels else None
    save_quality(quality, place)
    if latents is not None:
        say_unusual(np.asarray(latents, np.float64), (study.model.diffusion or DiffusionConfig()).clip)
    MadeFrom(frames).save(place, JUDGED)


def say_unusual(latents: np.ndarray, clip: float) -> None:
    """Prints a note on latents that a model would learn badly, or could not generate."""
    mean, std, most = np.mean(latents), np.std(latents), np.abs(latents).max()
    if not USUAL_STD[0] <= std <= USUAL_STD[1] or abs(mean) > USUAL_MEAN or most > clip:
        say(
            f"note: in held-out frames the tokenizer's latents have a mean of {mean:.3g} and a standard deviation of "
            f"{std:.3g}, and reach {most:.3g}. A model expects about 0 and 1: it learns others badly, and generates none "
            f"beyond model.diffusion.clip, {clip:g}. Let the tokenizer subtract the mean from its latents and divide them "
            'by the deviation (docs/own_data.md, "Your own tokenizer")'
        )


def _training(stamp: MadeFrom | None) -> MadeFrom:
    """The stamp of a tokenizer's training, also from the stamp of a copy; without inputs if it is not known."""
    if stamp is None:
        return MadeFrom({})
    if stamp.inputs.get(ORIGIN) == TRAINED:
        return stamp
    return dataclasses.replace(stamp, inputs=stamp.inputs.get(TRAINED_FROM, {}))


def _adopted(tokenizer: Tokenizer, source: Path, workspace: Workspace, replace: Step | None) -> bool:
    """Whether the workspace already has the tokenizer in the given directory `source`. Raises ConfigError if it has
    another one, unless `replace` allows it."""
    from hma_jax.tokenizers.io import load_tokenizer

    place = workspace.tokenizer
    lines = _of_another(tokenizer.identity, source, place, lambda there: load_tokenizer(there).identity)
    require_same("tokenizer", place, lines, replace)
    return place.exists() and not lines


def given_changes(source: Path, workspace: Workspace) -> list[str]:
    """How the workspace's tokenizer differs from the one in the directory `source`, according to what they say about
    themselves; [] if there is none."""
    from hma_jax.tokenizers.io import read_identity

    return _of_another(read_identity(source), source, workspace.tokenizer, read_identity)


def _of_another(identity: str, source: Path, place: Path, identify: Callable[[Path], str]) -> list[str]:
    if not place.exists():
        return []
    existing = read_stamp(place)
    if existing is not None and existing.inputs.get(ORIGIN) == _given(identity):
        return []
    try:
        there = identify(place)
    except ConfigError as error:
        return [str(error)]
    if there == identity:  # trained here, or the given directory itself
        return []
    origin = existing.inputs[ORIGIN] if existing else "not written down"
    return [f"tokenizer: {there} ({origin}) -> {identity} ({source})"]


def _given(identity: str) -> str:
    return f"{GIVEN} {identity}"


def _say_what_it_may_know(training: MadeFrom, study: Study, sources: Sequence[Source]) -> None:
    """Warns if a given tokenizer may have been trained on frames that the study holds out: on datasets of the study
    with fewer (a subset of these) or other episodes held out, on datasets before they grew (the hold-out is drawn among
    all episodes of a dataset), or on robots that no model of the study is trained on."""
    trained_with = training.inputs.get("store", {})
    data = {name: facts for name, facts in training.inputs["data"].items() if name in study.all_names()}
    more = [
        f"store.{name}: {trained_with[name]} -> {value}"
        for name, value in to_dict(study.store.held_out).items()
        if name != "max_train"  # this does not change what is held out
        and value > trained_with.get(name, math.inf)
    ]
    if data and more:
        say(
            f"note: the tokenizer was trained on {few(list(data))} with fewer episodes held out ({'; '.join(more)}): it "
            "may have been trained on frames that are held out here"
        )
    known = [(spec, path) for spec, path in sources if spec.name in data]
    otherwise = {spec.name: lines for spec, _ in known if (lines := _other_splits(data[spec.name], spec))}
    for lines in dict.fromkeys(otherwise.values()):
        names = [name for name, own in otherwise.items() if own == lines]
        say(
            f"note: the tokenizer was trained on {few(names)} with other episodes held out ({'; '.join(lines)}): it may "
            "have been trained on frames that are held out here"
        )
    changed = [
        spec.name
        for spec, path in known
        if spec.name not in otherwise
        and (made_of := data[spec.name].get("shards"))
        and made_of != open_source((spec, path), study.store).fingerprint()
    ]
    if changed:
        say(
            f"note: the tokenizer was trained on other recordings of {few(changed)}: unless they only `joins` more "
            "directories now, it may have been trained on frames that are held out here"
        )
    if unseen := [name for name in study.unseen if name in data]:
        say(
            f"note: the tokenizer was trained on frames of {few(unseen)}, which `unseen` names: no model is trained on "
            "them before it is adapted, but the tokenizer knows them already"
        )


def _other_splits(facts: Mapping[str, Any], spec: DatasetSpec) -> tuple[str, ...]:
    """Lines on how the held-out episodes of a dataset, according to the `facts` in a training's stamp, differ from
    those that its entry gives now. Facts that an earlier version did not record are not compared."""
    now = {name: getattr(spec, name) for name in OF_FRAMES}
    before = {name: facts.get(name, value) for name, value in now.items()}
    same = before["val_split"] == now["val_split"] != ""  # whatever else is read
    return () if same else tuple(diff(before, now))
