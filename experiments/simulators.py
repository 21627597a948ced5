"""Opens a run's robots in its learned simulator or in their true one, behind the same interface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from data_pipelines.inspection.action_stats import dimension_facts
from data_pipelines.simulators.simulator import PHYSICS, PhysicsSimulator, can_simulate, physics_starts
from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.suite.simulator import SPECS, SuiteSimulator, suite_robot, suite_starts
from data_pipelines.tokens.store import TokenStore
from data_pipelines.true_simulator import TrueSimulator
from experiments.running.workspace import Workspace
from hma_jax.config import DecodeConfig, require
from hma_jax.config.base import require_choice
from hma_jax.convert import write_run
from hma_jax.convert.atomic import atomic_directory
from hma_jax.simulator.folder import DECODE, ROBOTS, TOKENIZER, save_decode, save_robots
from hma_jax.simulator.interface import AnySimulator
from hma_jax.simulator.robots import Robot, rest_action
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import FILE as STARTS
from hma_jax.simulator.starts import Start, save_starts
from hma_jax.tokenizers.io import save_tokenizer
from hma_jax.training.runs import load_run

if TYPE_CHECKING:
    from hma_jax.model.embodiments import Embodiment

World = Literal["learned", "true"]

STARTS_PER_ROBOT = 6
START_FRAMES = 3
"""Number of frames with which an episode begins: enough to see what moves."""

DEAF = "the model was trained without actions (train.masking.setting passive), so its frames do not depend on them"


def load_simulator(run: Path | str, *, own_starts: bool = False, **options: Any) -> Simulator:
    """The learned simulator of a run, with robots and starts: those that are given, otherwise those beside the run
    (`simulator.folder`), or else those of the study whose directory holds the run (which may be one of its trials).
    `options` are those of `Simulator.load`.

    Raises ConfigError if there is no run, or nothing to start from, unless the caller has its own starts.
    """
    run = Path(run)
    study = Workspace.of_run(run)
    if options.get("tokenizer") is None and not (run / TOKENIZER).exists() and study.tokenizer.exists():
        options["tokenizer"] = study.tokenizer
    simulator = Simulator.load(run, **options)
    if not (run / ROBOTS).exists():
        simulator.update_robots((*describe_robots(simulator, study), *(options.get("robots") or ())))
    if own_starts:
        return simulator
    if not simulator.starts and not (run / STARTS).exists():
        simulator.starts = find_starts(simulator, study)
    require(
        bool(simulator.starts),
        f"{run}: the run has no starts for episodes: no {STARTS} beside it, no robot with a true simulator, and no "
        f"held-out frames in {study.store}. Move the run into the directory of a study that has tokens of its robots",
    )
    return simulator


def save_simulator(run: Path | str, out: Path | str) -> None:
    """Makes `out` a run that is a simulator wherever it is copied: the weights of `run` (their average if it keeps
    one), without the optimiser's moments, and what `load_simulator` finds beside it or in its study.

    Raises ConfigError if `out` exists, and what `load_simulator` raises.
    """
    simulator = load_simulator(run)
    mark_absolute_actions(simulator, run)
    with atomic_directory(Path(out)) as made:
        write_run(load_run(run, "auto"), made)
        save_beside(simulator, made, simulator.decode)


def save_beside(simulator: Simulator, directory: Path, decode: DecodeConfig | None) -> None:
    """Writes beside a run in `directory` what `load_simulator` takes from there: tokenizer, robots, starts and, if it
    is given, how frames are filled."""
    save_tokenizer(simulator.tokenizer, directory / TOKENIZER)
    save_robots(tuple(simulator.robots.values()), directory / ROBOTS)
    save_starts(simulator.starts, directory / STARTS)
    if decode is not None:
        save_decode(decode, directory / DECODE)


def make_simulator(run: Path | str, world: World = "learned", *, episodes: int = 1, **options: Any) -> AnySimulator:
    """Either simulator of a run's robots, with the same robots, ranges, starts and image size.

    Raises ConfigError for another word, and for "true" if a robot has no true simulator, if the robots have different
    ones, or if native actions are to be given one by one: a step of the true simulator is a frame of the model.
    """
    require_choice(world, get_args(World), "world")
    require(
        world == "learned" or options.get("rate", "model") == "model",
        "rate='native' is supported only by the learned simulator; a step of the true simulator is a frame of the "
        "model",
    )
    learned = load_simulator(run, episodes=episodes, **options)
    return learned if world == "learned" else true_simulator(learned, tuple(learned.robots.values()), episodes)


def true_simulator(learned: Simulator, robots: Sequence[Robot], episodes: int = 1) -> TrueSimulator:
    """The true simulator of some robots of a learned one, with the same view."""
    size = learned.tokenizer.image_size
    true = true_worlds(robots, episodes=episodes, image_size=size, outside=learned.outside)
    true.starts = learned.starts
    return true


def true_worlds(robots: Sequence[Robot], **options: Any) -> TrueSimulator:
    """The true simulator of `robots`, which are all from the suite or all from physics simulators. Raises ConfigError
    otherwise."""
    physics = bool(robots) and all(robot.name in PHYSICS for robot in robots)
    mixed = not physics and any(robot.name in PHYSICS for robot in robots)
    require(
        not mixed,
        "no single simulator has both robots of the suite and of physics simulators: "
        f"{', '.join(r.name for r in robots)}",
    )
    return (PhysicsSimulator if physics else SuiteSimulator)(robots, **options)


def has_truth(robot: Robot) -> bool:
    """Whether this robot has a true simulator here: in the suite, or in a physics simulator that is installed."""
    return in_suite(robot) or can_simulate(robot)


def in_suite(robot: Robot) -> bool:
    return robot.name in SPECS and SPECS[robot.name].action_dim == robot.action_dim


def true_starts(robot: Robot, count: int, frames: int, size: int, *, seed: int = 0) -> list[Start]:
    """Starts of `frames` frames of `size` pixels: from those of the suite's first `count` held-out episodes that are
    long enough (`suite_starts`), or from `count` new episodes of the robot's physics simulator."""
    if not in_suite(robot):
        return physics_starts(robot.name, count, frames, stride=robot.stride, image_size=size, seed=seed)
    made = suite_starts(robot.name, count, frames, stride=robot.stride, seed=seed)
    return [Start(s.robot, fit_images(s.images, size), s.actions, s.seed) for s in made]


def describe_robots(simulator: Simulator, workspace: Workspace) -> list[Robot]:
    """The robots of a simulator, with the recorded ranges if the study's tokens are available."""
    store = _find_store(workspace)
    return [_describe(entry, store) for entry in simulator.model.table.entries if entry.action_dim]


def _describe(entry: Embodiment, store: TokenStore | None) -> Robot:
    known = Robot.of(entry)
    manifest = store.manifest(entry.name) if store is not None and entry.name in store.names else None
    recorded = manifest is not None and len(manifest.action_min) == entry.action_dim
    low, high = (manifest.action_min, manifest.action_max) if recorded else (known.low, known.high)
    if entry.name in SPECS:
        return suite_robot(entry.name, low, high, entry.mean, entry.stride, recorded=recorded)
    hz = manifest.spec.hz if manifest is not None else 0.0
    return Robot(entry.name, entry.stride, low, high, rest_action(low, high, entry.mean), hz=hz, recorded=recorded)


def mark_absolute_actions(simulator: Simulator, run: Path | str) -> None:
    """Marks robots whose actions are absolute targets, judged by the study's held-out episodes (`Robot.keeps`): on the
    page keys then move the last target and letting go keeps it, where `rest` would be a jump.

    Robots described in a file of the run, and those of the suite, have the mark already. No simulated frame depends on
    it.
    """
    if (Path(run) / ROBOTS).exists():  # then the store, which may be unfinished, is not opened
        return
    store = _find_store(Workspace.of_run(Path(run)))
    if store is None:
        return
    recorded = [name for name in simulator.robots if name not in SPECS and name in store.names]
    absolute = [name for name in recorded if _are_absolute(store, name)]
    simulator.update_robots([replace(simulator.robots[name], keeps=True) for name in absolute])


def _find_store(workspace: Workspace) -> TokenStore | None:
    return TokenStore(workspace.store) if workspace.store.is_dir() else None


def _are_absolute(store: TokenStore, name: str) -> bool:
    """Whether most action values drift, as absolute targets do, and do not jump around zero, as deltas do."""
    count = min(len(store.manifest(name).val.episodes), STARTS_PER_ROBOT)
    hints = [f.hint for f in dimension_facts([np.asarray(store.episode(name, "val", i).actions) for i in range(count)])]
    return 2 * hints.count("absolute") > len(hints)


def find_starts(simulator: Simulator, workspace: Workspace) -> tuple[Start, ...]:
    """Starts of every robot: from held-out episodes of its true simulator, otherwise from those whose frames the token
    store kept."""
    store = _find_store(workspace)
    starts: list[Start] = []
    for robot in simulator.robots.values():
        if has_truth(robot):
            starts += true_starts(robot, STARTS_PER_ROBOT, START_FRAMES, simulator.tokenizer.image_size)
        elif store is not None and robot.name in store.names:
            starts += _stored_starts(store, robot, simulator.tokenizer.image_shape)
    return tuple(starts)


def held_out(robot: Robot, size: int, frames: int, count: int) -> tuple[list[Start], np.ndarray]:
    """At most `count` starts of episodes that no suite of seed 0 has, with images of `size` pixels, and the actions of
    the `frames` after each, chunks [n, frames, stride, A]. Fewer where the robot's episodes are too short."""
    whole = suite_starts(robot.name, 16 * count, START_FRAMES + frames, stride=robot.stride, seed=1, most=count)
    given = (START_FRAMES - 1) * robot.stride
    starts = [Start(s.robot, fit_images(s.images[:START_FRAMES], size), s.actions[:given], s.seed) for s in whole]
    chunks = [s.actions[given : given + frames * robot.stride] for s in whole]
    return starts, np.array(chunks, np.float32).reshape(len(starts), frames, robot.stride, robot.action_dim)


def _stored_starts(store: TokenStore, robot: Robot, shape: tuple[int, int]) -> list[Start]:
    manifest, starts = store.manifest(robot.name), []
    every, rest = divmod(robot.stride, manifest.frame_step)
    if rest:
        return []
    for i in range(len(manifest.val.episodes)):
        episode = store.episode(robot.name, "val", i)
        frames = None if episode.frames is None else episode.frames[: START_FRAMES * every : every]
        if frames is None or len(frames) < START_FRAMES or frames.shape[1:3] != shape:
            continue
        starts.append(
            Start(robot.name, np.array(frames), np.array(episode.actions[: (START_FRAMES - 1) * robot.stride]))
        )
        if len(starts) == STARTS_PER_ROBOT:
            break
    return starts
