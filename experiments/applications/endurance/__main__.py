"""Question: how long does a learned simulator stay correct?
Command: python -m experiments.applications.endurance RUN --minutes 10 --out DIR
Cost: ten minutes of eight robots, half an hour of one core for each variant.
Expected: the robot is where its commands put it for as long as it is driven; objects and PSNR are lost earlier.

Each variant's measures are a file under DIR/films, made once: the same command continues where it was stopped, even in
the middle of a film. Writes DIR/endurance.csv (a row per variant, drive, robot and minute), its curves and, for every
variant, a sheet of frames with the truth above. A detector is needed (experiments.applications.detector).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from data_pipelines.suite.simulator import SPECS
from experiments.applications.detector import COMMITTED, WEIGHTS, Detector, select_robots
from experiments.applications.endurance.drives import Kind, make_drive, native_robots
from experiments.applications.endurance.figures import draw_curves, draw_sheet, shown_frames
from experiments.applications.endurance.films import load_films, make_films, save_films
from experiments.applications.endurance.settings import pin_name
from experiments.applications.endurance.tables import Row, over_robots, rows_of
from experiments.applications.simulators import load_simulator
from experiments.applications.tables import write_rows
from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.progress import console, step, wrote
from hma_jax.config import ExecutionConfig, require
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

KINDS: tuple[Kind, ...] = ("behaviour", "extremes", "alternation")
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs/endurance"))
    parser.add_argument("--minutes", type=float, default=10.0, help="of simulated time")
    parser.add_argument("--starts", type=int, default=1, help="of each robot")
    parser.add_argument("--robots", nargs="+", default=[], metavar="ROBOT", help="only these of the run")
    parser.add_argument("--variants", nargs="+", default=["shipped"], choices=list(VARIANTS), metavar="NAME")
    parser.add_argument("--drives", nargs="+", default=["behaviour"], choices=KINDS)
    parser.add_argument("--every", type=float, default=60.0, help="seconds per row of the table")
    parser.add_argument("--name", default="model", help="of the run, in file names and the table")
    parser.add_argument("--table", default=TABLE, help="file in DIR; curves of the same name")
    parser.add_argument("--detector", type=Path, default=COMMITTED / WEIGHTS)
    args = parser.parse_args()
    require(args.minutes > 0, f"--minutes must be positive, got {args.minutes:g}")
    require(args.starts >= 1, f"--starts must be at least 1, got {args.starts}")
    require(
        0 < args.every < 120 * args.minutes,
        f"--every {args.every:g}: a row of the table needs at least half as many seconds, but --minutes "
        f"{args.minutes:g} are {60 * args.minutes:g}; give a smaller --every",
    )
    detector, simulator, rows = Detector.load(args.detector), load_simulator(args.run), []
    robots = select_robots(native_robots(simulator.robots), args.robots)
    starts = true_starts_of(simulator, robots, args.starts)
    pin_name(args.out, args.name, args.run, simulator, args.detector)
    for kind in args.drives:
        for variant in args.variants:
            new: list[Row] = []
            for which in range(args.starts):
                path = film_path(args.out, args.name, variant, kind, args.minutes, which, args.robots)
                unfinished = path.with_name(f"{path.name}.unfinished")
                if not path.exists():
                    with step(f"{variant}, {kind}, {args.minutes:g} min, start {which}") as update:
                        drives = [
                            make_drive(robot, starts[name][which], round(60 * args.minutes * robot.hz), kind, which)
                            for name, robot in robots.items()
                        ]
                        filmed = load_variant(args.run, variant, len(robots))
                        save_films(make_films(filmed, detector, drives, unfinished, update), path)
                unfinished.unlink(missing_ok=True)
                films = load_films(path)
                hz = {name: SPECS[name].hz for name in films}
                tools = {name: len(SPECS[name].body.tools) for name in films}
                new += rows_of(f"{args.name}/{variant}", kind, which, films, hz, tools, args.every)
            print_rows(new)
            rows += new
            draw_sheet(films, args.out / f"{'-'.join([args.name, variant, kind, *args.robots])}.png")
            console.print(f"columns: frames {', '.join(map(str, shown_frames(films)))}", soft_wrap=True)
    table, curves = args.out / args.table, (args.out / args.table).with_suffix(".png")
    write_rows(table, rows)
    draw_curves([row for row in rows if row["drive"] == args.drives[0]], curves)
    wrote(table, curves)


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
