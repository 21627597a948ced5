"""A detector of tools and objects in frames of a simulator's robots, trained on true frames.

Command: python -m experiments.applications.detector RUN
Cost: about ten minutes of one core.
Expected: it finds tools and visible objects of held-out true frames within 2 pixels of 64 in nearly all of them, also as
          the run's tokenizer shows them.

The suite says where everything is; half of the frames it learns from are as RUN's tokenizer shows them, and in some an
object is missing, so that it learns what nothing looks like. It also learns to read the action between two frames.
Writes detector.npz (half precision) and errors.csv, its own errors on held-out episodes.
"""

from __future__ import annotations

import argparse
import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax

from data_pipelines.publishing.files import write_file
from data_pipelines.suite.simulator import SPECS
from experiments.applications.scenes import Pairs, draw_pairs, point_names
from experiments.progress import step
from experiments.wrote import wrote
from hma_jax.config import ConfigError, require
from hma_jax.evaluation.detector import Weights, detection_loss, init_detector, watch
from hma_jax.simulator.robots import Robot

OUT = Path("experiments/results/detector")
WEIGHTS, ERRORS = "detector.npz", "errors.csv"
EPISODES, PER_EPISODE = 240, 8
"""Per robot, of the suite's training split, and pairs of frames of each."""

STEPS, BATCH, RATE = 2500, 24, 2e-3
MISSING = 0.2
NOISE = 16.0
"""Grey levels of noise that frames are given at most."""

SURE = 0.3
"""Confidence from which a point counts as found."""

NEAR = (2.0, 4.0)
"""Pixels of a 64-pixel frame: the second is 2 pixels of a frame of 32."""

BLOCK = 64
"""Frames that are watched in one call."""


class Watched(NamedTuple):
    """What the detector finds in n frames of a robot with P points and A action values."""

    position: np.ndarray  # float32 [n, P, 2], pixels (column, row)
    confidence: np.ndarray  # float32 [n, P]
    action: np.ndarray  # float32 [n - 1, A], normalised: what was seen to be done between them


class Detector:
    """Trained weights and the robots that they know, in the order of the weights."""

    def __init__(self, weights: Weights, robots: Sequence[str]):
        self.weights, self.robots = weights, tuple(robots)
        self._watch = jax.jit(watch)

    def watch(self, robot: str, film: np.ndarray) -> Watched:
        """Of a film uint8 [n, H, W, 3], n >= 2. Raises ConfigError for a robot that it was not trained on."""
        require(robot in self.robots, f"the detector was not trained on {robot}; it knows {', '.join(self.robots)}")
        spec, parts = SPECS[robot], []
        for first in range(0, max(len(film) - 1, 1), BLOCK):
            part = film[first : first + BLOCK + 1]
            filled = np.concatenate([part, np.repeat(part[-1:], BLOCK + 1 - len(part), 0)])
            found, action = self._watch(self.weights, filled, self.robots.index(robot))
            count = len(part) - 1 if first + BLOCK < len(film) - 1 else len(part)
            parts.append((found.position[:count], found.confidence[:count], action[: len(part) - 1]))
        position, confidence, action = (np.concatenate([np.asarray(p[i]) for p in parts]) for i in range(3))
        points = len(point_names(spec))
        return Watched(position[:, :points], confidence[:, :points], action[:, : spec.action_dim])

    def save(self, path: Path) -> None:
        content = io.BytesIO()
        arrays = {name: np.asarray(x, np.float16) for name, x in self.weights.items()}
        np.savez_compressed(content, robots=np.array(self.robots), **arrays)
        write_file(path, content.getvalue())

    @classmethod
    def load(cls, path: Path) -> Detector:
        """Raises ConfigError where there is none."""
        try:
            with np.load(path, allow_pickle=False) as file:
                weights = {name: jnp.asarray(file[name], jnp.float32) for name in file.files if name != "robots"}
                return cls(weights, [str(name) for name in file["robots"]])
        except (OSError, ValueError, KeyError) as error:
            raise ConfigError(
                f"{path} is no detector ({error}); make one with python -m experiments.applications.detector RUN"
            ) from error


def batches(pairs: Sequence[Pairs], seed: int, count: int, size: int) -> Iterator[tuple]:
    """What `detection_loss` takes, of random pairs of random robots, turned grey by noise."""
    rng = np.random.default_rng(seed)
    points, width = max(p.there.shape[-1] for p in pairs), max(p.action.shape[-1] for p in pairs)
    side = pairs[0].images.shape[2]
    for _ in range(count):
        images, robots = np.zeros((2, size, side, side, 3), np.float32), rng.integers(len(pairs), size=size)
        position, there = np.zeros((2, size, points, 2), np.float32), np.zeros((2, size, points), np.float32)
        known, action, alive = (np.zeros((size, n), np.float32) for n in (points, width, width))
        for i, robot in enumerate(robots):
            own = pairs[robot]
            k, p, a = rng.integers(own.action.shape[0]), own.there.shape[-1], own.action.shape[-1]
            noise = rng.uniform(0, NOISE) * rng.standard_normal((2, side, side, 3), np.float32)
            images[:, i] = own.images[:, k] + noise
            position[:, i, :p], there[:, i, :p], known[i, :p] = own.position[:, k], own.there[:, k], 1
            action[i, :a], alive[i, :a] = own.action[k], 1
        yield images, robots, position, there, known, action, alive


def train_detector(
    pairs: Mapping[str, Pairs], *, steps: int = STEPS, size: int = BATCH, seed: int = 0, progress=lambda done, total: None
) -> Detector:
    """Raises ConfigError without pairs."""
    require(bool(pairs), "there is no robot to train a detector on")
    own = list(pairs.values())
    points, width = max(p.there.shape[-1] for p in own), max(p.action.shape[-1] for p in own)
    weights = init_detector(jax.random.key(seed), len(own), points, width, own[0].images.shape[2])
    schedule = optax.warmup_cosine_decay_schedule(0.0, RATE, min(100, steps // 4), steps)
    optimizer = optax.chain(optax.clip_by_global_norm(5.0), optax.adamw(schedule, weight_decay=1e-3))

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(weights, state, batch):
        loss, gradient = jax.value_and_grad(detection_loss)(weights, *batch)
        change, state = optimizer.update(gradient, state, weights)
        return optax.apply_updates(weights, change), state, loss

    state = optimizer.init(weights)
    for i, batch in enumerate(batches(own, seed, steps, size)):
        weights, state, loss = update(weights, state, batch)
        progress(i + 1, steps)
    require(bool(jnp.isfinite(loss)), "the detector's loss is not finite; lower RATE")
    return Detector(weights, list(pairs))


def errors(detector: Detector, robot: str, pairs: Pairs) -> list[dict[str, object]]:
    """How far off it is on each point of a robot in `pairs` [2, n], and how often it sees what is not there."""
    watched = [detector.watch(robot, pairs.images[:, i]) for i in range(pairs.images.shape[1])]
    position, confidence = (np.stack([getattr(w, name) for w in watched], 1) for name in ("position", "confidence"))
    read = np.concatenate([w.action for w in watched])
    off = np.linalg.norm(position - pairs.position, axis=-1)
    names, rows = point_names(SPECS[robot]), []
    for kind in ("tool", "colour"):
        mine = [i for i, name in enumerate(names) if name.startswith(kind)]
        there, sure = pairs.there[..., mine], confidence[..., mine] >= SURE
        far = off[..., mine][there]
        near = {f"within_{r:g}px": np.mean((far <= r) & sure[there]) for r in NEAR}
        ghosts = np.mean(sure[~there]) if (~there).any() else np.nan
        rows.append({
            "robot": robot, "what": {"tool": "tool", "colour": "object"}[kind], "frames": int(there.sum()),
            "median": np.median(far), "p90": np.quantile(far, 0.9), **near, "found": np.mean(sure[there]),
            "ghosts": ghosts,
        })  # fmt: skip
    correlations = [np.corrcoef(read[:, a], pairs.action[:, a])[0, 1] for a in range(read.shape[1])]
    for row in rows:
        row["action_correlation"] = np.mean(correlations)
    return rows


def write_errors(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    content = io.StringIO()
    writer = csv.DictWriter(content, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.4f}" if isinstance(v, float) else v for k, v in row.items()})
    write_file(path, content.getvalue())


def shown_by(tokenizer, images: np.ndarray) -> np.ndarray:
    """Frames uint8 [n, H, W, 3] as a tokenizer shows them."""
    whole = jax.jit(lambda x: tokenizer.decode_uint8_fn(tokenizer.params, tokenizer.encode_fn(tokenizer.params, x)))
    filled = np.concatenate([images, np.repeat(images[-1:], -len(images) % BLOCK, 0)])
    return np.concatenate([np.asarray(whole(filled[i : i + BLOCK])) for i in range(0, len(filled), BLOCK)])[: len(images)]


def as_shown(tokenizer, pairs: Pairs) -> Pairs:
    flat = pairs.images.reshape(-1, *pairs.images.shape[2:])
    return pairs._replace(images=shown_by(tokenizer, flat).reshape(pairs.images.shape))


def both(pairs: Pairs, tokenizer) -> Pairs:
    """Every second pair as the tokenizer shows it."""
    images = pairs.images.copy()
    images[:, ::2] = as_shown(tokenizer, pairs._replace(images=pairs.images[:, ::2])).images
    return pairs._replace(images=images)


def known_robots(robots: Mapping[str, Robot]) -> dict[str, Robot]:
    """Those whose truth the suite knows. Raises ConfigError if there are none."""
    known = {name: robot for name, robot in robots.items() if name in SPECS and robot.stride == 1}
    require(bool(known), "no robot of the suite at its native rate: nobody knows where its tools are")
    return known


def main() -> None:
    from experiments.applications.simulators import load_simulator

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=OUT)
    arguments = parser.parse_args()
    simulator = load_simulator(arguments.run)
    robots, tokenizer = known_robots(simulator.robots), simulator.tokenizer
    with step("true frames") as update:
        train, held = {}, {}
        for i, (name, robot) in enumerate(robots.items()):
            train[name] = both(draw_pairs(SPECS[name], robot, "train", EPISODES, PER_EPISODE, 0, MISSING), tokenizer)
            held[name] = draw_pairs(SPECS[name], robot, "val", 24, 8, 1)
            update(i + 1, len(robots), name)
    with step("train the detector") as update:
        detector = train_detector(train, progress=lambda done, total: update(done, total, ""))
    detector.save(arguments.out / WEIGHTS)
    detector, rows = Detector.load(arguments.out / WEIGHTS), []  # as it was saved
    for name, pairs in held.items():
        for frames, seen in (("true", pairs), ("tokenizer", as_shown(tokenizer, pairs))):
            rows += [{"frames_of": frames} | row for row in errors(detector, name, seen)]
    write_errors(arguments.out / ERRORS, rows)
    for row in rows:
        print(" ".join(f"{v:.3f}" if isinstance(v, float) else f"{v}" for v in row.values()))
    wrote(arguments.out / WEIGHTS, arguments.out / ERRORS, then=f"python -m experiments.applications.endurance {arguments.run}")


if __name__ == "__main__":
    main()
