"""Object permanence: are objects that were occluded or out of view still what and where they were?

Command: python -m experiments.applications.endurance.hidden RUN --name NAME --out DIR
Cost: two minutes of one core, three for the served model.
Expected: within the model's window, hidden objects come back as often as objects that were never hidden are still
          there. Found: they come back less often; in small models, the longer they were hidden the less often
          (docs/endurance.md).

Events come from held-out episodes in which an object is covered by the robot or leaves the image, and is back soon
after the start. Each has a control: an object that is seen all the time, judged equally long after a
start with the same number of frames. Writes DIR/NAME_hidden.csv, a row per event; `moved_px` is how far the object
truly is from where it was last seen.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.rollout import Rollout, episode_seeds, simulate
from data_pipelines.suite.simulator import SPECS
from data_pipelines.suite.spec import EmbodimentSpec
from experiments.applications.detector import CLOSE_PX, COMMITTED, MIN_CONFIDENCE, WEIGHTS, Detector, enlarged
from experiments.applications.endurance.drives import native_robots
from experiments.applications.endurance.settings import pin_name
from experiments.applications.endurance.tables import Row
from experiments.applications.scenes import VISIBLE_SHARE, points_of
from experiments.running.workspace import Workspace
from experiments.simulators import START_FRAMES, load_simulator
from experiments.tables import write_rows
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.progress import console, step, wrote
from hma_jax.config import ExecutionConfig, require
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start

EPISODES, HORIZON = 400, 30
"""Number of episodes of each robot that are searched, and of frames after the start within which the object must be
back."""

WHOLE_SHARE = 0.6
"""Share of an object that must be in view before and after."""

MIN_HIDDEN = 2
"""Frames that it must be out of view at least."""

PER_ROBOT = 6
"""Events of each robot, and as many controls."""


@dataclass(frozen=True)
class Event:
    """Point p of an episode is seen until frame `start`, where the model takes over, and judged `lag` frames later."""

    kind: Literal["hidden", "control"]
    episode: int
    start: int
    point: int
    gone: int  # number of frames in between in which it is not seen
    lag: int


def find_events(share: np.ndarray, lengths: np.ndarray, tools: int, rng: np.random.Generator) -> list[Event]:
    """Up to `PER_ROBOT` events, at most one per episode, and a control for each, from the visible shares [n, T, P].

    The start is the last frame before the object begins to vanish.
    """
    hidden: list[Event] = []
    for episode in rng.permutation(len(share)):
        own = share[episode, : lengths[episode]]
        found = [e for p in range(tools, share.shape[2]) for e in _hidden_spans(own[:, p], int(episode), p)]
        if found:
            hidden.append(max(found, key=lambda e: e.gone))  # the longest are the rarest
    hidden = hidden[:PER_ROBOT]
    controls: list[Event] = []
    for event in hidden:
        for episode in rng.permutation(len(share)):
            stop = event.start + event.lag + 1
            whole = (share[episode, :stop] >= WHOLE_SHARE).all(0)
            points = [p for p in range(tools, share.shape[2]) if whole[p]]
            if points and lengths[episode] >= stop:
                controls.append(Event("control", int(episode), event.start, points[0], 0, event.lag))
                break
    return hidden + controls


def _hidden_spans(share: np.ndarray, episode: int, point: int) -> list[Event]:
    events, t = [], START_FRAMES - 1
    while t < len(share) - 1:
        if share[t] >= WHOLE_SHARE and share[t + 1] < WHOLE_SHARE:
            back = next((s for s in range(t + 1, min(t + 1 + HORIZON, len(share))) if share[s] >= WHOLE_SHARE), None)
            if back is None:
                break
            hidden = int((share[t:back] < VISIBLE_SHARE).sum())
            if hidden >= MIN_HIDDEN:
                events.append(Event("hidden", episode, t, point, hidden, back - t))
            t = back
        else:
            t += 1
    return events


def judge(
    simulator: Simulator, detector: Detector, spec: EmbodimentSpec, rollout: Rollout, events: list[Event]
) -> list[Row]:
    """The model's frame at the end of each event, all of one robot in one batch."""
    robot, last = simulator.robots[spec.name], max(e.lag for e in events)
    starts, actions, true = [], [], []
    for e in events:
        seeds, part = rollout.seeds[e.episode : e.episode + 1], slice(0, e.start + e.lag + 1)
        q, objects = rollout.q[e.episode, part], rollout.objects[e.episode, part]
        goals = rollout.goals[e.episode : e.episode + 1]
        images = render_frames(spec, draw_appearance(spec, seeds), goals, q, objects, np.zeros(len(q), int))
        recorded = rollout.actions[e.episode]
        images = fit_images(images, simulator.tokenizer.image_size)
        starts.append(Start(spec.name, images[: e.start + 1], recorded[: e.start], int(seeds[0])))
        actions.append(robot.clip_to_range(recorded[e.start : e.start + last], "clip")[0])
        true.append((images[-1], points_of(spec, np.repeat(seeds, len(q)), q, objects)))
    films = [simulator.reset(starts, seeds=0).copy()]
    for t in range(last):  # all run until the last is judged: another number of episodes would be compiled anew
        films.append(simulator.step([a[min(t, len(a) - 1)] for a in actions]).copy())
    film, rows = np.stack(films), []
    for b, (e, (image, points)) in enumerate(zip(events, true, strict=True)):
        moved = float(np.linalg.norm(points.position[-1, e.point] - points.position[e.start, e.point]))
        row: Row = {"robot": spec.name, "kind": e.kind, "gone": e.gone, "lag": e.lag, "moved_px": moved}
        for name, seen in (("", film[e.lag, b]), ("true_", image)):
            found = detector.detect(spec.name, enlarged(seen[None]))
            off = float(np.linalg.norm(found.position[0, e.point] - points.position[-1, e.point]))
            confidence = float(found.confidence[0, e.point])
            row |= {
                f"{name}confidence": confidence,
                f"{name}px": off,
                f"{name}close": float(confidence >= MIN_CONFIDENCE and off <= CLOSE_PX),
                f"{name}found": float(confidence >= MIN_CONFIDENCE),
            }
        rows.append(row)
    return rows


def measure_hidden(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    out: Annotated[Path, arg(metavar="DIR")] = Path("runs/endurance"),
    name: str = "model",
    detector: Annotated[Path, arg(metavar="FILE")] = COMMITTED / WEIGHTS,
) -> None:
    """Measures a run.

    Args:
        run: Directory of a training run.
        out: Directory for the table.
        name: Name of the run, with which the table's name begins.
        detector: Detector of tools and objects, as `python -m experiments.applications.detector` writes it.
    """
    with Workspace(out).locked(f".{name}.lock"):
        finder, rows, table = Detector.load(detector), [], out / f"{name}_hidden.csv"
        simulator = load_simulator(run, execution=ExecutionConfig(remat="none"), episodes=2 * PER_ROBOT, history=1)
        robots = native_robots(simulator.robots)
        pin_name(out, name, run, simulator, detector)
        with step("objects that come back") as update:
            for i, robot in enumerate(robots):
                spec, rng = SPECS[robot], np.random.default_rng([0, i])
                rollout = simulate(spec, episode_seeds(spec, EPISODES, 0, "val"))
                n, steps = rollout.q.shape[:2]
                flat = (x.reshape(-1, *x.shape[2:]) for x in (rollout.q, rollout.objects))
                share = points_of(spec, np.repeat(rollout.seeds, steps), *flat).share.reshape(n, steps, -1)
                events = find_events(share, rollout.lengths, len(spec.body.tools), rng)
                if events:
                    # unused episodes repeat the first event
                    judged = (events * (2 * PER_ROBOT))[: 2 * PER_ROBOT]
                    rows += judge(simulator, finder, spec, rollout, judged)[: len(events)]
                update(i + 1, len(robots), robot)
        require(bool(rows), f"no object is hidden and comes back in held-out episodes of {', '.join(robots)}")
        write_rows(table, rows)
        for kind in ("hidden", "control"):
            own = [row for row in rows if row["kind"] == kind]
            names = ("gone", "lag", "found", "close", "true_found", "true_close")
            means = {k: np.mean([float(r[k]) for r in own]) for k in names}
            console.print(f"{kind}: {len(own)} events, " + ", ".join(f"{k} {v:.2f}" for k, v in means.items()))
        wrote(table)


def main() -> None:
    run_module(measure_hidden, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
