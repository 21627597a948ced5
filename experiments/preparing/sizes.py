"""Finds how many trajectories the user's datasets have, and reports where the registry differs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from data_pipelines.errors import DataError
from data_pipelines.registry import DatasetSpec, find_spec
from data_pipelines.sampling.splits import HeldOut
from experiments.data_size import DataSize, make_size, sizes_by_tokens
from experiments.preparing.sources import group_by_dataset
from experiments.running.workspace import Workspace
from experiments.terminal.progress import say
from experiments.terminal.words import few
from hma_jax.config import ConfigError


def group_readable(data: Sequence[str]) -> dict[str, dict[str, str]]:
    """Like `group_by_dataset`; {} if one of them cannot be read: the code that reads it says why."""
    try:
        return group_by_dataset(data)
    except (DataError, ConfigError):
        return {}


def find_sizes(
    datasets: Mapping[str, Mapping[str, str]], held_out: HeldOut, workspace: Workspace
) -> dict[str, DataSize]:
    """The sizes of those `datasets` (as `group_by_dataset` gives them) whose files say how many episodes there are, or
    whose tokens are in `workspace` and were made from the same number of episodes."""
    by_tokens, sizes, others = sizes_by_tokens(workspace.data_summary), {}, []
    for name, places in datasets.items():
        spec, tokens = find_spec(name), by_tokens.get(name)
        files = spec and size_by_files(spec, places, held_out)
        if files and spec.episodes not in (0, files.episodes):
            others.append(f"{name} has {files.episodes:,} (not {spec.episodes:,})")
        if files and tokens and (files.episodes, files.tokenised) == (tokens.episodes, tokens.tokenised):
            tokens = replace(tokens, mean_steps=files.mean_steps)
        elif files:
            tokens = None
        if known := tokens or files:
            sizes[name] = known
    if others:
        say(f"note: numbers of episodes are those of your files, not of the registry's entries: {few(others)}")
    return sizes


def size_by_files(spec: DatasetSpec, places: Mapping[str, str], held_out: HeldOut) -> DataSize | None:
    """The size of the dataset whose parts lie at `places`. None if its files do not say it: the code that reads them
    reports damage."""
    from data_pipelines.sources.open import read_size

    try:
        parts = [read_size(place, spec.split) for place in places.values()]
        val = [spec.val_split and read_size(place, spec.val_split) for place in places.values()]
    except (DataError, ConfigError):
        return None
    if not all(parts):
        return None
    episodes = sum(part.episodes for part in parts)
    kept = None
    if not spec.val_split:
        kept = sum(held_out.count(part.episodes) for part in parts)
    elif all(val):
        kept = sum(one.episodes for one in val)
    steps = sum(part.episodes * part.mean_steps for part in parts) if all(part.mean_steps for part in parts) else 0
    return make_size(spec, held_out, episodes, kept, steps / episodes)
