"""`hma status`: the progress of a study's trials."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Annotated

from rich.table import Table
from tyro.conf import FlagCreatePairsOff, Positional, arg

from experiments.running.attempts import PROGRESS, State, read_progress, read_start, read_states
from experiments.running.ledger import DIVERGED, FINISHED, MISSING, RUNNING, Ledger
from experiments.running.workspace import LOCK, Workspace, command_at, load_record
from experiments.study_setup import UNSET
from experiments.terminal.progress import console, say, short
from experiments.terminal.words import counted
from hma_jax.config import ConfigError
from hma_jax.runtime.locks import find_held


def status(
    study: Annotated[Positional[Path], arg(metavar="STUDY")],
    everything: Annotated[FlagCreatePairsOff[bool], arg(name="all"), UNSET] = False,
) -> None:
    """Show the progress of a study's trials: which ones run, where, and how those without a result ended.

    Reads only, so the study may be running, on this machine or on others.

    Args:
        study: Directory of a study.
        everything: List finished trials, and those that have not begun, too.
    """
    from experiments.sweeps.registry import plan_sweeps
    from experiments.sweeps.sweep import titles

    workspace = Workspace(study)
    running = find_held(workspace.root / LOCK) if workspace.root.is_dir() else None
    if running and not workspace.record.exists():
        raise ConfigError(f"the study in {short(study)} has no trial yet: {running.who} prepares its data")
    record = load_record(workspace)
    names = titles(plan_sweeps(record.study, record.axes, workspace.root), record.provenance)
    states = read_states(list(names), workspace.trials, Ledger(workspace.ledger))
    counts = Counter(state.event for state in states.values())
    words = {event: event for event in counts} | {MISSING: "not begun"}
    order = [RUNNING, *sorted(counts.keys() - {RUNNING, FINISHED, MISSING})] + [FINISHED, MISSING] * everything
    table = Table("trial", "state", "done", "on", "directory", title=short(study), title_justify="left")
    for event in order:
        for id in (id for id, state in states.items() if state.event == event):
            directory = workspace.trials / id
            where = str(directory.relative_to(workspace.root))
            table.add_row(names[id], words[event], *_place(directory, states[id]), where)
    if table.row_count:
        console.print(table)
    others = [f"{n:,} {words[event]}" for event, n in counts.items() if event != FINISHED]
    console.print(", ".join([f"{counts[FINISHED]:,} of {counted(len(names), 'trial')} finished", *others]))
    for id, state in states.items():
        if state.message:
            say(f"{names[id]}: {state.message}")
    if counts[FINISHED] + counts[DIVERGED] < len(names) and running is None:
        say(f"no command runs it; to go on: {command_at(study, record)}")


def _place(directory: Path, state: State) -> tuple[str, str]:
    """(how far a trial is, where it runs and when it last said so)."""
    progress, start = read_progress(directory), read_start(directory)
    done = f"{progress['phase']} {progress['done']:,} of {progress['total']:,}" if progress else ""
    if state.event != RUNNING or start is None:
        return done, ""
    where = " ".join(filter(None, (start.get("host"), f"job {start['job']}" if "job" in start else "")))
    try:
        seconds = max(time.time() - (directory / PROGRESS).stat().st_mtime, 0)
    except OSError:  # it has just begun, or just ended
        return done, where
    return done, f"{where}, {seconds / 60:.0f} min ago" if seconds >= 60 else where
