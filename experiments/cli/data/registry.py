"""`hma data list` and `hma data inspect`: the registry, and what lies in a directory."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.markup import escape
from rich.measure import Measurement
from rich.padding import Padding
from tyro.conf import Positional, arg

from data_pipelines.errors import MAX_LISTED
from data_pipelines.publishing.output_lock import lock_output
from data_pipelines.registry import MIXTURES, DatasetSpec, all_specs, get_mixture, known_groups
from data_pipelines.registry.spec import FRAME_RATE, stride_of
from data_pipelines.registry.table import find_reader
from experiments.cli.data.next_command import no_window, other_rate, print_next, say_next
from experiments.study_setup import UNSET, say_unmatched, use_entries
from experiments.terminal.progress import console, say, step, tidy_table, wrote
from experiments.terminal.words import few
from hma_jax.config import ConfigError, require
from hma_jax.config.json import diff, to_strict_json
from hma_jax.runtime.files import write_file
from hma_jax.runtime.outputs import make_directory

if TYPE_CHECKING:
    from data_pipelines.inspection.inspect import Facts
    from data_pipelines.inspection.suggest import Suggestion, WindowFacts

SHEET = "contact_sheet.png"

WIDE = 10_000
"""Terminal columns that every table fits into."""


def data_list(
    words: Annotated[Positional[tuple[str, ...]], arg(metavar="[WORD ...]"), UNSET] = (),
    mixture: Annotated[str | None, UNSET] = None,
    registry: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
) -> None:
    """List the datasets that the registry knows: camera, action size, rate.

    Args:
        words: List only entries with all these words in name, note, camera or group ("open-x", "franka").
        mixture: List only the datasets of this mixture: dataset5, 10, 20, 30, 40, dataset40_published or dataset30_vae.
        registry: TOML file with your own registry entries.
    """
    use_entries(registry)
    chosen = get_mixture(mixture) if mixture else None
    shown = 0
    for title, specs in known_groups().items():
        found = [s for s in specs if _fits(s, title, words) and (chosen is None or s.name in chosen)]
        shown += len(found)
        if found:
            table = _table_of(title, found)
            whole = Measurement.get(console, console.options.update_width(WIDE), table).minimum
            if whole <= console.width:
                console.print(table)
            else:
                _print_list(title, found)
    if not shown:
        raise ConfigError(f"no entry contains {' and '.join(map(repr, words))}; `hma data list` shows all")
    console.print(
        f"{shown} entries. steps: median per episode; ~: mean; ?: unknown. "
        "*: no public source confirms what follows. Mixtures: "
        f"{', '.join(MIXTURES)} (--mixture). For your own dataset add an entry; "
        "`hma data inspect DIR` suggests it."
    )


def _fits(spec: DatasetSpec, title: str, words: Sequence[str]) -> bool:
    text = f"{spec.name} {spec.note} {spec.camera} {title}".lower()
    return all(word.lower() in text for word in words)


def _print_list(title: str, specs: Sequence[DatasetSpec]) -> None:
    """What `_table_of` shows, for names too long for it: as names of directories they are never broken."""
    console.print(f"[italic]{escape(title)}[/]")
    for spec in specs:
        cells = _cells(spec)
        numbers = f"{cells[1]} dims, {cells[2]} Hz, stride {cells[3]}, {cells[4]} episodes of {cells[5]} steps"
        console.print(f"[bold]{escape(spec.name)}[/]", soft_wrap=True)
        console.print(Padding(f"{numbers}, {'; '.join(filter(None, cells[6:]))}", (0, 0, 0, 4)))
    console.print()


def _cells(spec: DatasetSpec) -> tuple[str, ...]:
    unsure = f" [dim]* {escape(spec.unverified)}[/]" if spec.unverified else ""
    joins = f"joins {few(spec.joins)}" if spec.joins else ""
    return (
        spec.name,
        f"{spec.action_dim}",
        f"{spec.hz:g}",
        f"{spec.stride}",
        f"{spec.episodes:,}" if spec.episodes else "?",
        f"{spec.median_steps:g}" if spec.median_steps else f"~{spec.mean_steps:g}" if spec.mean_steps else "?",
        spec.image_key.removeprefix("observation/"),
        escape(", ".join(filter(None, (spec.note, joins)))) + unsure,
    )


def _table_of(title: str, specs: Sequence[DatasetSpec]):
    table = tidy_table(title, "name", "dims", "Hz", "stride", "episodes", "steps")
    table.add_column("image", overflow="fold")
    table.add_column("what it is", min_width=30)
    for spec in specs:
        table.add_row(*_cells(spec))
    return table


def data_inspect(
    directory: Annotated[Positional[str], arg(metavar="DATASET")],
    hz: Annotated[float | None, UNSET] = None,
    split: str = "train",
    out: Annotated[Path | None, arg(metavar="DIR"), UNSET] = None,
    episodes: int = 32,
    frames: int = 12,
    json: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
    entry: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
    registry: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
) -> None:
    """Print what a dataset contains, draw a contact sheet, and suggest its registry entry.

    Args:
        directory: The dataset: an RLDS directory (<name> or <name>/<version>, a path or URL), the root of a
            LeRobot dataset, or a robomimic .hdf5 file.
        hz: Native frames per second, if the files do not contain it (files of LeRobot and robomimic contain it, and so
            does everything that was converted, generated or played here).
        split: The split to read.
        out: Directory for contact_sheet.png. Default: runs/inspect/NAME.
        episodes: Number of episodes to read, drawn at random; fewer if they have more than 2 GB in all.
        frames: Frames of the model's window, to count windows.
        json: JSON file to write everything to.
        entry: TOML file to add the suggested entry to, for --registry.
        registry: TOML file with your own registry entries.
    """
    from data_pipelines.inspection.inspect import inspect_dataset
    from data_pipelines.inspection.suggest import NO_CAMERA, require_own_rate, suggest_entry
    from data_pipelines.sources.rlds.location import locate
    from experiments.cli.data.contact_sheet import write_sheet
    from experiments.preparing.sources import say_other_versions

    require(hz is None or 0 < hz < math.inf, f"--hz must be positive and finite, got {hz}")
    stride_of(hz or 1, FRAME_RATE)  # raises before the dataset is read
    require(episodes >= 1, f"--episodes must be at least 1, got {episodes}")
    require(frames >= 2, f"--frames must be at least 2, got {frames}: a window is a first frame and what follows")
    own = {spec.name: spec for spec in all_specs()}  # the project's entry, before the user's may replace it
    use_entries(registry)
    sheets = Path("runs") / "inspect"
    make_directory(out or sheets)
    for option, file in (("--json", json), ("--entry", entry)):
        if file is not None:
            make_directory(file.parent, option)
    with step(f"read {directory}"):
        sample = inspect_dataset(directory, split, episodes=episodes)
    facts = sample.facts
    known = find_reader(facts.name)
    say_unmatched(registry, (facts.name,))
    suggested = hz or facts.hz or (known.hz if known else None)
    suggestion = suggest_entry(facts, suggested)
    print_facts(facts)
    if entry is not None:
        require(suggestion is not None, f"{facts.name}: no entry to write: {NO_CAMERA}")
        require(bool(suggestion.hz), "--entry needs the native rate, which the files do not contain: add --hz")
    taken = None if entry else known  # as the dataset is read afterwards
    if not hz and not taken:
        require_own_rate(facts)
    rate = hz or (taken.hz if taken else suggested)
    windows = _report_windows(facts, rate, hz, taken, frames) if rate else None
    _print_entry(known, suggestion)
    sheet = (out or sheets / facts.name) / SHEET
    sheet.parent.mkdir(exist_ok=True)
    write_sheet(sheet, sample)
    wrote(sheet)
    if json is not None:
        values = dataclasses.asdict(facts) | {"suggestion": suggestion and dataclasses.asdict(suggestion)}
        write_file(json, to_strict_json(values))
        wrote(json)
    if entry is not None:
        _write_entry(entry, suggestion)
        _say_displaced(own.get(facts.name), suggestion.spec(), entry)
    _say_other_rate(facts, hz)
    if taken is not None:
        say_other_versions([(taken, locate(directory))])
    if known is not None or entry is not None:
        _say_next(facts, windows, entry or registry, other_rate(facts, rate, registry) if taken else None)


def _report_windows(facts: Facts, rate: float, hz: float | None, taken: DatasetSpec | None, frames: int) -> WindowFacts:
    """Prints the stride of frames at a native `rate`, and the number of windows. `hz`: the rate given by the user;
    `taken`: the registry entry by which the dataset will be read."""
    from data_pipelines.inspection.suggest import window_facts
    from data_pipelines.sources.source import same_rate

    stride = dataclasses.replace(taken, hz=rate).stride if taken else stride_of(rate, FRAME_RATE)
    windows = window_facts(facts, stride, frames)
    source = "" if hz or not taken else " (registry)"
    if facts.hz is not None and not same_rate(facts.hz, rate):
        source += f", although its files say {facts.hz:g}"
    console.print(
        f"[bold]rate[/] {rate:g} Hz{source}: stride {stride}, "
        f"{rate / stride:.2f} Hz; a full window of {frames} frames needs {windows.native} steps, the shortest "
        f"window {windows.needed}; {windows.long_enough} of {facts.sampled} sampled episodes are long enough for the "
        f"shortest; about {windows.total:,.0f} windows in the split"
    )
    return windows


def print_facts(facts: Facts) -> None:
    """Schema, splits, lengths, cameras and actions as tables."""
    sampled = "all" if facts.sampled == facts.episodes else f"{facts.sampled} of {facts.episodes:,}"
    console.print(
        f"[bold]{escape(facts.name)}[/] {facts.version}  {escape(facts.directory)}\n"
        f"read {sampled} episodes of split {facts.split!r} ({facts.bytes_read / 1e6:,.1f} MB"
        f"{', the most that is read' if facts.stopped else ''})",
        soft_wrap=True,
    )
    damaged = list(facts.damaged.items())
    for reason, count in damaged[:MAX_LISTED]:
        console.print(f"[yellow]damaged[/] {count} episode(s): {escape(reason)}", soft_wrap=True)
    if rest := sum(count for _, count in damaged[MAX_LISTED:]):
        console.print(f"[yellow]damaged[/] {rest:,} more episode(s): --json FILE lists all", soft_wrap=True)
    for c in facts.cameras:
        if c.undecodable:
            text = f"{c.key} in {c.undecodable} of {facts.sampled} episodes, the first: {c.reason}"
            console.print(f"[yellow]missing or broken frames[/] {escape(text)}", soft_wrap=True)
    splits = tidy_table("Splits", "split", "episodes", "shards", "MB")
    for s in facts.splits:
        splits.add_row(s.name, f"{s.episodes:,}", f"{s.shards:,}", f"{s.bytes / 1e6:,.1f}")
    console.print(splits)
    n = facts.lengths
    console.print(
        f"[bold]steps per episode[/] {n.shortest} to {n.longest}, median {n.median:g}, "
        f"80 % between {n.lower:g} and {n.upper:g}, mean {n.mean:.1f}"
    )
    schema = tidy_table("Fields", "field", "kind", "shape", "type")
    for f in facts.fields:
        shape = "x".join("?" if d is None else str(d) for d in f.shape)
        schema.add_row(escape(f.key), f.kind, shape or "one", f.dtype)
    console.print(schema)
    cameras = tidy_table("Cameras", "camera", "height x width", "frames seen", "blank")
    cameras.add_column("remark")
    for c in facts.cameras:
        sizes = ", ".join(f"{h}x{w}" for h, w in c.sizes)
        remark = "blank: one colour only" if c.is_blank else "image never changes" if c.still else ""
        remark = remark if c.frames else "cannot be decoded"
        cameras.add_row(escape(c.key), sizes, f"{c.frames}", f"{c.blank}", remark)
    console.print(cameras)
    for action in facts.actions:
        table = tidy_table(escape(action.key), "value", "min", "max", "mean", "std", "distinct", "roughness")
        table.add_column("looks like")
        for i, d in enumerate(action.dimensions):
            bad = f"[red]{d.not_finite} not finite[/] " if d.not_finite else ""
            distinct = f"{d.distinct}" if d.distinct < 100 else "100+"
            numbers = (f"{v:.4g}" for v in (d.minimum, d.maximum, d.mean, d.std))
            table.add_row(f"{i}", *numbers, distinct, f"{d.smoothness:.2f}", bad + d.hint)
        console.print(table)


def _print_entry(known: DatasetSpec | None, suggestion: Suggestion | None) -> None:
    from data_pipelines.inspection.suggest import NO_CAMERA

    if suggestion is None:
        console.print(f"[yellow]no entry[/]: {NO_CAMERA}", soft_wrap=True)
        return
    if known is None:
        console.print("[bold]not in the registry.[/] Suggested entry:")
    else:
        same = (known.image_key, known.action_keys, known.action_dims)
        fits = same == (suggestion.image_key, suggestion.action_keys, suggestion.action_dims)
        fits &= set(suggestion.angles) <= set(known.angles) and suggestion.hz == known.hz
        fits &= not suggestion.angles or suggestion.angle_unit == known.angle_unit
        agrees = "; this agrees with its contents" if fits else ". Its contents suggest another entry:"
        console.print(f"[bold]in the registry[/]: {escape(_in_words(known))}{agrees}", soft_wrap=True)
        if fits:
            return
    for reason in suggestion.reasons:
        say(f"  {reason}")
    say(suggestion.table())
    say("Write it to a file with --entry FILE.toml, and give that file to other commands with --registry.")


def _in_words(spec: DatasetSpec) -> str:
    action = " + ".join(spec.action_keys) or "no action"
    part = f"as a part of {spec.name}, " if spec.joins else ""
    return f"{part}{spec.image_key}, {action} ({spec.action_dim}), {spec.hz:g} Hz"


def _write_entry(path: Path, suggestion: Suggestion) -> None:
    """Adds the entry to a TOML file. Replaces an entry of the same name, and prints how the two differ."""
    from data_pipelines.registry.toml_file import load_entries, put_entry

    spec = suggestion.spec()
    with lock_output(path, wait=math.inf):  # another process may add its own at the same moment
        old = [entry for entry in load_entries(path) if entry.name == spec.name] if path.exists() else []
        if old == [spec]:  # its comments and its order stay
            say(f"unchanged: {path} has this entry of {spec.name}")
            return
        write_file(path, put_entry(path.read_text(encoding="utf-8") if path.exists() else "", spec, str(path)))
    wrote(path)
    if lines := [line for entry in old for line in diff(entry, spec)]:
        text = f"note: this replaced the file's entry of {spec.name} (old -> new): {'; '.join(lines)}"
        say(text)


def _say_displaced(own: DatasetSpec | None, spec: DatasetSpec, path: Path) -> None:
    """Prints how the entry `spec`, which is now in the file at `path`, differs from the project's `own`."""
    if own is not None and (lines := diff(own.facts(), spec.facts())):
        say(
            f"note: this takes the place of the project's entry of {own.name}, in commands with --registry {path} (there "
            f"-> here): {'; '.join(lines)}; to keep that, remove it from {path}"
        )


def _say_other_rate(facts: Facts, hz: float | None) -> None:
    """Prints that the user's rate replaces that of the files. Either may be right: files may be wrong, and a model is
    trained at the rate that the user gave for its robot."""
    from data_pipelines.sources.source import same_rate

    if hz is not None and facts.hz is not None and not same_rate(hz, facts.hz):
        say(
            f"note: --hz {hz:g} is used, although the dataset's own files say {facts.hz:g} Hz; if they are right, run this "
            "again without --hz"
        )


def _say_next(facts: Facts, windows: WindowFacts | None, entries: Path | None, first: str | None) -> None:
    """Prints the command that reads the dataset as counted here, or what to try if nothing can be read. `first`: what
    must be run before that."""
    if windows is None:
        return
    if windows.total and not first:
        say_next([facts], windows.frames, entries, facts.lengths.longest // windows.stride)
    else:
        print_next(first or no_window(facts, windows.stride, entries))
