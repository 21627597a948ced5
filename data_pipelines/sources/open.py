"""Opens a dataset of any format by its location.

Owns the choice of the format. A new format is one more source and one line here.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from data_pipelines.errors import MAX_LISTED, DataError, NoDatasetError, UnreachableError
from data_pipelines.names import MANIFEST
from data_pipelines.sources.joined import JoinedSource, Parts
from data_pipelines.sources.lerobot_dataset import LeRobotDataset, lerobot_name
from data_pipelines.sources.lerobot_meta import read_info
from data_pipelines.sources.rlds import schema
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.location import OpenFiles, is_remote, locate
from data_pipelines.sources.rlds.steps import known_mean_steps
from data_pipelines.sources.robomimic import read_environment, read_totals
from data_pipelines.sources.robomimic_dataset import RobomimicDataset, robomimic_name
from data_pipelines.sources.source import MAX_SKIPPED, Corrupt, EpisodeSource
from hma_jax.config import require

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location


@dataclass(frozen=True)
class SourceSize:
    """The size of the splits that are read together."""

    episodes: int  # damaged ones included
    mean_steps: float = 0.0  # native frames of an episode; 0: not known


class Format(NamedTuple):
    """How a format is read: its episodes; and, without reading these, its name, its rate in Hz and its size (None: not
    stated)."""

    source: Callable[..., EpisodeSource]
    name: Callable[[Location], str]
    hz: Callable[[Location], float | None]
    size: Callable[[Location, str], SourceSize | None]


def _rlds_size(location: Location, split: str) -> SourceSize | None:
    """None if one of the splits is missing, or all are empty. Raises DataError for damaged metadata."""
    directory, parts = schema.resolve_version(location), split.split("+")
    splits = schema.read_info(directory).splits
    if not all(part in splits for part in parts):
        return None
    episodes = sum(sum(splits[part].shard_lengths) for part in parts)
    return SourceSize(episodes, known_mean_steps(directory, split, episodes)) if episodes else None


def _lerobot_size(root: Location, split: str) -> SourceSize | None:
    """None if info.json does not state it. Raises DataError for a damaged info.json."""
    info = read_info(root)
    return _of_totals(info.get("total_episodes"), info.get("total_frames"))


def _robomimic_size(path: Location, split: str) -> SourceSize | None:
    """Raises DataError for a damaged file, ConfigError for an unknown split."""
    return _of_totals(*read_totals(path, split))


def _of_totals(episodes: object, steps: object) -> SourceSize | None:
    if type(episodes) is not int or episodes < 1:
        return None
    return SourceSize(episodes, steps / episodes if type(steps) is int and steps > 0 else 0.0)


FORMATS = {
    "rlds": Format(
        RldsDataset, schema.dataset_name, lambda place: schema.read_rate(schema.resolve_version(place)), _rlds_size
    ),
    "lerobot": Format(LeRobotDataset, lerobot_name, lambda place: float(read_info(place)["fps"]), _lerobot_size),
    "robomimic": Format(
        RobomimicDataset,
        lambda place: robomimic_name(read_environment(place)[0]),
        lambda place: read_environment(place)[1],
        _robomimic_size,
    ),
}

HDF5 = (".hdf5", ".h5")


def find_format(location: str | Location) -> str:
    """One of FORMATS, by the files at `location`; 'rlds' for every other URL.

    For a path on a disk that is not a dataset, raises as `resolve_version` does, and says what may have been meant.
    """
    place = locate(location)
    found = _signs(place)
    if found == "rlds" and isinstance(place, Path):
        try:
            schema.resolve_version(place)
        except UnreachableError:
            raise
        except DataError as error:
            meant = _meant(place)
            if not meant and _holds_tokens(place):
                raise NoDatasetError(
                    f"{place}: a token store, not recordings. Give the directory of the recordings: tokens that were made "
                    "of them are used where --out is the directory of their study. To train on tokens that were imported: "
                    'docs/own_data.md, "Training on tokens of the release".'
                ) from error
            raise type(error)(f"{error}{meant}") from error
    require(
        found == "rlds" or not is_remote(place),
        f"{place}: {found} can be read only from a disk. Copy the dataset to a disk.",
    )
    return found


def _signs(place: Location) -> str:
    """The format that the files at `place` show signs of; 'rlds' if there are none."""
    if place.suffix in HDF5 and (is_remote(place) or place.is_file()):
        return "robomimic"
    return "lerobot" if (place / "meta" / "info.json").is_file() else "rlds"


def _holds_tokens(place: Path) -> bool:
    """Whether a path is a token store, or a dataset of one."""
    try:
        return (place / MANIFEST).is_file() or any((p / MANIFEST).is_file() for p in place.iterdir())
    except OSError:  # a file, a missing directory, or one that may not be read
        return False


def _meant(place: Path) -> str:
    """The end of a message about a path that is not a dataset: what to give instead, or what is missing there."""
    try:
        if not place.is_dir():
            others = [p.name for p in place.parent.iterdir() if p.name != place.name]
            close = difflib.get_close_matches(place.name, others, n=1)
            return f" Closest: {place.parent / close[0]}" if close else ""
        inside = sorted(place.iterdir())
        if place / "snapshots" in inside:  # the Hugging Face hub's cache of a dataset: the newest revision
            inside = sorted((place / "snapshots").iterdir(), key=lambda p: p.stat().st_mtime)[-1:]
        datasets = [str(p) for p in inside if _is_dataset(p)]
    except OSError:  # a missing parent, or one that may not be read
        return ""
    if len({"meta", "data", "videos"} & {p.name for p in inside}) > 1:
        return f" If it is a LeRobot dataset that was copied in part, copy {place / 'meta' / 'info.json'} too"
    more = f" and {len(datasets) - MAX_LISTED} more" if len(datasets) > MAX_LISTED else ""
    return f" Datasets in it: {', '.join(datasets[:MAX_LISTED])}{more}" if datasets else ""


def _is_dataset(place: Path) -> bool:
    if _signs(place) != "rlds":
        return True
    try:
        schema.resolve_version(place)
    except DataError:
        return False
    return True


def open_source(
    location: str | Location | Parts,
    split: str = "train",
    *,
    corrupt: Corrupt = "raise",
    max_skipped: float = MAX_SKIPPED,
    files: OpenFiles | None = None,
) -> EpisodeSource:
    """The episodes of one split of the dataset at `location`, or of all `Parts`; `files` may be shared by several.

    Raises DataError for a location that is no dataset, and for damage that `corrupt` does not allow;
    ConfigError for an unknown split and for a library that is missing.
    """
    if isinstance(location, Parts):
        files = OpenFiles() if files is None else files
        own = sys.maxsize  # the limit applies to all parts together
        parts = [open_source(p, split, corrupt=corrupt, max_skipped=own, files=files) for p in location.places]
        return JoinedSource(location.name, parts, corrupt, max_skipped)
    source = FORMATS[find_format(location)].source
    shared = {"files": files} if source is RldsDataset else {}
    return source(locate(location), split, corrupt=corrupt, max_skipped=max_skipped, **shared)


def read_rate(location: Location | Parts) -> float | None:
    """Native frames per second, as stated by the files of a dataset, or of the first of `Parts` that states it; None if
    none does. Does not search for episodes, which may take hours. Raises DataError for a location that is not a
    dataset."""
    places = location.places if isinstance(location, Parts) else (location,)
    rates = (FORMATS[find_format(place)].hz(place) for place in places)
    return next((hz for hz in rates if hz is not None), None)


def read_size(location: str | Location, split: str) -> SourceSize | None:
    """The size of one split of the dataset at `location`, or of several ("train+val"); None if its files do not state
    it. Raises DataError for a location that is not a dataset and for damaged metadata, ConfigError for a missing
    library."""
    return FORMATS[find_format(location)].size(locate(location), split)


def source_name(location: str | Location) -> str:
    """The name of the dataset at `location`, by which the registry knows it. Raises DataError if there is no
    dataset."""
    return FORMATS[find_format(location)].name(locate(location))
