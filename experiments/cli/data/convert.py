"""`hma data convert` and `hma data import-tokens`: other formats. Each command says what it wrote, and what is next."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from data_pipelines.errors import DataError, without_advice
from data_pipelines.names import made_name
from data_pipelines.registry.toml_file import to_toml
from data_pipelines.sources.settings import (
    Ego4dSettings,
    EgoExo4dSettings,
    EpicKitchensSettings,
    LeRobotSettings,
    RobomimicSettings,
)
from experiments.study_setup import UNSET, command
from experiments.terminal.progress import say, short, step, wrote
from hma_jax.config import require

if TYPE_CHECKING:
    from data_pipelines.sources.convertible import ConvertibleSource


@dataclass(frozen=True)
class Destination:
    """Where the dataset is written."""

    out: Annotated[Path, arg(metavar="DIR")]
    """Directory in which NAME/1.0.0 is written."""
    name: Annotated[str | None, UNSET] = None
    """Name of the dataset: lower-case letters, digits and _. (default: made from the source's name)"""
    skip_damaged: Annotated[FlagCreatePairsOff[bool], arg(name="skip-damaged"), UNSET] = False
    """Leave out damaged demonstrations, episodes or videos and count them, instead of stopping."""


def robomimic(
    source: Annotated[Positional[Path], arg(metavar="SOURCE")],
    destination: OmitArgPrefixes[Destination],
    settings: OmitArgPrefixes[RobomimicSettings],
) -> None:
    """Convert robomimic demonstrations: an HDF5 file with camera images.

    Args:
        source: The HDF5 file.
        destination: Where the dataset is written.
        settings: What is taken from the file.
    """
    from data_pipelines.sources.robomimic import RobomimicSource

    opened = RobomimicSource(source, settings)
    _convert(opened, destination, f"robomimic_{opened.task}", opened.unsupported_images)


def lerobot(
    source: Annotated[Positional[Path], arg(metavar="SOURCE")],
    destination: OmitArgPrefixes[Destination],
    settings: OmitArgPrefixes[LeRobotSettings],
) -> None:
    """Convert a LeRobot dataset, version 2.0, 2.1 or 3.0, with videos or images.

    Every video frame becomes a JPEG, so the dataset grows: 289 MB of video became 2.6 GB. --short-side and --camera
    reduce this.

    Args:
        source: Root of the dataset, with meta, data and videos.
        destination: Where the dataset is written.
        settings: What is taken from the dataset.
    """
    from data_pipelines.sources.lerobot import LeRobotSource
    from data_pipelines.sources.lerobot_dataset import lerobot_name

    opened = LeRobotSource(source, settings, may_lose=destination.skip_damaged)
    _convert(opened, destination, destination.name or lerobot_name(source), opened.unsupported_images)


def epic_kitchens(
    source: Annotated[Positional[Path], arg(metavar="SOURCE")],
    detections: Annotated[Path, arg(metavar="DIR")],
    destination: OmitArgPrefixes[Destination],
    settings: OmitArgPrefixes[EpicKitchensSettings],
) -> None:
    """Convert EPIC-KITCHENS-100 frames with the published hand detections: 2-D hand motion as actions, 10 Hz.

    Args:
        source: Root of the frames: <participant>/rgb_frames/<video>/frame_*.jpg.
        detections: Folder of the detections: <participant>/<video>.pkl. No code in them is run.
        destination: Where the dataset is written.
        settings: Which frames make episodes.
    """
    from data_pipelines.sources.human.epic_kitchens import NAME, EpicKitchensSource

    _convert(EpicKitchensSource(source, detections, settings), destination, NAME)


def ego4d(
    source: Annotated[Positional[Path], arg(metavar="SOURCE")],
    videos: Annotated[Path, arg(metavar="DIR")],
    destination: OmitArgPrefixes[Destination],
    settings: OmitArgPrefixes[Ego4dSettings],
) -> None:
    """Convert Ego4D videos with the annotated hand boxes (FHO): 2-D hand positions as actions, 2 Hz.

    Args:
        source: The annotations, fho_main.json.
        videos: Folder of <video_uid>.mp4.
        destination: Where the dataset is written.
        settings: Which frames make episodes.
    """
    from data_pipelines.sources.human.ego4d import NAME, Ego4dSource

    _convert(Ego4dSource(source, videos, settings), destination, NAME)


def egoexo4d(
    source: Annotated[Positional[Path], arg(metavar="SOURCE")],
    destination: OmitArgPrefixes[Destination],
    settings: OmitArgPrefixes[EgoExo4dSettings],
) -> None:
    """Convert Ego-Exo4D takes with automatic hand poses: 2-D wrist positions as actions, 30 Hz.

    Args:
        source: Root of the dataset, with takes.json, takes and annotations.
        destination: Where the dataset is written.
        settings: Which takes and frames make episodes.
    """
    from data_pipelines.sources.human.egoexo4d import NAME, EgoExo4dSource

    _convert(EgoExo4dSource(source, settings), destination, NAME)


def _convert(
    source: ConvertibleSource, destination: Destination, default_name: str, unsupported_images: Collection[str] = ()
) -> None:
    from data_pipelines.convert.write import convert
    from data_pipelines.sources.convertible import UnitError, unsupported_images_text

    name = destination.name or made_name(default_name)
    with step(f"convert {len(source.units)} to {name}") as update:
        try:
            done = convert(
                source,
                destination.out,
                name,
                skip_damaged=destination.skip_damaged,
                progress=update,
            )
        except UnitError as error:  # the error's own advice is also for users who tokenise
            rest = without_advice(str(error))
            advice = "Download the file again, or add" if rest != str(error) else "Add"
            raise DataError(f"{rest} {advice} --skip-damaged to leave it out.") from error
    say(f"{done.episodes:,} episodes at {done.spec.hz:g} Hz in {done.shards} shards")
    for reason, count in done.skipped.items():
        say(f"left out {count:,} x: {reason}")
    if unsupported_images:
        say(unsupported_images_text(unsupported_images))
    say(
        "to read it, this registry entry is needed: add `--entry FILE.toml` to the next command, or write the entry into "
        "such a file, and give that file to all others with --registry:"
    )
    say(to_toml(done.spec))
    wrote(done.directory, then=command("data inspect", done.directory))


def import_tokens(
    folders: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="FOLDER [FOLDER ...]", help_behavior_hint="(required)")
    ],
    store: Annotated[Path, arg(metavar="DIR")],
    name: Annotated[str | None, UNSET] = None,
    hz: Annotated[float | None, UNSET] = None,
    patch: int = 2,
    frame_step: Annotated[int | None, arg(name="frame-step"), UNSET] = None,
    tokenizer: Annotated[Path | None, arg(metavar="DIR"), UNSET] = None,
) -> None:
    """Read token folders of the official release (video.bin, actions, segment_ids.bin) into a token store.

    A dataset is a pair of folders whose names end in _train and _val; give either of them. The tokens are stored
    unchanged. The store is for a program of your own, such as the one of docs/own_data.md that trains a model on it;
    other commands make tokens from recordings themselves.

    Args:
        folders: Folders to read.
        store: Token store to add the datasets to.
        name: Name of the dataset, if only one is imported. Default: the folders' name.
        hz: Native frames per second, if the registry does not know the dataset.
        patch: Latent cells along one side of a token; no effect on ids.
        frame_step: The stored tokens are of every N-th native frame. Default: the stride that gives 2 Hz.
        tokenizer: Directory of the tokenizer that made the tokens. It decodes the validation frames, which evaluation
            in pixels needs.
    """
    from data_pipelines.tokens.import_tokens import import_tokens as import_pair
    from data_pipelines.tokens.import_tokens import pair_folders

    pairs = pair_folders(folders)
    require(name is None or len(pairs) == 1, f"--name can be given for one dataset, not for {len(pairs)}")
    decoder = None
    if tokenizer is not None:
        from hma_jax.tokenizers.io import load_tokenizer

        decoder = load_tokenizer(tokenizer)
    for stem, train, val in pairs:
        with step(f"import {stem}") as update:
            manifest = import_pair(
                train,
                val,
                store,
                name=name,
                hz=hz,
                patch=patch,
                frame_step=frame_step,
                tokenizer=decoder,
                progress=update,
            )
        facts, spec = manifest.tokenizer, manifest.spec
        what = f"latents of {facts.channels} values" if facts.channels else f"ids of {facts.vocab_size:,}"
        say(
            f"{spec.name}: {len(manifest.train.episodes):,} + {len(manifest.val.episodes):,} episodes, "
            f"{facts.tokens} tokens per frame, {what}, by {facts.identity}; "
            f"{spec.hz:g} Hz, stride {spec.stride}"
        )
        wrote(store / spec.name)
    if tokenizer is None:
        say("note: without --tokenizer no frames are stored, so evaluation in pixels cannot use these datasets")
    say(f'next: train on {short(store)} with the program of docs/own_data.md, "Training on tokens of the release"')
