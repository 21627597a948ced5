"""Question: at the end of a window, are robots and objects where they truly would be?
Command: python -m experiments.applications.in_place RUN --out DIR [--robots NAME ...]
Cost: half an hour of one core for forty robots, most of it the detector, which is made once.
Expected: things that moved are found within 2 pixels (of 32) of their true place in most last frames of a model that
          follows actions, and in almost none of a still picture.

Held-out episodes of every robot that the suite can simulate continue from their first frames to the end of the
model's window, under the recorded actions, in the learned and in the true simulator. Blur costs little PSNR but
much of this share. Writes DIR/in_place.csv, a row for each thing that is seen at the end, and the detector, if it does
not exist yet.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import Positional, arg

from data_pipelines.suite.simulator import SPECS
from data_pipelines.true_simulator import TrueSimulator
from experiments.applications.detector import (
    CLOSE_PX,
    MIN_CONFIDENCE,
    WEIGHTS,
    Detector,
    enlarged,
    make_detector,
    reconstruct,
    select_robots,
    suite_robots,
)  # fmt: skip
from experiments.applications.endurance.tables import Row, over_robots
from experiments.applications.policies.tasks import join
from experiments.applications.scenes import Points, point_names, points_of
from experiments.applications.settings_file import pin_settings
from experiments.running.run_options import UNSET
from experiments.running.workspace import Workspace
from experiments.simulators import START_FRAMES, held_out, load_simulator, true_simulator
from experiments.tables import write_rows
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.progress import console, step, wrote
from hma_jax.config import ExecutionConfig, require
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator

EPISODES = 8
TABLE = "in_place.csv"
VIEWS = ("model", "true", "tokens", "still")
"""The last frames to which the detector is applied: the model's; the true one (misses there are the detector's own
error); the true one reconstructed by the tokenizer (an upper bound for a model of its tokens); and the last frame of
the prompt, which is what copying gives."""


def measure_ends(simulator: Simulator, detector: Detector, robot: Robot) -> list[Row]:
    """A row for each point of a robot that is visible in the true last frame; [] if its episodes are too short.

    `simulator` has `EPISODES` episodes.
    """
    ahead = simulator.model.config.frames - START_FRAMES
    starts, chunks = held_out(robot, simulator.tokenizer.image_size, ahead, EPISODES)
    if not starts:
        return []
    filled = [i % len(starts) for i in range(EPISODES)]  # one program for every robot
    true = true_simulator(simulator, [robot], EPISODES)
    for one in (simulator, true):
        one.reset([starts[i] for i in filled])
    still, prompt_points = true.images.copy(), _points(true, robot, len(starts))
    for t in range(ahead):
        for one in (simulator, true):
            one.step([chunks[i, t] for i in filled])
    end_points = _points(true, robot, len(starts))
    as_tokens = reconstruct(simulator.tokenizer, true.images)
    seen = {"model": simulator.images, "true": true.images, "tokens": as_tokens, "still": still}
    detections = {view: detector.detect(robot.name, enlarged(images[: len(starts)])) for view, images in seen.items()}
    rows = []
    for episode, point in zip(*np.nonzero(end_points.visible), strict=True):
        true_position, prompt_position = end_points.position[episode, point], prompt_points.position[episode, point]
        moved = np.linalg.norm(true_position - prompt_position) if prompt_points.visible[episode, point] else np.nan
        what = point_names(SPECS[robot.name])[point]
        row = {"robot": robot.name, "episode": episode, "what": what, "moved_px": moved}
        for view in VIEWS:
            off = np.linalg.norm(detections[view].position[episode, point] - true_position)
            row |= {f"{view}_px": off, f"{view}_confidence": detections[view].confidence[episode, point]}
        rows.append({name: float(x) if isinstance(x, np.floating) else x for name, x in row.items()})
    return rows


def _points(true: TrueSimulator, robot: Robot, episodes: int) -> Points:
    """The points of the true state of the first `episodes`."""
    state = join([true.state(b) for b in range(episodes)])
    return points_of(SPECS[robot.name], state.seeds, state.q, state.objects)


def in_place(rows: Sequence[Row], view: str) -> tuple[float, float, int]:
    """(share, half-width of its 95 % interval, robots): the share of points that moved by more than `CLOSE_PX` and are
    detected within that distance of their true position; averaged by robot, then over robots (Student's t)."""
    near = [
        {
            "robot": row["robot"],
            "near": float(row[f"{view}_px"]) <= CLOSE_PX and float(row[f"{view}_confidence"]) >= MIN_CONFIDENCE,
        }
        for row in rows
        if float(row["moved_px"]) > CLOSE_PX  # not for things that came into view
    ]
    return over_robots(near, "near")


def measure_run(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/in_place"),
    robots: Annotated[tuple[str, ...], arg(metavar="NAME ..."), UNSET] = (),
) -> None:
    """Measures a run, and trains the detector for it.

    Args:
        run: Directory of a training run.
        out: Directory for the table and the detector.
        robots: Only these robots; without it all robots of the run that the suite can simulate.
    """
    with Workspace(out).locked():
        options = {"execution": ExecutionConfig(remat="none"), "episodes": EPISODES, "history": 1}
        simulator = load_simulator(run, **options)
        chosen, weights = select_robots(suite_robots(simulator.robots), robots), out / WEIGHTS
        settings = {"robots": sorted(chosen)} if robots else {}
        pin_settings(out, run, simulator, settings)  # a detector is trained on frames as one tokenizer shows them
        if not weights.exists():
            make_detector(list(chosen), simulator.tokenizer, out)
        detector, rows, short = Detector.load(weights), [], []
        with step("held-out episodes") as update:
            for i, robot in enumerate(chosen.values()):
                new = measure_ends(simulator, detector, robot)
                short += [] if new else [robot.name]
                rows += new
                update(i + 1, len(chosen), robot.name)
        if short:
            console.print(
                f"left out, since their episodes are too short or show no object at the end: {', '.join(short)}"
            )
        require(bool(rows), "no robot is left; choose other --robots, or a model with a shorter window")
        write_rows(out / TABLE, rows)
        for kind, prefix in (("tools and objects", ""), ("tools", "tool"), ("objects", "colour")):
            own_rows = [row for row in rows if str(row["what"]).startswith(prefix)]
            shares = {view: in_place(own_rows, view) for view in VIEWS}
            words = [f"{view} {share:.3f} ± {half:.3f}" for view, (share, half, _) in shares.items()]
            console.print(
                f"{kind} that moved, in place ({shares['true'][2]} robots): {', '.join(words)}", soft_wrap=True
            )
        wrote(out / TABLE)


def main() -> None:
    run_module(measure_run, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main, resumes=False, keeps="what there is of the detector"))
