"""The datasets that a study reads: directories of the user, or the simulated suite."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from data_pipelines.errors import NoDatasetError
from data_pipelines.registry import DatasetSpec, find_reader, find_spec, get_spec
from data_pipelines.registry.table import NEW_DATASET, describe_unknown
from experiments.data_size import size_of
from experiments.running.workspace import Workspace
from experiments.study import StoreConfig, Study
from experiments.terminal.progress import say
from experiments.terminal.words import few
from hma_jax.config import require

if TYPE_CHECKING:
    from data_pipelines.sources.joined import Parts
    from data_pipelines.sources.rlds.location import Location
    from data_pipelines.sources.source import EpisodeSource

Source = tuple["DatasetSpec", "Location | Parts"]
"""A dataset: how it is read, and where it lies."""

Unopened = tuple["DatasetSpec", None]
"""A dataset whose recordings are not looked at."""


def group_by_dataset(data: Sequence[str]) -> dict[str, dict[str, str]]:
    """{dataset: {name in its files: location}} of the datasets at these locations; several locations are one dataset if
    an entry joins them. Raises NoDatasetError with all locations that are not datasets, another DataError for one that
    cannot be read, ConfigError for two with the same name."""
    places: dict[str, str] = {}
    datasets: dict[str, dict[str, str]] = {}
    for place, name in zip(data, _names_at(data), strict=True):
        require(
            name not in places,
            f"--data: {places.get(name)} and {place} are both the dataset {name!r}, by the name in their files; a "
            "study reads one place per name: leave one out, or give it another name (a LeRobot folder: rename it; a "
            "robomimic file: `hma data convert robomimic FILE --out DIR --name NAME` writes it under that name); then "
            "an entry with `joins` can make one dataset of both",
        )
        places[name] = place
        entry = find_reader(name)
        datasets.setdefault(name if entry is None else entry.name, {})[name] = place
    return datasets


def _names_at(data: Sequence[str]) -> list[str]:
    from data_pipelines.sources.open import source_name

    names: list[str] = []
    refused: list[NoDatasetError] = []
    for place in data:
        try:
            names.append(source_name(place))
        except NoDatasetError as error:
            refused.append(error)
    if len(refused) == 1:
        raise refused[0]
    if refused:
        raise NoDatasetError("\n".join([*map(str, refused), "Leave these out of --data, or correct their paths."]))
    return names


def require_entries(names: Sequence[str], datasets: Mapping[str, Mapping[str, str]]) -> None:
    """Raises ConfigError, with the place of each, for datasets (`group_by_dataset`) that no entry describes."""
    unknown = [
        f"{describe_unknown(name)} It is what the files in {place} call themselves."
        for name in names
        if find_spec(name) is None
        for place in datasets.get(name, {}).values()
    ]
    require(not unknown, "\n".join([*unknown, NEW_DATASET]))


def find_sources(study: Study, data: Sequence[str]) -> list[Source]:
    """User directories with their registry entries. Raises ConfigError for unknown names."""
    datasets = group_by_dataset(data)
    missing = [n for n in study.all_names() if n not in datasets]
    require(not missing, f"no --data directory for {', '.join(missing)}; given: {', '.join(datasets)}")
    return [source_of(name, datasets[name]) for name in study.all_names()]


def source_of(name: str, places: Mapping[str, str]) -> Source:
    """A dataset with its registry entry, limited to those of the joined parts that are given; prints which are not.
    Raises ConfigError for an unknown name."""
    from data_pipelines.sources.joined import Parts
    from data_pipelines.sources.rlds.location import locate

    spec = get_spec(name)
    if not spec.joins:
        return spec, locate(places[name])
    given = tuple(part for part in spec.joins if part in places)
    absent = [part for part in spec.joins if part not in places]
    if absent:
        say(
            f"note: {name} is made of {few(given)} alone: no --data directory for {few(absent)}, which its entry joins too"
        )
    return replace(spec, joins=given), Parts(name, tuple(locate(places[part]) for part in given))


def find_suite(study: Study, workspace: Workspace, advice: str) -> list[Source]:
    """The simulated datasets. Raises ConfigError, with `advice`, if they do not exist."""
    sources = [(get_spec(name), workspace.suite / name) for name in study.all_names()]
    missing = [spec.name for spec, path in sources if not path.is_dir()]
    require(not missing, f"{workspace.suite}: {', '.join(missing)} not simulated yet. {advice}")
    return sources


def check_sources(study: Study, sources: Sequence[Source]) -> dict[str, EpisodeSource]:
    """Opens every dataset, by name, before anything is made from one, which may take hours. Raises ConfigError and
    DataError for whatever tokenising would refuse without reading an episode."""
    from data_pipelines.tokens.tokenize_job import resolve_frame_step

    opened = {}
    for spec, path in sources:
        resolve_frame_step(spec, study.store.frame_step, study.rate)
        opened[spec.name] = open_source((spec, path), study.store)
        opened[spec.name].check_keys(spec.image_key, spec.action_keys, spec.action_dims)
    return opened


def check_entries(study: Study, data: Sequence[str]) -> None:
    """The part of `check_sources` that takes no time, for a dry run: checks that the entries of the user's directories
    fit the fields that their files declare. Prints which rates are not reached. Does not search for RLDS records."""
    from data_pipelines.sources.joined import Parts
    from data_pipelines.sources.open import find_format
    from data_pipelines.sources.rlds.schema import FEATURES, check_fields, read_metadata, resolve_version
    from data_pipelines.tokens.tokenize_job import resolve_frame_step

    sources = find_sources(study, data)
    say_other_versions(sources)
    say_unreached_rates(study, sources)
    say_short_episodes(study, sources)
    for spec, path in sources:
        resolve_frame_step(spec, study.store.frame_step, study.rate)
        keys = (spec.image_key, spec.action_keys, spec.action_dims)
        for place in path.places if isinstance(path, Parts) else (path,):
            if find_format(place) == "rlds":
                version = resolve_version(place)
                split = read_metadata(version, spec.split)
                check_fields(split.name, version / FEATURES, split.features, *keys)
            else:
                open_source((spec, place), study.store).check_keys(*keys)


def say_other_versions(sources: Sequence[Source]) -> None:
    """Names the RLDS datasets whose version is not the one for which their entry was written. If the entry's fields
    exist in the files, nothing else shows that units or conventions have changed."""
    from data_pipelines.sources.joined import Parts
    from data_pipelines.sources.open import find_format
    from data_pipelines.sources.rlds.schema import read_info, resolve_version

    others = []
    for spec, path in sources:
        for place in path.places if isinstance(path, Parts) else (path,):
            if not spec.version or find_format(place) != "rlds":
                continue
            there = read_info(resolve_version(place)).version
            if there != spec.version:
                others.append(f"{spec.name} (files {there}, entry {spec.version})")
    if others:
        say(
            f"note: files of another version than their entry was written for: {few(others)}. Their fields may mean "
            "something else: compare `hma data view`, or give the directory of the entry's version in --data"
        )


def say_unreached_rates(study: Study, sources: Sequence[Source]) -> None:
    """Names the datasets that were recorded at a lower rate than the one at which frames are asked for."""
    asked = ((spec, spec.rate or study.rate) for spec, _ in sources)
    slow = [f"{s.name} ({s.hz:g} Hz, not {rate:g})" for s, rate in asked if rate and rate > s.rate_for(1)]
    if slow:
        say(f"note: a rate above that of the recording is not reached, every frame is taken: {few(slow)}")


def say_short_episodes(study: Study, sources: Sequence[Source]) -> None:
    """Names the datasets of which, according to their files or else their entries, few or no episodes give a window to
    evaluate on. The length of each episode may be known only when it is tokenised, after a tokenizer was trained."""
    from data_pipelines.windows.windows import least_judged, settings_for_short

    least, short, stride = least_judged(study.eval.prompt_frames, study.model.frames), [], 1
    parts = []  # of which the entry describes other episodes
    for spec, _ in sources:
        size, needed = size_of(spec, study.store.held_out), least * spec.stride_at(study.rate)
        steps = size.mean_steps or spec.median_steps or spec.mean_steps
        if 0 < steps < needed:
            short.append(f"{spec.name} (about {round(steps, 1):,g} steps an episode; {needed:,} are needed)")
            stride = max(stride, spec.stride_at(study.rate))
            if not size.mean_steps and spec.episodes not in (0, size.episodes):
                parts.append(spec.name)
    if short:
        settings = settings_for_short(stride, least)
        advice = f". To use them, set {settings}" if settings else ""
        doubt = (
            f". The entry of {few(parts)} is of other episodes: `hma data inspect DIR` measures yours" if parts else ""
        )
        say(
            "note: by what files and entries say, many or all episodes are too short for a window to evaluate on: "
            f"{few(short)}{advice}{doubt}"
        )


def open_source(source: Source, settings: StoreConfig) -> EpisodeSource:
    """Opens a dataset. Raises DataError for damage that `settings` do not allow."""
    from data_pipelines.sources import open as sources

    spec, path = source
    return sources.open_source(path, spec.split, corrupt=settings.corrupt, max_skipped=settings.max_skipped)
