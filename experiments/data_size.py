"""How many trajectories each dataset of a study has: as counted when its tokens were made, or else as its files say, or
else as the registry says.

Owns what this process knows about the sizes of the user's datasets; `preparing.sizes` finds them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from data_pipelines.registry import DatasetSpec
from data_pipelines.sampling.splits import HeldOut
from hma_jax.config import ConfigError, require


@dataclass(frozen=True)
class DataSize:
    """The size of one dataset."""

    episodes: int  # damaged and held-out ones included; 0: unknown
    tokenised: int  # of these, all but those that the setting `max_train` leaves out; an upper bound if not known
    trained: int | None = None  # trajectories to train on; None: it is unknown how many are held out
    skipped: int = 0  # trajectories to train on or held out that are left out as damaged
    mean_steps: float = 0.0  # native frames per episode, as the files say; 0: they do not say


def make_size(spec: DatasetSpec, amount: HeldOut, episodes: int, val: int | None, mean_steps: float = 0.0) -> DataSize:
    """The size of a dataset with this number of `episodes`, none of them damaged, `val` of them held out (None:
    unknown)."""
    if val is None:
        return DataSize(episodes, min(episodes, sum(amount.used(episodes, episodes, True))), mean_steps=mean_steps)
    train, val = amount.used(episodes - val, val, bool(spec.val_split))
    return DataSize(episodes, train + val, train, mean_steps=mean_steps)


_known: dict[str, DataSize] = {}


def use_sizes(sizes: Mapping[str, DataSize]) -> None:
    """Replaces the known sizes of datasets, for the rest of this process."""
    _known.clear()
    _known.update(sizes)


def size_of(spec: DatasetSpec, held_out: HeldOut) -> DataSize:
    """The size as files or tokens say, or else as the registry says."""
    return _known.get(spec.name) or size_by_entry(spec, held_out)


def size_by_entry(spec: DatasetSpec, held_out: HeldOut) -> DataSize:
    """The size as the registry says, assuming that no episode is damaged and that joined datasets are one."""
    unknown = not spec.episodes or spec.val_split
    return make_size(spec, held_out, spec.episodes, None if unknown else held_out.count(spec.episodes))


def are_counted(names: Sequence[str]) -> bool:
    """Whether the sizes of all these datasets come from files or tokens, not from the registry."""
    return all(name in _known for name in names)


def read_data(data_summary: Path) -> dict[str, dict[str, int]]:
    """{robot: its counts of episodes, windows, ...}; {} without the file. Raises ConfigError for a damaged file."""
    try:
        facts_by_robot = {name: {**facts} for name, facts in json.loads(data_summary.read_text()).items()}
        require(
            all(isinstance(facts["episodes"], int) for facts in facts_by_robot.values()), "episodes that are no number"
        )
        return facts_by_robot
    except FileNotFoundError:
        return {}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(
            f"{data_summary} does not say how much there is of each robot ({error}); remove it, the study's command "
            "writes it again"
        ) from error


def count_usable(data_summary: Path) -> dict[str, int]:
    """{robot: training trajectories that have windows}. Raises what `read_data` raises."""
    return {name: facts["episodes"] - facts.get("too_short", 0) for name, facts in read_data(data_summary).items()}


def sizes_by_tokens(data_summary: Path) -> dict[str, DataSize]:
    """The sizes of all datasets in the file; {} without the file, or if it is damaged."""
    try:
        usable, data = count_usable(data_summary), read_data(data_summary)
    except ConfigError:  # the study's command writes it again, and the code that shows it reports the damage
        return {}
    found = {}
    for name, facts in data.items():
        held_out, skipped = facts.get("held_out"), facts.get("skipped", 0)
        if held_out is not None:
            tokenised = facts["episodes"] + held_out + skipped
            found[name] = DataSize(tokenised + facts.get("left_out", 0), tokenised, usable[name], skipped)
    return found
