"""How many trajectories each dataset of a study has: as was counted when its tokens were made, or else as its files
say, or else as the registry says.

Owns what is known of the user's datasets in this process; `preparing.sizes` finds it.
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

    episodes: int  # damaged and held-out ones included; 0: nothing says it
    tokenised: int  # of these, all but those that `StoreConfig.max_train` leaves out; where that is not known, at most
    trained: int | None = None  # trajectories to train on; None: nothing says how many are held out
    skipped: int = 0  # left out as damaged, of those to train on or held out
    mean_steps: float = 0.0  # native frames of an episode, as its files say; 0: they do not


def make_size(spec: DatasetSpec, amount: HeldOut, episodes: int, val: int | None, mean_steps: float = 0.0) -> DataSize:
    """The size of a dataset of so many `episodes`, `val` of them held out (None: nothing says how many), of which none
    is damaged."""
    if val is None:
        return DataSize(episodes, min(episodes, sum(amount.used(episodes, episodes, True))), mean_steps=mean_steps)
    train, val = amount.used(episodes - val, val, bool(spec.val_split))
    return DataSize(episodes, train + val, train, mean_steps=mean_steps)


_known: dict[str, DataSize] = {}


def use_sizes(sizes: Mapping[str, DataSize]) -> None:
    """For the rest of this process these are the sizes of datasets, in place of all that were used before."""
    _known.clear()
    _known.update(sizes)


def size_of(spec: DatasetSpec, held_out: HeldOut) -> DataSize:
    """As files or tokens say, or else as the registry does."""
    return _known.get(spec.name) or size_by_entry(spec, held_out)


def size_by_entry(spec: DatasetSpec, held_out: HeldOut) -> DataSize:
    """As the registry says, as if no episode was damaged and joined datasets were one."""
    unknown = not spec.episodes or spec.val_split
    return make_size(spec, held_out, spec.episodes, None if unknown else held_out.count(spec.episodes))


def are_counted(names: Sequence[str]) -> bool:
    """Whether files or tokens, not the registry, say the sizes of all these datasets."""
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
    """The sizes of all datasets that the file says it of; {} without the file, or for one that is damaged."""
    try:
        usable, data = count_usable(data_summary), read_data(data_summary)
    except ConfigError:  # the study's command writes it again, and who shows it says so
        return {}
    found = {}
    for name, facts in data.items():
        held_out, skipped = facts.get("held_out"), facts.get("skipped", 0)
        if held_out is not None:
            tokenised = facts["episodes"] + held_out + skipped
            found[name] = DataSize(tokenised + facts.get("left_out", 0), tokenised, usable[name], skipped)
    return found
