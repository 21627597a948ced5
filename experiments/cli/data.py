"""`hma data`: arguments and help. What the commands do is in `commands.data` and `commands.registry`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import OmitArgPrefixes, Positional, arg
from tyro.extras import SubcommandApp

from data_pipelines.sources.settings import (
    Ego4dSettings,
    EgoExo4dSettings,
    EpicKitchensSettings,
    LeRobotSettings,
    RobomimicSettings,
)
from experiments.cli.how import Remake
from experiments.cli.sim import data_sim, data_sim_table
from experiments.commands import data as commands
from experiments.commands import registry as registry_commands
from experiments.commands import study as study_commands
from experiments.commands import view as view_commands
from experiments.setting import Where, make_setting

data_app = SubcommandApp()
convert_app = SubcommandApp()

HELP = "The registry, what a directory holds, other formats, the simulated suites."

CONVERT_HELP = (
    "Other formats into an RLDS directory, as an export: LeRobot and robomimic are read directly too. Needs the extra 'convert' "
    "(pip install 'hma-jax[convert]'). The same command again goes on where it was interrupted."
)


@data_app.command(name="list")
def data_list(
    words: Annotated[Positional[tuple[str, ...]], arg(metavar="[WORD ...]")] = (),
    mixture: str | None = None,
    registry: Path | None = None,
) -> None:
    """List the datasets that the registry knows: camera, action size, rate.

    Args:
        words: Only entries with all these words in name, note, camera or group ("open-x", "franka").
        mixture: Only the datasets of this mixture: dataset5, 10, 20, 30, 40 or dataset30_vae.
        registry: TOML file with entries of your own.
    """
    registry_commands.list_datasets(words, mixture, registry)


@data_app.command(name="inspect")
def data_inspect(
    directory: Positional[str],
    hz: float | None = None,
    split: str = "train",
    out: Path | None = None,
    episodes: int = 32,
    frames: int = 12,
    json: Path | None = None,
    entry: Path | None = None,
    registry: Path | None = None,
) -> None:
    """Show what a dataset holds, draw a contact sheet, and suggest its registry entry.

    Args:
        directory: The dataset: an RLDS directory (<name> or <name>/<version>, a path or URL), the root of a
            LeRobot dataset, or a robomimic .hdf5 file.
        hz: Native rate of its frames, where no file says it (LeRobot and robomimic do).
        split: The split to look at.
        out: Directory for contact_sheet.png; runs/inspect/NAME if not given.
        episodes: Read so many episodes, drawn at random; fewer if they come to more than 2 GB.
        frames: Frames of the model's window, to count windows.
        json: Write everything there as JSON.
        entry: Add the suggested entry to this TOML file, for --registry.
        registry: TOML file with entries of your own.
    """
    registry_commands.inspect(
        directory, split=split, hz=hz, out=out, episodes=episodes, frames=frames, as_json=json,
        entry=entry, registry=registry,
    )  # fmt: skip


@data_app.command(name="view")
def data_view(
    datasets: Annotated[Positional[tuple[str, ...]], arg(metavar="DATASET [DATASET ...]")],
    out: Path = Path("runs/view.html"),
    split: str | None = None,
    hz: float | None = None,
    stride: int | None = None,
    frames: int = 12,
    episodes: int = 64,
    shown: int = 6,
    registry: Path | None = None,
) -> None:
    """Write one HTML page about datasets: clips with their actions, statistics, windows, what stands out.

    Args:
        datasets: RLDS directories, paths or URLs.
        out: The page, a single file that needs nothing else.
        split: The split to look at; the registry's, or train, if not given.
        hz: Native rate of the frames, if the registry does not know the dataset or is wrong.
        stride: Native frames per frame of the model; what comes nearest to 2 Hz if not given.
        frames: Frames of the model's window, to count windows.
        episodes: Read so many episodes, drawn at random; fewer if they come to more than 2 GB.
        shown: Episodes to show.
        registry: TOML file with entries of your own.
    """
    view_commands.view(
        datasets, out, split=split, hz=hz, stride=stride, frames=frames, episodes=episodes, shown=shown,
        registry=registry,
    )  # fmt: skip


@data_app.command(name="suite")
def data_suite(where: OmitArgPrefixes[Where], remake: OmitArgPrefixes[Remake]) -> None:
    """Write the study's simulated datasets as RLDS directories."""
    study_commands.write_suite(make_setting(where), remake.replace)


@dataclass(frozen=True)
class To:
    """Where the dataset goes."""

    out: Path
    """Directory in which NAME/1.0.0 is written."""
    name: str | None = None
    """Name of the dataset: lower-case letters, digits and _. Made of the source's name if not given."""
    skip_damaged: Annotated[bool, arg(name="skip-damaged")] = False
    """Leave damaged demonstrations, episodes or videos out and count them, instead of stopping."""


@convert_app.command(name="robomimic")
def robomimic(
    source: Positional[Path], to: OmitArgPrefixes[To], settings: OmitArgPrefixes[RobomimicSettings]
) -> None:
    """Robomimic demonstrations: an HDF5 file with camera images.

    Args:
        source: The HDF5 file.
        to: Where the dataset goes.
        settings: What is taken of the file.
    """
    commands.robomimic(source, to, settings)


@convert_app.command(name="lerobot")
def lerobot(
    source: Positional[Path], to: OmitArgPrefixes[To], settings: OmitArgPrefixes[LeRobotSettings]
) -> None:
    """A LeRobot dataset, version 2.0, 2.1 or 3.0, with videos or images.

    Args:
        source: Its root, with meta, data and videos.
        to: Where the dataset goes.
        settings: What is taken of the dataset.
    """
    commands.lerobot(source, to, settings)


@convert_app.command(name="epic-kitchens")
def epic_kitchens(
    source: Positional[Path],
    detections: Path,
    to: OmitArgPrefixes[To],
    settings: OmitArgPrefixes[EpicKitchensSettings],
) -> None:
    """EPIC-KITCHENS-100 frames with the published hand detections: 2-D hand motion as actions, 10 Hz.

    Args:
        source: Root of the frames: <participant>/rgb_frames/<video>/frame_*.jpg.
        detections: Folder of the detections: <participant>/<video>.pkl. No code in them is run.
        to: Where the dataset goes.
        settings: Which frames make episodes.
    """
    commands.epic_kitchens(source, detections, to, settings)


@convert_app.command(name="ego4d")
def ego4d(
    source: Positional[Path],
    videos: Path,
    to: OmitArgPrefixes[To],
    settings: OmitArgPrefixes[Ego4dSettings],
) -> None:
    """Ego4D videos with the annotated hand boxes (FHO): 2-D hand positions as actions, 2 Hz.

    Args:
        source: The annotations, fho_main.json.
        videos: Folder of <video_uid>.mp4.
        to: Where the dataset goes.
        settings: Which frames make episodes.
    """
    commands.ego4d(source, videos, to, settings)


@convert_app.command(name="egoexo4d")
def egoexo4d(
    source: Positional[Path], to: OmitArgPrefixes[To], settings: OmitArgPrefixes[EgoExo4dSettings]
) -> None:
    """Ego-Exo4D takes with automatic hand poses: 2-D wrist positions as actions, 30 Hz.

    Args:
        source: Root of the dataset, with takes.json, takes and annotations.
        to: Where the dataset goes.
        settings: Which takes and frames make episodes.
    """
    commands.egoexo4d(source, to, settings)


@data_app.command(name="import-tokens")
def import_tokens(
    folders: Annotated[Positional[tuple[Path, ...]], arg(metavar="FOLDER [FOLDER ...]")],
    store: Path,
    name: str | None = None,
    hz: float | None = None,
    patch: int = 2,
    frame_step: Annotated[int | None, arg(name="frame-step")] = None,
    tokenizer: Path | None = None,
) -> None:
    """Read token folders of the official release (video.bin, actions, segment_ids.bin) into a token store.

    A dataset is a pair of folders that end in _train and _val; either of them stands for both. The
    tokens are taken as they are.

    Args:
        folders: Folders to read.
        store: Token store to add them to.
        name: Name of the dataset, if there is one only; the folders' own if not given.
        hz: Native frames per second, if the registry does not know the dataset.
        patch: Latent cells along one side of a token; of no effect on ids.
        frame_step: Every how many native frames one is stored; the stride, for frames at 2 Hz, if not given.
        tokenizer: Directory of the tokenizer that made the tokens. It decodes the validation frames that
            evaluation in pixels compares with.
    """
    commands.import_tokens(folders, store, name, hz, patch, frame_step, tokenizer)


data_app.command(name="sim")(data_sim)
data_app.command(name="sim-table")(data_sim_table)
data_app.command(convert_app, name="convert", help=CONVERT_HELP)
