"""`hma data sim` and `hma data sim-table`: arguments and help. The work is in `commands.sim`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from experiments.commands import sim as sim_commands

SimPreset = Literal["smoke", "full"]


def data_sim(
    out: Path,
    preset: SimPreset = "smoke",
    names: Annotated[tuple[str, ...], arg(metavar="[NAME ...]")] = (),
    episodes: int | None = None,
    size: int | None = None,
    workers: int = 2,
    seed: int = 0,
) -> None:
    """Simulate real robots' models (MuJoCo and others) and write them as RLDS directories.

    Needs the extra `sim`. Run the same command again after an interruption: only what is missing
    is made, and the bytes are the same.

    Args:
        out: Directory to write: one dataset per embodiment, and contact sheets.
        preset: smoke (12 embodiments, 4 episodes, 64 pixels: minutes) or full (all of them, 20
            episodes, 128 pixels: hours).
        names: Only these embodiments of the table.
        episodes: Episodes per dataset, instead of the preset's.
        size: Pixels of a frame's side, instead of the preset's.
        workers: Simulators at a time, each a process with one core; no effect on the data.
        seed: Another seed gives other episodes.
    """
    sim_commands.write_sim(out, preset, names, episodes, size, workers, seed)


def data_sim_table(directory: Positional[Path]) -> None:
    """Print frames per second, episode lengths and success rates of `hma data sim`, as Markdown.

    Args:
        directory: What was given as --out.
    """
    sim_commands.print_table(directory)
