"""Looking up an entry in the registry's own tables and among those that the user registered."""

from __future__ import annotations

import difflib
import functools
from collections.abc import Iterable

from data_pipelines.registry.beyond_openx import BEYOND_OPENX
from data_pipelines.registry.openx import OPENX
from data_pipelines.registry.own import OWN
from data_pipelines.registry.spec import DatasetSpec
from hma_jax.config import ConfigError, require

MAX_LISTED = 12
"""Number of names in a message; `hma data list` shows all."""

NEW_DATASET = (
    "A new dataset needs an entry in a file given with --registry; `hma data inspect DIR --entry FILE.toml` writes one."
)
"""What to do about a dataset that no entry describes."""

_registered: dict[str, DatasetSpec] = {}


def register(specs: Iterable[DatasetSpec]) -> None:
    """Adds entries for the rest of this process. An entry with a known name replaces the known one."""
    _registered.update({spec.name: spec for spec in specs})


def known_groups() -> dict[str, tuple[DatasetSpec, ...]]:
    """All entries in effect, by origin."""
    left = {title: tuple(s for s in specs if s.name not in _registered) for title, specs in _groups().items()}
    return {title: specs for title, specs in ({"given by you": tuple(_registered.values())} | left).items() if specs}


def all_specs() -> tuple[DatasetSpec, ...]:
    """Every known dataset: the user's own, Open-X, then the suite in its own order."""
    return tuple(_table().values())


def get_spec(name: str) -> DatasetSpec:
    """The entry called `name`. Raises ConfigError, with the closest names, if there is none."""
    table = _table()
    if name in table:
        return table[name]
    joined = next((spec.name for spec in table.values() if name in spec.joins), None)
    if joined is not None:
        raise ConfigError(f"{name!r} is no dataset by itself: the entry {joined!r} joins it; name {joined!r}")
    raise ConfigError(f"{describe_unknown(name)} {NEW_DATASET}")


def describe_unknown(name: str) -> str:
    """What to say about a name that no entry has: the closest names, or some."""
    table = _table()
    names = [*table, *(part for spec in table.values() for part in spec.joins)]
    close = difflib.get_close_matches(name, names, n=3, cutoff=0.4)
    if close:
        hint = f"did you mean {', '.join(close)}?"
    else:
        hint = f"known: {', '.join([*table][:MAX_LISTED])}, ... (`hma data list` shows all)."
    return f"unknown dataset {name!r}; {hint}"


def find_spec(name: str) -> DatasetSpec | None:
    """The entry called `name`, if there is one."""
    return _table().get(name)


def find_reader(own_name: str) -> DatasetSpec | None:
    """The entry that reads the files whose own name is `own_name`: one that joins them with others, or else the one
    of that name, or None. Raises ConfigError if several entries join them, or if the entry of that name joins other
    files only."""
    joining = [spec for spec in _table().values() if own_name in spec.joins]
    require(
        len(joining) <= 1,
        f"{own_name} is in `joins` of {' and '.join(spec.name for spec in joining)}; a dataset can be part of one other: "
        "keep one of these entries in the file for --registry",
    )
    known = joining[0] if joining else find_spec(own_name)
    if known is not None and known.joins and not joining:
        raise ConfigError(
            f"{own_name} is the name of a dataset by its own files, and of the registry's entry that joins "
            f"{', '.join(known.joins)}. Add {own_name} to `joins` of that entry, or call the entry something else"
        )
    return known


def _table() -> dict[str, DatasetSpec]:
    return {spec.name: spec for specs in _groups().values() for spec in specs} | _registered


@functools.cache
def _groups() -> dict[str, tuple[DatasetSpec, ...]]:
    return {
        "own and samples": OWN,
        "Open-X (Open X-Embodiment)": OPENX,
        "other datasets of the paper": BEYOND_OPENX,
        "embedded suite (simulated)": _suite(),
        "simulator suite (extra sim)": _simulators(),
    }


def _suite() -> tuple[DatasetSpec, ...]:
    from data_pipelines.suite.embodiments import EMBODIMENTS  # not needed for the real datasets
    from data_pipelines.suite.spec import IMAGE_KEY

    return tuple(
        DatasetSpec(
            e.name,
            image_key=f"observation/{IMAGE_KEY}",
            action_keys=tuple(key for key, _ in e.action_layout),
            action_dims=tuple(dim for _, dim in e.action_layout),
            hz=e.hz,
            camera=IMAGE_KEY,
            split="train+val",
            val_split="val",
            note=f"simulated {e.family}, {'video alone' if e.video_only else f'{e.convention} actions'}",
        )
        for e in EMBODIMENTS
    )


def _simulators() -> tuple[DatasetSpec, ...]:
    from data_pipelines.simulators.embodiments import EMBODIMENTS

    return tuple(
        DatasetSpec(
            s.name,
            image_key="observation/image",
            action_keys=("action",),
            action_dims=(s.action_dim,),
            hz=s.hz,
            camera=s.view.title,
            note=f"{s.package}: {s.instruction or f'{len(s.envs)} tasks'}",
        )
        for s in EMBODIMENTS
    )
