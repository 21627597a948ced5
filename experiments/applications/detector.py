"""A detector of tools and objects in frames of a simulator's robots, trained on true frames.

Command: python -m experiments.applications.detector RUN
Cost: about ten minutes of one core for eight robots, half an hour for forty.
Expected: it finds tools and visible objects of held-out true frames within 2 pixels of 64 in nearly all of them, most
          also as the run's tokenizer shows them.

The suite gives the true positions. Half of the training frames are reconstructions by RUN's tokenizer, and in some an
object is missing, so that absence is learnt too. It sees frames of 64 pixels; smaller frames of a run are enlarged.
Writes detector.npz (half precision) and errors.csv, its errors on held-out episodes. The same command continues where
it was stopped (its frames are drawn again, in a minute or two), and keeps an existing detector.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from tyro.conf import Positional, arg

from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.suite.simulator import SPECS
from data_pipelines.suite.spec import IMAGE_SIZE
from experiments.applications.detector_network import Detections, DetectorParams, detect, init_detector, points_loss
from experiments.applications.scenes import Points, Scenes, draw_scenes, point_names
from experiments.applications.settings_file import FILE, pin_settings
from experiments.running.workspace import Workspace
from experiments.simulators import load_simulator
from experiments.tables import write_rows
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from experiments.terminal.progress import say, short, step, wrote
from hma_jax.config import ConfigError, require
from hma_jax.kernels.random import key_of
from hma_jax.runtime.arrays import reading_arrays, write_arrays
from hma_jax.simulator.robots import Robot
from hma_jax.tokenizers.base import Tokenizer

COMMITTED, OUT = Path("experiments/results/detector"), Path("runs/detector")
WEIGHTS, ERRORS = "detector.npz", "errors.csv"
UNFINISHED = f"{WEIGHTS}.unfinished"
EPISODES, MIN_EPISODES, PER_EPISODE, HELD_OUT = 1920, 48, 16, (24, 16)
"""Training episodes of all robots together, the least number for each robot, and frames per episode; held-out episodes
of each robot and their frames."""

STEPS, STEPS_PER_ROBOT, BATCH, LEARNING_RATE = 1000, 125, 32, 2e-3
"""Training steps: so many, and more for each robot."""

SAVE_EVERY = 100
"""Steps between saves of the unfinished training."""

MISSING_PROBABILITY = 0.2
MAX_NOISE = 16.0
"""Standard deviation, in grey levels, of the strongest noise added to training frames."""

MIN_CONFIDENCE, SURE_CONFIDENCE = 0.15, 0.5
"""Confidence above which a point counts as detected, and a second threshold for which tables of films also count
points, since the number found depends on the threshold."""

WITHIN_PX = (2.0, 4.0)
"""Distances, in pixels of a 64-pixel frame, within which the share of detections is reported."""

CLOSE_PX = WITHIN_PX[1]
"""2 pixels of a frame of 32: a detection this near to the true position counts as in place."""

BLOCK = 64
"""Frames per call."""


def in_blocks(call: Callable[[np.ndarray], Any], frames: np.ndarray) -> Any:
    """What `call` returns for frames [n, ...]: arrays [n, ...]. It is called with BLOCK frames at a time, so that only
    one program is compiled."""
    filled = np.concatenate([frames, np.repeat(frames[-1:], -len(frames) % BLOCK, 0)])
    parts = [call(filled[i : i + BLOCK]) for i in range(0, len(filled), BLOCK)]
    return jax.tree.map(lambda *x: np.concatenate(x)[: len(frames)], *parts)


class Detector:
    """Trained weights, and the robots they were trained on, in the order of the weights."""

    def __init__(self, weights: DetectorParams, robots: Sequence[str]):
        self.weights, self.robots = weights, tuple(robots)
        self._detect = jax.jit(detect)

    def detect(self, robot: str, frames: np.ndarray) -> Detections:
        """The robot's P points in frames uint8 [n, H, W, 3]. Raises ConfigError for a robot on which it was not
        trained."""
        require(robot in self.robots, f"the detector was not trained on {robot}; it knows {', '.join(self.robots)}")
        index, count = self.robots.index(robot), len(point_names(SPECS[robot]))
        found = in_blocks(lambda block: self._detect(self.weights, block, index), frames)
        return Detections(*(x[:, :count] for x in found))

    def save(self, path: Path) -> None:
        weights = {name: np.asarray(x, np.float16) for name, x in self.weights.items()}
        write_arrays(path, {"robots": np.array(self.robots)} | weights)

    @classmethod
    def load(cls, path: Path) -> Detector:
        """Loads a detector. Raises ConfigError if there is none."""
        advice = "train a detector with python -m experiments.applications.detector RUN"
        with reading_arrays(path, advice) as arrays:
            weights = {name: jnp.asarray(x, jnp.float32) for name, x in arrays.items() if name != "robots"}
            return cls(weights, [str(name) for name in arrays["robots"]])


def batches(scenes: Sequence[Scenes], rng: np.random.Generator, size: int) -> Iterator[tuple]:
    """Endless batches for `points_loss`, of random frames of random robots, with noise."""
    points, side = max(own.points.share.shape[-1] for own in scenes), scenes[0].images.shape[1]
    while True:
        images, robots = np.zeros((size, side, side, 3), np.float32), rng.integers(len(scenes), size=size)
        position, known = np.zeros((size, points, 2), np.float32), np.zeros((size, points), np.float32)
        visible = np.zeros((size, points), np.float32)
        for i, robot in enumerate(robots):
            own = scenes[robot]
            k, p = rng.integers(len(own.images)), own.points.share.shape[-1]
            images[i] = own.images[k] + rng.uniform(0, MAX_NOISE) * rng.standard_normal((side, side, 3), np.float32)
            position[i, :p], visible[i, :p], known[i, :p] = own.points.position[k], own.points.visible[k], 1
        yield images, robots, position, visible, known


def train_detector(
    scenes: Mapping[str, Scenes],
    unfinished: Path,
    *,
    steps: int,
    size: int = BATCH,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Detector:
    """Trains a detector, resuming from the file `unfinished` if a killed process left it; the result is the same as
    without the kill. Raises ConfigError without scenes, for a damaged file, or where training diverges."""
    require(bool(scenes), "there is no robot to train a detector on")
    own, rng = list(scenes.values()), np.random.default_rng(0)
    weights = init_detector(key_of(0), len(own), max(x.points.share.shape[-1] for x in own))
    schedule = optax.warmup_cosine_decay_schedule(0.0, LEARNING_RATE, min(100, steps // 4), steps)
    optimizer = optax.chain(optax.clip_by_global_norm(5.0), optax.adamw(schedule, weight_decay=1e-3))

    @partial(jax.jit, donate_argnums=(0, 1))
    def update(weights, state, batch):
        loss, gradient = jax.value_and_grad(points_loss)(weights, *batch)
        change, state = optimizer.update(gradient, state, weights)
        return optax.apply_updates(weights, change), state, loss

    state, first_step = optimizer.init(weights), 0
    if unfinished.exists():
        first_step, (weights, state) = _resume(unfinished, (weights, state), rng)
    for done, batch in enumerate(islice(batches(own, rng, size), steps - first_step), first_step + 1):
        weights, state, loss = update(weights, state, batch)
        if done < steps and done % SAVE_EVERY == 0 and jnp.isfinite(loss):
            _save_progress(unfinished, done, (weights, state), rng)
        progress(done, steps)
    if not jnp.isfinite(loss):
        unfinished.unlink(missing_ok=True)  # resuming would diverge again
        raise ConfigError("the detector's loss is not finite; lower LEARNING_RATE")
    return Detector(weights, list(scenes))


def _save_progress(path: Path, done: int, trained: Any, rng: np.random.Generator) -> None:
    """Writes everything, besides the scenes, that the steps after the first `done` depend on."""
    leaves = {f"leaf/{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(trained))}
    write_arrays(path, {"done": done, "rng": json.dumps(rng.bit_generator.state)} | leaves, compressed=False)


def _resume(path: Path, fresh: Any, rng: np.random.Generator) -> tuple[int, Any]:
    """(steps done, training state) as `_save_progress` wrote them, in the structure of `fresh`; restores `rng`."""
    leaves, structure = jax.tree.flatten(fresh)
    with reading_arrays(path, "remove it; the same command then trains again") as arrays:
        kept = [jnp.asarray(arrays[f"leaf/{i}"]) for i in range(len(leaves))]
        rng.bit_generator.state = json.loads(str(arrays["rng"]))
        return int(arrays["done"]), jax.tree.unflatten(structure, kept)


def detection_errors(detector: Detector, robot: str, scenes: Scenes) -> list[dict[str, object]]:
    """Position errors for each kind of point of a robot, detection rates, and, for points that are not visible, the
    share that is detected nevertheless (`ghosts`) and their number, by the reason why they are not visible (see
    `unseen`)."""
    points, (position, confidence) = scenes.points, detector.detect(robot, scenes.images)
    error = np.linalg.norm(position - points.position, axis=-1)
    names, rows = point_names(SPECS[robot]), []
    for kind, prefix in (("tool", "tool"), ("object", "colour")):
        kind_points = [i for i, name in enumerate(names) if name.startswith(prefix)]
        visible, confident = points.visible[:, kind_points], confidence[:, kind_points] >= MIN_CONFIDENCE
        if not visible.any():
            continue  # a robot that touches nothing
        distances = error[:, kind_points][visible]
        within = {f"within_{r:g}px": float(np.mean((distances <= r) & confident[visible])) for r in WITHIN_PX}
        row = {
            "robot": robot, "what": kind, "frames": int(visible.sum()), "median_px": float(np.median(distances)),
            "p90_px": float(np.quantile(distances, 0.9)), **within, "found": float(np.mean(confident[visible])),
        }  # fmt: skip
        for why, which in unseen(points).items():
            detected = confident[which[:, kind_points]]
            row |= {f"ghosts_{why}": float(np.mean(detected)) if detected.size else np.nan, why: detected.size}
        rows.append(row)
    return rows


def unseen(points: Points) -> dict[str, np.ndarray]:
    """Points that are not visible, bool [n, P] for each reason: `absent`, no object has this colour; `hidden`, no part
    of it is in view; `partly`, too little of it is in view."""
    there = ~points.absent
    return {
        "absent": points.absent,
        "hidden": there & (points.share == 0),
        "partly": there & (points.share > 0) & ~points.visible,
    }


def enlarged(images: np.ndarray) -> np.ndarray:
    """Square frames uint8 [n, H, W, 3] as the detector sees them, `IMAGE_SIZE` pixels wide."""
    times, rest = divmod(IMAGE_SIZE, images.shape[1])
    require(not rest, f"frames of {images.shape[1]} pixels cannot be enlarged to {IMAGE_SIZE}")
    return images.repeat(times, axis=1).repeat(times, axis=2)


def resized(tokenizer: Tokenizer, scenes: Scenes) -> Scenes:
    """The scenes with frames resized to the tokenizer's size, then enlarged to the detector's."""
    return scenes._replace(images=enlarged(fit_images(scenes.images, tokenizer.image_size)))


def reconstruct(tokenizer: Tokenizer, images: np.ndarray) -> np.ndarray:
    """Frames uint8 [n, H, W, 3] encoded and decoded by a tokenizer, enlarged to the detector's size."""
    images = fit_images(images, tokenizer.image_size)
    whole = jax.jit(lambda x: tokenizer.decode_uint8_fn(tokenizer.params, tokenizer.encode_fn(tokenizer.params, x)))
    return enlarged(in_blocks(whole, images))


def reconstructed(tokenizer: Tokenizer, scenes: Scenes, every: int = 1) -> Scenes:
    """The scenes `resized`, every n-th frame encoded and decoded by the tokenizer."""
    given = resized(tokenizer, scenes)
    given.images[::every] = reconstruct(tokenizer, scenes.images[::every])
    return given


def suite_robots(robots: Mapping[str, Robot]) -> dict[str, Robot]:
    """The robots of the suite, whose true positions are known. Raises ConfigError if there are none."""
    known = {name: robot for name, robot in robots.items() if name in SPECS}
    require(bool(known), "the model has no robot of the suite, and only for these the positions of tools are known")
    return known


def select_robots(robots: dict[str, Robot], names: Sequence[str]) -> dict[str, Robot]:
    """The robots named in `names`, or all if it is empty. Raises ConfigError for a name that is not there."""
    unknown = sorted(set(names) - set(robots))
    require(not unknown, f"--robots: {', '.join(unknown)} cannot be used; choose from {', '.join(robots)}")
    return {name: robot for name, robot in robots.items() if not names or name in names}


def make_detector(robots: Sequence[str], tokenizer: Tokenizer, out: Path) -> Detector:
    """Trains a detector on frames resized and reconstructed by `tokenizer`; writes it and its errors into `out`."""
    episodes = max(EPISODES // len(robots), MIN_EPISODES)
    with step("true frames") as update:
        train, held = {}, {}
        for i, name in enumerate(robots):
            drawn = draw_scenes(SPECS[name], "train", episodes, PER_EPISODE, 0, MISSING_PROBABILITY)
            train[name] = reconstructed(tokenizer, drawn, every=2)
            held[name] = draw_scenes(SPECS[name], "val", *HELD_OUT, 1)
            update(i + 1, len(robots), name)
    out.mkdir(parents=True, exist_ok=True)
    unfinished, steps = out / UNFINISHED, STEPS + STEPS_PER_ROBOT * len(robots)
    with step("train the detector") as update:
        detector = train_detector(train, unfinished, steps=steps, progress=lambda done, total: update(done, total, ""))
    aside = out / f".{WEIGHTS}"
    detector.save(aside)
    detector, rows = Detector.load(aside), []  # as it was saved
    for name, scenes in held.items():
        for frames, given in (("true", resized), ("tokenizer", reconstructed)):
            rows += [{"frames_of": frames} | row for row in detection_errors(detector, name, given(tokenizer, scenes))]
    write_rows(out / ERRORS, rows)
    aside.replace(out / WEIGHTS)  # written last: if the weights exist, errors.csv does too
    unfinished.unlink(missing_ok=True)
    return detector


def train_for_run(
    run: Annotated[Positional[Path], arg(metavar="RUN")], out: Annotated[Path, arg(metavar="DIR")] = OUT
) -> None:
    """Trains a detector for the robots of a run.

    Args:
        run: Directory of a training run.
        out: Directory for the detector.
    """
    with Workspace(out).locked():
        simulator, weights, table = load_simulator(run), out / WEIGHTS, out / ERRORS
        robots = list(suite_robots(simulator.robots))
        require(
            not weights.exists() or (out / FILE).exists(),
            f"{weights} exists, but it is not known for which run it was trained; choose another --out or remove it",
        )
        pin_settings(out, run, simulator, unused=("simulator.decode",))  # no frame is made
        if existing := weights.exists():
            say(f"{short(weights)} of this run exists already; remove it to train it again")
        else:
            make_detector(robots, simulator.tokenizer, out)
        print(table.read_text())
        then = f"python -m experiments.applications.endurance {run} --detector {weights}"
        wrote(*(() if existing else (weights, table)), then=then)


def main() -> None:
    run_module(train_for_run, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main))
