"""`hma data view`: reads a part of each dataset, writes one page, and prints the next command."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.markup import escape
from tyro.conf import Positional, arg

from data_pipelines.errors import DataError
from data_pipelines.registry.spec import FRAME_RATE, stride_of
from data_pipelines.registry.table import find_reader
from experiments.cli.data.next_command import ENTRIES, no_window, other_rate, print_next, say_next
from experiments.study_setup import UNSET, command, say_unmatched, use_entries
from experiments.terminal.progress import console, say, step, wrote
from hma_jax.config import require
from hma_jax.runtime.files import write_file
from hma_jax.runtime.outputs import make_directory

if TYPE_CHECKING:
    from data_pipelines.inspection.duplicates import Fingerprint
    from data_pipelines.inspection.inspect import Facts
    from experiments.report.data_page import DatasetView

OTHER_SPLITS = 2
"""Number of splits, besides the one shown, that are searched for the same episodes."""


def view(
    datasets: Annotated[
        Positional[tuple[str, ...]], arg(metavar="DATASET [DATASET ...]", help_behavior_hint="(required)")
    ],
    out: Annotated[Path, arg(metavar="FILE")] = Path("runs/view.html"),
    split: Annotated[str | None, UNSET] = None,
    hz: Annotated[float | None, UNSET] = None,
    stride: Annotated[int | None, UNSET] = None,
    frames: int = 12,
    episodes: int = 64,
    shown: int = 6,
    registry: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
) -> None:
    """Write one HTML page about datasets: clips with their actions, statistics, windows, possible issues.

    Args:
        datasets: RLDS directories (paths or URLs), LeRobot folders, robomimic files.
        out: HTML file to write; it needs no other file.
        split: The split to read. Default: the registry's, or train.
        hz: Native frames per second, if the files and the registry do not contain it, or are wrong.
        stride: Native frames per frame of the model. Default: the stride nearest to 2 Hz.
        frames: Frames of the model's window, to count windows.
        episodes: Number of episodes to read, drawn at random; fewer if they have more than 2 GB in all. Duplicate
            recordings are searched only among these.
        shown: Number of episodes to show.
        registry: TOML file with your own registry entries.
    """
    from experiments.report.data_page import draw_page

    require(hz is None or 0 < hz < math.inf, f"--hz must be positive and finite, got {hz}")
    require(stride is None or stride >= 1, f"--stride must be at least 1, got {stride}")
    require(frames >= 2, f"--frames must be at least 2, got {frames}: a window is a first frame and what follows")
    require(1 <= shown <= episodes, f"--shown must lie between 1 and --episodes {episodes}, got {shown}")
    use_entries(registry)
    make_directory(out.parent)
    viewed = []
    for directory in datasets:
        with step(f"read {directory}"):
            viewed.append(_view_one(directory, split, hz, stride, frames, episodes, shown))
        _say_issues(viewed[-1], episodes)
    say_unmatched(registry, [one.facts.name for one in viewed])
    given = {
        "split": split, "hz": hz and f"{hz:g}", "stride": stride, "frames": frames, "episodes": episodes,
        "shown": shown, "registry": registry,
    }  # fmt: skip
    options = [word for name, value in given.items() if value is not None for word in (f"--{name}", f"{value}")]
    again = command("data view", *datasets, "--out", out, *options)
    write_file(out, draw_page(viewed, frames, again))
    wrote(out)
    _say_next(viewed, frames, registry)


def _view_one(
    directory: str, split: str | None, hz: float | None, stride: int | None, frames: int, episodes: int, shown: int
) -> DatasetView:
    from data_pipelines.inspection.duplicates import find_duplicates
    from data_pipelines.inspection.inspect import inspect_dataset
    from data_pipelines.inspection.issues import find_issues
    from data_pipelines.inspection.suggest import require_own_rate, suggest_entry, window_facts
    from data_pipelines.sources.open import source_name
    from experiments.report.data_page import CLIP_FRAMES, DatasetView

    known = find_reader(source_name(directory))
    split = split or (known.split if known else "train")
    keys = known.action_keys if known else ()
    sample = inspect_dataset(
        directory, split, episodes=episodes, max_examples=shown, frames=CLIP_FRAMES, action_keys=keys
    )
    facts = sample.facts
    if not hz and not known:
        require_own_rate(facts)
    rate = hz or (known.hz if known else facts.hz)
    entry = replace(known, hz=rate) if known else None
    if known is None and rate is not None:
        suggestion = suggest_entry(facts, rate)
        entry = suggestion.spec() if suggestion else None
    usual = entry.stride if entry else stride_of(rate, FRAME_RATE) if rate else None
    stride = (stride or usual) if rate else None
    others = [s.name for s in facts.splits if s.name not in split.split("+") and s.episodes][:OTHER_SPLITS]
    prints = [*sample.fingerprints, *(p for name in others for p in _fingerprints(directory, name, episodes, keys))]
    windows = window_facts(facts, stride, frames) if stride else None
    issues = find_issues(facts, entry, windows, find_duplicates(prints))
    return DatasetView(sample, entry, known is not None, rate, stride, tuple(issues))


def _fingerprints(directory: str, split: str, episodes: int, keys: Sequence[str]) -> Sequence[Fingerprint]:
    """Fingerprints of another split. If it cannot be read, prints a note and returns none: the page is about the split
    that was asked for."""
    from data_pipelines.inspection.inspect import inspect_dataset

    try:
        sample = inspect_dataset(directory, split, episodes=episodes, max_examples=0, frames=2, action_keys=keys)
        return sample.fingerprints
    except DataError as error:
        console.print(f"[yellow]note[/]: split {split!r} was not searched for duplicates: {escape(str(error))}")
        return ()


def _say_issues(viewed: DatasetView, episodes: int) -> None:
    colours = {"error": "red", "warning": "yellow"}
    name = escape(viewed.facts.name)
    if not viewed.issues:
        console.print(f"[bold]{name}[/]: no issues found")
    for issue in viewed.issues:
        title = f"[{colours[issue.severity]}]{issue.title}[/]"
        console.print(f"[bold]{name}[/]: {title}: {escape(issue.text)}", soft_wrap=True)
    f = viewed.facts
    if f.stopped or episodes < f.episodes:  # otherwise every readable episode was read
        say(
            f"note: {f.name}: {f.sampled:,} of {f.episodes:,} episodes were read (--episodes); duplicate recordings are "
            "searched only among these"
        )


def _say_next(viewed: Sequence[DatasetView], frames: int, registry: Path | None) -> None:
    """Prints the commands that read what can be read, one per frame rate, or the commands that are needed first."""
    from data_pipelines.inspection.issues import MISFIT
    from data_pipelines.inspection.suggest import window_facts

    file = registry or ENTRIES
    usable: dict[float | None, list[Facts]] = {}
    longest: dict[float | None, int] = {}
    for v in viewed:
        f = v.facts
        if not f.cameras:
            after = "leave it out, or write it again with its pictures stored as images: it has no camera"
        elif not v.registered:
            native = () if v.hz and v.hz == f.hz else ("--hz", f"{v.hz:g}" if v.hz else "HZ")
            words = command("data inspect", f.directory, *native, "--entry", file)
            after = f"{words}  # it is not in the registry; this writes its entry"
        elif any(r.title == MISFIT for r in v.issues):
            after = f"{command('data inspect', f.directory)}  # it shows what the registry entry should be"
        elif first := other_rate(f, v.hz, registry):
            after = first
        elif not window_facts(f, v.stride, frames).total:
            after = no_window(f, v.stride, registry)
        elif v.stride != v.entry.stride and v.entry.rate is not None:
            after = (
                f"its entry sets rate = {v.entry.rate:g} Hz, so a study reads it at stride {v.entry.stride}, "
                "whatever the study's rate"
            )
        else:
            rate = None if v.stride == v.entry.stride else v.entry.hz / v.stride
            usable.setdefault(rate, []).append(f)
            longest[rate] = min(longest.get(rate, frames), f.lengths.longest // v.stride)
            continue
        print_next(after, f.name)
    for rate, facts in usable.items():
        say_next(facts, frames, registry, longest[rate], rate)
