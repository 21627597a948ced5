"""How many episodes a dataset has, and how long they are, according to its metadata: no episode is read or searched
for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from data_pipelines.sources import robomimic
from data_pipelines.sources.lerobot_meta import read_info
from data_pipelines.sources.rlds import schema
from data_pipelines.sources.rlds.steps import known_mean_steps

if TYPE_CHECKING:
    from data_pipelines.sources.rlds.location import Location


@dataclass(frozen=True)
class SourceSize:
    """The size of the splits that are read together."""

    episodes: int  # damaged ones included
    mean_steps: float = 0.0  # native frames of an episode; 0: not known


def rlds_size(location: Location, split: str) -> SourceSize | None:
    """None if one of the splits is missing, or all are empty. Raises DataError for damaged metadata."""
    directory, parts = schema.resolve_version(location), split.split("+")
    splits = schema.read_info(directory).splits
    if not all(part in splits for part in parts):
        return None
    episodes = sum(sum(splits[part].shard_lengths) for part in parts)
    return SourceSize(episodes, known_mean_steps(directory, split, episodes)) if episodes else None


def lerobot_size(root: Location, split: str) -> SourceSize | None:
    """None if info.json does not state it. Raises DataError for a damaged info.json."""
    info = read_info(root)
    return _of_totals(info.get("total_episodes"), info.get("total_frames"))


def robomimic_size(path: Location, split: str) -> SourceSize | None:
    """Raises DataError for a damaged file, ConfigError for an unknown split."""
    return _of_totals(*robomimic.read_totals(path, split))


def _of_totals(episodes: object, steps: object) -> SourceSize | None:
    if type(episodes) is not int or episodes < 1:
        return None
    return SourceSize(episodes, steps / episodes if type(steps) is int and steps > 0 else 0.0)
