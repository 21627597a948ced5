"""Question: do the robots of a family share dynamics that can be learned from one another?
Command: python -m experiments.suite.siblings [--out FILE]
Cost: about three minutes of one core.
Expected: in every family, four siblings predict the fifth better than four strangers do, and better
than the same siblings with their actions shuffled.

A ridge regression on fixed features, not a neural network, predicts where a robot's first tool will
be half a second later, in pixels. It sees the configuration (sines and cosines of the joints), the
tool's place and last displacement, the actions until then, normalised by the robot's own statistics as in the models,
and products of configuration and actions. It is never given a frame of the robot on which it is judged. Strangers are
robots of the other family with the same number of action values; each of them is left out in turn.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from tyro.conf import arg

from data_pipelines.registry.spec import FRAME_RATE, stride_of
from data_pipelines.suite.embodiments import EMBODIMENTS, siblings, strangers
from data_pipelines.suite.render import positions_of
from data_pipelines.suite.rollout import episode_seeds, simulate
from data_pipelines.suite.spec import EmbodimentSpec
from experiments.analysis.explained_share import EXPLAINED
from experiments.analysis.intervals import interval_of
from experiments.suite import COMMITTED
from experiments.tables import write_table
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from hma_jax.evaluation.statistics import mean_and_sem

OUT = EXPLAINED.with_name("siblings.csv")
EPISODES = 64
STEPS = 40
"""Steps at 2 Hz taken of an episode, at most."""

RIDGE = 3e-3
"""Ridge penalty for each sample, as a share of the mean squared feature."""


@dataclass(frozen=True)
class Samples:
    """What a robot did, half a second at a time."""

    features: np.ndarray  # [N, .] without actions
    actions: np.ndarray  # [N, 2 A]: mean and last of the chunk
    moves: np.ndarray  # [N, 2] pixels
    episode: np.ndarray  # [N]


@dataclass(frozen=True)
class Result:
    """Errors as shares of the robots' motion; gains over the controls with 95 % intervals over other robots."""

    family: str
    siblings: float
    strangers: float
    shuffled: float
    over_strangers: tuple[float, float, float]  # (gain, low, high)
    over_shuffled: tuple[float, float, float]


def sample(spec: EmbodimentSpec, joints: int, episodes: int = EPISODES) -> Samples:
    """Steps of `episodes` episodes, configurations padded to `joints` entries."""
    rollout, stride = simulate(spec, episode_seeds(spec, episodes, 0, "siblings")), stride_of(spec.hz, FRAME_RATE)
    recorded = np.concatenate([rollout.actions[i, : rollout.lengths[i]] for i in range(episodes)])
    actions = (rollout.actions - recorded.mean(0)) / recorded.std(0)
    parts: list[tuple[np.ndarray, ...]] = []
    for i in range(episodes):
        t = np.arange(stride, rollout.lengths[i] - stride, stride)[:STEPS]
        if not len(t):
            continue
        at = positions_of(spec, rollout.q[i], rollout.objects[i])[:, 0]
        q = np.pad(rollout.q[i, t], ((0, 0), (0, joints - spec.body.size)))
        chunk = np.stack([actions[i, t + k] for k in range(stride)], 1)
        parts.append((
            np.concatenate([np.sin(q), np.cos(q), at[t] / 64 - 0.5, (at[t] - at[t - stride]) / 8], 1),
            np.concatenate([chunk.mean(1), chunk[:, -1]], 1),
            at[t + stride] - at[t],
            np.full(len(t), i),
        ))  # fmt: skip
    return Samples(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def predictor(robots: Sequence[Samples], shuffle: np.random.Generator | None = None):
    """A function from Samples to predicted moves [N, 2], fitted on the samples of `robots`; with
    `shuffle` each robot's actions are dealt to its samples at random first."""
    design, moves = [], []
    for robot in robots:
        actions = robot.actions if shuffle is None else shuffle.permutation(robot.actions)
        design.append(_design(robot.features, actions))
        moves.append(robot.moves)
    x, y = np.concatenate(design), np.concatenate(moves)
    scale = np.sqrt((x**2).mean(0)) + 1e-9
    x = x / scale
    weights = np.linalg.solve(x.T @ x + RIDGE * len(x) * np.eye(x.shape[1]), x.T @ y)
    return lambda s: _design(s.features, s.actions) / scale @ weights


def _design(features: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """[N, .]: a constant, features, actions, and products of features and mean actions."""
    mean = actions[:, : actions.shape[1] // 2]
    products = (features[:, :, None] * mean[:, None, :]).reshape(len(features), -1)
    return np.concatenate([np.ones((len(features), 1)), features, actions, products], 1)


def judge(family: str, samples: dict[str, Samples]) -> Result:
    """Each robot of a family predicted from its four siblings, from strangers, and under shuffling."""
    robots, rng = [s for s in EMBODIMENTS if s.family == family], np.random.default_rng(0)
    errors: dict[str, list[np.ndarray]] = {"siblings": [], "strangers": [], "shuffled": []}
    for turn, spec in enumerate(robots):
        target, others = samples[spec.name], [samples[s.name] for s in siblings(spec)]
        foreign = [samples[s.name] for k, s in enumerate(strangers(spec)) if k != turn]
        models = {"siblings": predictor(others), "strangers": predictor(foreign), "shuffled": predictor(others, rng)}
        motion = (target.moves**2).sum(1).mean()
        for name, predict in models.items():
            squared = ((predict(target) - target.moves) ** 2).sum(1) / motion
            errors[name].append(np.array([squared[target.episode == e].mean() for e in np.unique(target.episode)]))
    means = {name: float(np.mean([e.mean() for e in values])) for name, values in errors.items()}
    return Result(
        family, **means,
        over_strangers=gain(errors["strangers"], errors["siblings"]),
        over_shuffled=gain(errors["shuffled"], errors["siblings"]),
    )  # fmt: skip


def gain(control: Sequence[np.ndarray], own: Sequence[np.ndarray]) -> tuple[float, float, float]:
    """(mean of control - own, low, high) of errors per episode of each robot; the 95 % interval is Student's t of the
    robots' means, which include the scatter of episodes. The bounds are nan for a single robot."""
    i = interval_of(mean_and_sem([(c - o).mean() for c, o in zip(control, own, strict=True)]))
    return i.mean, i.low, i.high


def compare_families(out: Annotated[Path, arg(metavar="FILE", help_behavior_hint=COMMITTED)] = OUT) -> None:
    """Judges all families and writes a table.

    Args:
        out: The table.
    """
    families = list(dict.fromkeys(s.family for s in EMBODIMENTS))
    samples = {s.name: sample(s, _padded(s)) for s in EMBODIMENTS}
    rows = []
    for family in families:
        r = judge(family, samples)
        gains = [f"{v:.4f}" for v in (*r.over_strangers, *r.over_shuffled)]
        rows.append([family, f"{r.siblings:.4f}", f"{r.strangers:.4f}", f"{r.shuffled:.4f}", *gains])
        print(*rows[-1], sep="\t", flush=True)
    names = [
        "family", "siblings", "strangers", "shuffled", "over_strangers", "over_strangers_low", "over_strangers_high",
        "over_shuffled", "over_shuffled_low", "over_shuffled_high",
    ]  # fmt: skip
    write_table(out, names, rows)


def _padded(spec: EmbodimentSpec) -> int:
    """Number of entries of the longest configuration among the robots with which it is compared."""
    return max(s.body.size for s in (spec, *siblings(spec), *strangers(spec)))


def main() -> None:
    run_module(compare_families, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main, resumes=False))
