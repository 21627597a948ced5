"""Question: how long does a learned simulator stay correct?
Command: python -m experiments.applications.endurance RUN --minutes 10 --out DIR
Cost: ten minutes of eight robots, half an hour of one core for each variant.
Expected: the robot is where its commands put it for as long as it is driven; objects and PSNR are lost earlier.

Each variant's measures are a file under DIR/films, made once: the same command continues where it was stopped, even in
the middle of a film. Writes DIR/endurance.csv (a row per variant, drive, robot and minute), its curves and, for every
variant, a sheet of frames with the truth above. A detector is needed (experiments.applications.detector).
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from data_pipelines.suite.simulator import SPECS
from experiments.applications.detector import COMMITTED, WEIGHTS, Detector, select_robots
from experiments.applications.endurance.drives import Kind, make_drive, native_robots
from experiments.applications.endurance.figures import draw_curves, draw_sheet, shown_frames
from experiments.applications.endurance.films import load_films, make_films, save_films
from experiments.applications.endurance.settings import pin_name
from experiments.applications.endurance.tables import Row, over_robots, rows_of
from experiments.running.run_options import UNSET
from experiments.running.workspace import Workspace
from experiments.simulators import load_simulator
from experiments.tables import write_rows
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.progress import console, step, wrote
from hma_jax.config import ExecutionConfig, require
from hma_jax.config.base import require_choice
from hma_jax.simulator.folder import change_decode, find_decode
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

VARIANTS: dict[str, dict[str, Any]] = {
    "shipped": {},
    "streaming": {"slide": "streaming"},
    "likeliest": {"temperature": 0.0},
    "temperature_0.4": {"temperature": 0.4},
    "temperature_1": {"temperature": 1.0},
    "confidence": {"order": "confidence"},
    "steps_2": {"unmask_steps": 2},
    "steps_16": {"unmask_steps": 16},
}
"""Changes of the decoding settings in RUN/decode.json."""

TABLE = "endurance.csv"
PRINTED = (
    "psnr", "psnr_still", "tool_found", "tool_close", "object_found", "object_close", "follows", "moves",
    "steers", "true_follows", "true_steers", "true_tool_close", "true_object_close", "histogram",
)  # fmt: skip
"""The measures that the command prints; the table has all."""


def film_path(
    out: Path, name: str, variant: str, kind: Kind, minutes: float, which: int, robots: Sequence[str]
) -> Path:
    """`robots`: those that were asked for; empty if all robots of the run are filmed."""
    return out / "films" / f"{'-'.join([name, variant, kind, f'{minutes:g}', str(which), *robots])}.npz"


def true_starts_of(simulator: Simulator, robots: Mapping[str, Robot], count: int) -> dict[str, list[Start]]:
    """The first `count` starts of each robot at which the true simulator can begin. Raises ConfigError if there are
    fewer."""
    found = {n: [s for s in simulator.starts if s.robot == n and s.seed is not None][:count] for n in robots}
    for name, starts in found.items():
        require(
            len(starts) == count,
            f"--starts {count}: {name} has only {len(starts)} starts that the true simulator supports; give fewer",
        )
    return found


def load_variant(run: Path, variant: str, robots: int) -> Simulator:
    """The simulator of `run` with the decoding settings of a variant, for this number of robots in one batch."""
    decode = change_decode(find_decode(run), **VARIANTS[variant])
    return load_simulator(run, execution=ExecutionConfig(remat="none"), episodes=robots, decode=decode, history=1)


def drive_run(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/endurance"),
    minutes: float = 10.0,
    starts: int = 1,
    robots: Annotated[tuple[str, ...], arg(metavar="NAME ..."), UNSET] = (),
    variants: Annotated[tuple[str, ...], arg(metavar="NAME ...")] = ("shipped",),
    drives: tuple[Kind, ...] = ("behaviour",),
    every: Annotated[float, arg(metavar="SECONDS")] = 60.0,
    name: str = "model",
    table: Annotated[str, arg(metavar="FILE")] = TABLE,
    detector: Annotated[Path, arg(metavar="FILE")] = COMMITTED / WEIGHTS,
) -> None:
    """Drives the robots of a run for minutes, and measures the frames.

    Args:
        run: Directory of a training run.
        out: Directory for everything that is written.
        minutes: Simulated time of a film.
        starts: Number of starts of each robot, each with a film of its own.
        robots: Only these robots; without it all robots of the run that the suite can simulate.
        variants: Changes of the decoding: shipped (none), streaming (keys and values of past frames are kept),
            likeliest (greedy decoding), temperature_0.4, temperature_1, confidence (the most confident tokens are
            unmasked first), steps_2, steps_16 (unmasking steps per frame).
        drives: What the robots are told. behaviour: as in their data, restarted every 12 s. extremes: one action value
            after the other stays at an end of its range for 2 s. alternation: all values jump from end to end every
            frame.
        every: Seconds of simulated time in a row of the table.
        name: Name of the run, in the table and in names of files.
        table: Name of the table in --out; the curves have the same name.
        detector: Detector of tools and objects, as `python -m experiments.applications.detector` writes it.
    """
    require(minutes > 0, f"--minutes must be positive, got {minutes:g}")
    require(starts >= 1, f"--starts must be at least 1, got {starts}")
    require(bool(variants and drives), "--variants and --drives need at least one name")
    for variant in variants:
        require_choice(variant, tuple(VARIANTS), "--variants")
    require(
        0 < every < 120 * minutes,
        f"--every {every:g}: a row of the table needs at least half as many seconds, but --minutes "
        f"{minutes:g} are {60 * minutes:g}; give a smaller --every",
    )
    with Workspace(out).locked(f".{name}.lock"):  # others may drive other models into the same directory
        finder, simulator, rows = Detector.load(detector), load_simulator(run), []
        driven = select_robots(native_robots(simulator.robots), robots)
        begins = true_starts_of(simulator, driven, starts)
        pin_name(out, name, run, simulator, detector)
        for kind, variant in itertools.product(drives, variants):
            new: list[Row] = []
            for which in range(starts):
                path = film_path(out, name, variant, kind, minutes, which, robots)
                unfinished = path.with_name(f"{path.name}.unfinished")
                if not path.exists():
                    with step(f"{variant}, {kind}, {minutes:g} min, start {which}") as update:
                        told = [
                            make_drive(robot, begins[key][which], round(60 * minutes * robot.hz), kind, which)
                            for key, robot in driven.items()
                        ]
                        filmed = load_variant(run, variant, len(driven))
                        save_films(make_films(filmed, finder, told, unfinished, update), path)
                unfinished.unlink(missing_ok=True)
                films = load_films(path)
                hz = {key: SPECS[key].hz for key in films}
                tools = {key: len(SPECS[key].body.tools) for key in films}
                new += rows_of(f"{name}/{variant}", kind, which, films, hz, tools, every)
            print_rows(new)
            rows += new
            draw_sheet(films, out / f"{'-'.join([name, variant, kind, *robots])}.png")
            console.print(f"columns: frames {', '.join(map(str, shown_frames(films)))}", soft_wrap=True)
        curves = (out / table).with_suffix(".png")
        write_rows(out / table, rows)
        draw_curves([row for row in rows if row["drive"] == drives[0]], curves)
        wrote(out / table, curves)


def main() -> None:
    run_module(drive_run, __doc__)


def print_rows(rows: list[Row]) -> None:
    """Means over robots of the first part, the last one, and some between."""
    parts = sorted({row["part"] for row in rows})
    for part in dict.fromkeys([parts[0], parts[len(parts) // 2], parts[-1]]):
        own = [row for row in rows if row["part"] == part]
        means = {name: over_robots(own, name) for name in PRINTED}
        texts = [f"{name} {mean:.3f}±{half:.3f}" if n else f"{name} –" for name, (mean, half, n) in means.items()]
        console.print(f"{own[0]['variant']} {own[0]['drive']} part {part}: " + ", ".join(texts), soft_wrap=True)


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
