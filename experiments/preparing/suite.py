"""The simulated datasets of a study, each made once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from data_pipelines.registry import get_spec
from experiments.preparing.made_from import Step, may_replace, require_same
from experiments.preparing.sources import Source
from experiments.running.workspace import Workspace
from experiments.study import Study, SuiteConfig
from experiments.terminal.progress import say, step
from experiments.terminal.words import counted, few
from hma_jax.config import require
from hma_jax.runtime.cores import usable_cores

MOST_LINES = 8
"""Most lines of differences in a message."""


def require_simulated(names: Sequence[str], advice: str = "Give RLDS directories with --data") -> None:
    """Raises ConfigError unless every dataset is one of the suite, which needs no --data."""
    from data_pipelines.suite.embodiments import EMBODIMENTS

    simulated = {e.name for e in EMBODIMENTS}
    real = [name for name in names if name not in simulated]
    require(
        not real,
        f"{', '.join(real[:3])}{' and others' if len(real) > 3 else ''}: not simulated. {advice}",
    )


def make_suite(study: Study, workspace: Workspace, replace: Step | None = None) -> list[Source]:
    """The simulated datasets of the study, written once.

    Raises ConfigError if some exist with another seed or size, unless `replace` allows it. Datasets made by an earlier
    version of the simulator stay in use, with a note.
    """
    from data_pipelines.sources.rlds.writer import VERSION
    from data_pipelines.suite.generate import generate_suite

    names = study.all_names()
    specs = [get_spec(name) for name in names]  # a mistyped name is refused before any work
    require_simulated(names)
    found = {name: _differences(name, workspace.suite / name / VERSION, study.suite) for name in names}
    require_same("suite", workspace.suite, _lines(found), replace)
    kept = [] if may_replace("suite", replace) else [name for name in names if found[name] == []]
    with step(f"simulate {counted(len(names), 'dataset')}") as update:
        generate_suite(
            workspace.suite,
            scale=study.suite.scale,
            seed=study.suite.seed,
            validation=study.suite.validation,
            fewest=study.suite.fewest,
            names=[name for name in names if name not in kept],
            workers=usable_cores(),
            progress=lambda name, done, total: update(done, total, name),
        )
    if kept:
        say(
            f"note: {few(kept)} in {workspace.suite}: made by an earlier version of the simulator, and still used; "
            "--replace suite makes them again, and everything that depends on them"
        )
    return [(spec, workspace.suite / spec.name / VERSION) for spec in specs]


def suite_changes(study: Study, workspace: Workspace) -> list[str]:
    """How the existing simulated datasets were made differently from what the study would make."""
    from data_pipelines.sources.rlds.writer import VERSION

    places = {name: workspace.suite / name / VERSION for name in study.all_names()}
    return _lines({name: _differences(name, place, study.suite) for name, place in places.items() if place.exists()})


def suite_is_there(study: Study, workspace: Workspace) -> bool:
    """Whether all datasets of the study exist, with its settings."""
    from data_pipelines.sources.rlds.writer import VERSION

    places = {name: workspace.suite / name / VERSION for name in study.all_names()}
    return all(place.exists() and not _differences(name, place, study.suite) for name, place in places.items())


def _differences(name: str, directory: Path, suite: SuiteConfig) -> list[str] | None:
    """Lines on how an existing dataset was made differently from what `suite` says; [] if only by another version of
    the simulator. None for a dataset that is as it should be, and for one that will be made in any case, because it is
    missing or lacks shards."""
    from data_pipelines.publishing.fingerprint import FINGERPRINT, is_complete, read_metadata, shard_lengths
    from data_pipelines.suite.embodiments import select
    from data_pipelines.suite.generate import episode_count, fingerprint

    (spec,) = select([name])
    expected = fingerprint(spec, suite.scale, suite.seed, suite.validation, suite.fewest)
    if not directory.exists() or is_complete(directory, expected):
        return None
    metadata = read_metadata(directory)
    made_as, seed = metadata.get(FINGERPRINT), metadata.get("seed")
    episodes, held_out = (sum(shard_lengths(directory, split)) for split in ("train", "val"))
    if made_as is None or seed is None or not episodes or not held_out:
        return ["the existing datasets do not say how they were made"]
    wanted = episode_count(spec, suite.scale, suite.fewest)
    lines = [f"suite.seed: {seed} -> {suite.seed}"] if seed != suite.seed else []
    lines += [f"suite.scale or suite.fewest: {episodes} -> {wanted} episodes"] if episodes != wanted else []
    lines += [f"suite.validation: {held_out} -> {suite.validation} episodes"] if held_out != suite.validation else []
    return lines if lines or is_complete(directory, made_as) else None


def _lines(found: Mapping[str, list[str] | None]) -> list[str]:
    lines = [f"{name}: {line}" for name, own in found.items() for line in own or ()]
    more = len(lines) - MOST_LINES
    return [*lines[:MOST_LINES], f"... and {more} more"] if more > 0 else list(lines)
