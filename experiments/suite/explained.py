"""Question: how much of the change in the images do a robot's actions explain?
Command: python -m experiments.suite.explained [--out FILE]
Cost: about two minutes of one core.

From equal states, actions drawn from the robot's own data are executed in the true simulator for
one step at the model's rate (2 Hz):

    share = E |x' - mean of x' over actions|^2 / E |x' - x|^2

with frames at 32 pixels. What is not explained is determined earlier: by momentum, by commands that still have an
effect, and by where the robot was, since a thing that moves also uncovers its old place. For this last reason a disc
that jumps anywhere has a share near one half; small motions in random directions come near one. A trained model's
controllability is judged against this share.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import arg

from data_pipelines.registry.spec import FRAME_RATE, stride_of
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.embodiments import EMBODIMENTS
from data_pipelines.suite.render import render_frames
from data_pipelines.suite.rollout import Rollout, episode_seeds, simulate
from data_pipelines.suite.spec import EmbodimentSpec
from data_pipelines.suite.world import State, World
from experiments.analysis.explained_share import EXPLAINED, ExplainedShare
from experiments.suite import COMMITTED
from experiments.tables import write_table
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of

STATES = 96
ACTIONS = 8
"""Drawn for each state."""

PIXELS = 32


def explained(spec: EmbodimentSpec, states: int = STATES) -> ExplainedShare:
    """The share of one robot, a pure function of its arguments."""
    seeds = episode_seeds(spec, states, 0, "explained")
    rollout, rng = simulate(spec, seeds), np.random.default_rng(0)
    stride = stride_of(spec.hz, FRAME_RATE)
    times = (rng.random(states) * (rollout.lengths - stride)).astype(int)
    starts = states_at(spec, rollout, times)
    of = rng.integers(states, size=(states, ACTIONS))
    when = (rng.random(of.shape) * (rollout.lengths[of] - stride)).astype(int)
    chunks = np.stack([rollout.actions[of.ravel(), when.ravel() + k] for k in range(stride)], 1)

    world = World(spec, seeds[:1])
    world.state = starts.take(np.repeat(np.arange(states), ACTIONS))
    before = frames_of(spec, starts)
    for k in range(stride):
        world.step(chunks[:, k].astype(np.float64))
    after = frames_of(spec, world.state).reshape(states, ACTIONS, -1)
    spread = ((after - after.mean(1, keepdims=True)) ** 2).sum((1, 2)) / (ACTIONS - 1)
    change = ((after - before.reshape(states, 1, -1)) ** 2).sum(2).mean(1)
    share = spread.sum() / change.sum()
    sem = np.std(spread - share * change, ddof=1) / np.sqrt(states) / change.mean()
    moved = np.sqrt(change.mean() / after.shape[-1])
    return ExplainedShare(spec.name, spec.family, spec.action_dim, float(share), float(sem), float(moved))


def states_at(spec: EmbodimentSpec, rollout: Rollout, times: np.ndarray) -> State:
    """The whole state of each episode before its native step times[i]."""
    world, found = World(spec, rollout.seeds), {}
    for t in range(int(times.max()) + 1):
        found |= {int(i): world.state.take([i]) for i in np.flatnonzero(times == t)}
        world.step(rollout.actions[:, t].astype(np.float64))
    parts = [vars(found[i]) for i in range(len(times))]
    return State(**{name: np.concatenate([p[name] for p in parts]) for name in parts[0]})


def frames_of(spec: EmbodimentSpec, state: State) -> np.ndarray:
    """float64 [n, PIXELS, PIXELS, 3]: what the camera sees, at the size of the studies."""
    ids, first, episode = np.unique(state.seeds, return_index=True, return_inverse=True)
    frames = render_frames(spec, draw_appearance(spec, ids), state.goals[first], state.q, state.objects, episode)
    n, size = len(frames), frames.shape[1]
    pooled = frames.reshape(n, PIXELS, size // PIXELS, PIXELS, size // PIXELS, 3)
    return pooled.astype(np.float64).mean((2, 4))


def measure_robots(
    out: Annotated[Path, arg(metavar="FILE", help_behavior_hint=COMMITTED)] = EXPLAINED,
) -> None:
    """Measures all robots and writes a table.

    Args:
        out: The table.
    """
    rows = []
    for spec in EMBODIMENTS:
        rows.append(explained(spec))
        print(f"{rows[-1].robot:18s} {rows[-1].share:.2f} ± {rows[-1].sem:.2f}", flush=True)
    cells = [[r.robot, r.family, r.action_values, f"{r.share:.4f}", f"{r.sem:.4f}", f"{r.moved:.2f}"] for r in rows]
    write_table(out, ["robot", "family", "action_values", "share", "sem", "moved"], cells)
    enough = sum(r.share >= 0.3 for r in rows)
    print(f"{enough} of {len(rows)} robots: actions explain at least 30 % of the pixels' change")


def main() -> None:
    run_module(measure_robots, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main, resumes=False))
