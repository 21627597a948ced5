"""What to run after looking at data: the command that reads the data as counted here, or why there is none yet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from data_pipelines.registry import find_reader
from experiments.presets import ON_ACCELERATORS, get_preset
from experiments.running.workspace import Workspace
from experiments.study_setup import Preset, StudyArguments, command
from experiments.terminal.program import PROGRAM
from experiments.terminal.progress import say

if TYPE_CHECKING:
    from data_pipelines.inspection.inspect import Facts


ENTRIES = "my_robots.toml"
"""Where entries are written if there is no file of entries yet: a command takes only one such file."""


def say_next(
    datasets: Sequence[Facts], frames: int, registry: Path | None, longest: int, rate: float | None = None
) -> None:
    """Prints the command that tokenises `datasets`, with the default preset and with the preset for a GPU or TPU, or
    what to do first. The other arguments are those of `tokenize_command`."""
    if first := single_episode(datasets):
        print_next(first)
        return
    default = StudyArguments.preset
    for preset, when in ((default, "next"), (ON_ACCELERATORS[default], "or, on a GPU or TPU")):
        words = tokenize_command(preset, datasets, frames, registry, longest, rate)
        say(f"{when}: {words}")


def tokenize_command(
    preset_name: Preset,
    datasets: Sequence[Facts],
    frames: int,
    registry: Path | None,
    longest: int,
    rate: float | None,
) -> str:
    """The command that tokenises datasets for windows of `frames`, without the episodes that cannot be read.

    `longest`: frames of the longest episode at that rate; the prompt is short enough to leave one of them to evaluate.
    `rate`: frames per second, if it is not the preset's.
    """
    preset = get_preset(preset_name)
    changes: dict[str, object] = {}
    if frames != preset.model.frames:
        changes["model.frames"] = frames
    prompt = preset.eval.prompt_frames if frames > preset.eval.prompt_frames else frames // 2
    prompt = max(min(prompt, longest - 1), 1)
    if prompt != preset.eval.prompt_frames:
        changes["eval.prompt_frames"] = prompt
    if rate is not None:
        changes["rate"] = f"{rate:g}"
    if any(map(_unusable, datasets)):
        changes["store.corrupt"] = "skip"
        if limit := _more_skipped(datasets, preset.store.max_skipped):
            changes["store.max_skipped"] = limit
    settings = tuple(f"{name}={value}" for name, value in changes.items())
    arguments = StudyArguments(
        preset_name, data=tuple(facts.directory for facts in datasets), registry=registry, set=settings
    ).anywhere()
    if out := _another_out(arguments.out, [facts.name for facts in datasets]):
        arguments = replace(arguments, out=out)
    return command("tokenize", *arguments.words())


def _unusable(facts: Facts) -> int:
    """Sampled episodes that tokenising refuses: those that cannot be read, those whose actions (as read by the entry)
    are not all finite, and those without all frames of the entry's camera."""
    from data_pipelines.inspection.issues import chosen_actions

    entry = find_reader(facts.name)
    fields = chosen_actions(facts, entry)
    broken = {episode for field in fields for value in field.dimensions for episode in value.broken}
    lacking = sum(c.undecodable for c in facts.cameras if entry is not None and c.key == entry.image_key)
    return sum(facts.damaged.values()) + len(broken) + lacking


def _more_skipped(datasets: Sequence[Facts], allowed: float) -> float | None:
    """`store.max_skipped` for datasets with more unusable episodes than are `allowed`: their number, if all episodes
    were read, or else twice the share of those that were; None if no dataset has more."""
    if all(facts.sampled + sum(facts.damaged.values()) >= facts.episodes for facts in datasets):
        return damaged if (damaged := max(map(_unusable, datasets))) > allowed else None
    shares = [_unusable(facts) / (facts.sampled + sum(facts.damaged.values())) for facts in datasets]
    if all(2 * share * facts.episodes <= allowed for share, facts in zip(shares, datasets, strict=True)):
        return None
    return min(math.ceil(200 * max(shares)) / 100, 0.99)


def _another_out(default: Path, names: Sequence[str]) -> Path | None:
    """Where to tokenise datasets if the `default` directory has tokens of other datasets, for which a command there
    would be refused; None if it has none."""
    from data_pipelines.tokens.manifest import FILE

    asked = {name if (known := find_reader(name)) is None else known.name for name in names}
    there = {path.parent.name for path in Workspace(default).store.glob(f"*/{FILE}")}
    return default.with_name(f"{default.name}_{min(asked)}") if there - asked else None


def print_next(words: str, name: str = "") -> None:
    """Prints the next command, for the dataset `name` if there are several; advice that is not a command is printed as
    a note."""
    label = "next" if words.startswith(f"{PROGRAM} ") else "note"
    say(f"{label}{name and f' for {name}'}: {words}")


def single_episode(directories: Sequence[Facts]) -> str | None:
    """What to do if all datasets together have a single episode, so that none can be held out; else None."""
    if sum(facts.episodes for facts in directories) != 1 or len(directories[0].splits) > 1:
        return None
    return (
        "add another dataset (hma tokenize --data DIR OTHER), or record more: a single episode cannot be held out, "
        "so no model can be evaluated on it"
    )


def no_window(facts: Facts, stride: int, registry: Path | None) -> str:
    """What to run instead for a dataset in which no episode has two frames at `stride`, and why."""
    longest, known = facts.lengths.longest, (("--registry", registry) if registry else ())
    if longest < 2:
        return "leave it out: no episode has more than one step, so there is no motion to learn"
    words = command("data view", facts.directory, "--stride", "1", *known)
    return (
        f"{words}  # the shortest window at stride {stride} needs {2 * stride} steps, the longest episode that was read has "
        f"{longest}: use every frame, or correct the rate with --hz"
    )


def other_rate(facts: Facts, hz: float | None, registry: Path | None) -> str | None:
    """What to run first if a known dataset was read with a native rate other than its entry's, which a study uses; None
    if the two agree."""
    from data_pipelines.sources.source import same_rate

    known = find_reader(facts.name)
    if known is None or hz is None or same_rate(known.hz, hz):
        return None
    if known.joins:
        return f"correct hz in the entry of {known.name}, by which a study reads this at {known.hz:g} Hz, not {hz:g}"
    words = command("data inspect", facts.directory, "--hz", f"{hz:g}", "--entry", registry or ENTRIES)
    return f"{words}  # its entry says {known.hz:g} Hz, which a study uses, not {hz:g}; this writes another entry"
