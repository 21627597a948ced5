"""Opens a dataset of any format by its location.

Owns the choice of the format. A new format is one more source and one line here.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from data_pipelines.sources.joined import JoinedSource, Parts
from data_pipelines.sources.rlds.location import OpenFiles, is_remote, locate
from data_pipelines.sources.source import MAX_SKIPPED, Corrupt, EpisodeSource
from hma_jax.config import require

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location

HDF5 = (".hdf5", ".h5")


def find_format(location: str | Location) -> str:
    """'rlds', 'lerobot' or 'robomimic', by the files at `location`; 'rlds' if there are none."""
    place = locate(location)
    if place.suffix in HDF5 and not place.is_dir():
        found = "robomimic"
    elif (place / "meta" / "info.json").is_file():
        found = "lerobot"
    else:
        return "rlds"
    require(not is_remote(place), f"{place}: {found} can be read only from a disk. Copy the dataset to a disk.")
    return found


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
        own = sys.maxsize  # the limit is of all parts together
        parts = [open_source(p, split, corrupt=corrupt, max_skipped=own, files=files) for p in location.places]
        return JoinedSource(location.name, parts, corrupt, max_skipped)
    options = {"corrupt": corrupt, "max_skipped": max_skipped}
    kind = find_format(location)
    if kind == "lerobot":
        from data_pipelines.sources.lerobot_dataset import LeRobotDataset

        return LeRobotDataset(locate(location), split, **options)
    if kind == "robomimic":
        from data_pipelines.sources.robomimic_dataset import RobomimicDataset

        return RobomimicDataset(locate(location), split, **options)
    from data_pipelines.sources.rlds.dataset import RldsDataset

    return RldsDataset(location, split, files=files, **options)


def source_name(location: str | Location) -> str:
    """The name of the dataset at `location`, by which the registry knows it. Raises DataError for none."""
    kind = find_format(location)
    if kind == "lerobot":
        from data_pipelines.sources.lerobot_dataset import dataset_name

        return dataset_name(locate(location))
    if kind == "robomimic":
        from data_pipelines.sources.robomimic import RobomimicSource
        from data_pipelines.sources.robomimic_dataset import dataset_name as name_of

        return name_of(RobomimicSource(locate(location)))
    from data_pipelines.sources.rlds.schema import dataset_name as rlds_name

    return rlds_name(location)
