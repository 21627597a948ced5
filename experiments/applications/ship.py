"""Makes the model of `make play` small enough for the repository, and measures its quality.

Command: hma train --preset play --out runs/play
Command: python -m experiments.applications.ship runs/play/model --out runs/shipped --unmask-steps 8 --temperature 0.7
Cost: the first an hour and a half of one core, including its tokenizer, resumed where it was stopped; the second three
      minutes. For the served model: docs/simulator.md.
Expected: frames under held-out actions are nearer to the truth than the last frame repeated, and than frames under
          actions of other episodes.

Writes weights (in half precision; their average, if the run keeps one), tokenizer, the robots' commands, starts of
held-out episodes, how frames are filled, and report.json: PSNR against the true simulator by frame, for the model, a
still picture and shuffled actions, over held-out episodes of each robot; frames per second at batch 1.
clip.gif shows the first of these episodes.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
from PIL import Image
from tyro.conf import FlagCreatePairsOff, Positional, arg

from data_pipelines.publishing.files import publish
from data_pipelines.suite.simulator import SPECS, SuiteSimulator
from experiments.bench.simulate import time_simulator
from experiments.report.pieces import animation
from experiments.running.machine import describe_machine
from experiments.running.run_options import UNSET
from experiments.simulators import held_out, in_suite, load_simulator, save_beside, true_simulator
from experiments.terminal.command_line import run_module
from experiments.terminal.exit_code import exit_code_of
from hma_jax.config import DecodeConfig, require
from hma_jax.evaluation.metrics import psnr
from hma_jax.model.params import Params
from hma_jax.runtime.files import write_file
from hma_jax.simulator.folder import DEFAULT_DECODE, change_decode
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.simulator import Simulator
from hma_jax.simulator.starts import Start
from hma_jax.training.checkpoints import Checkpoints
from hma_jax.training.hashes import write_list
from hma_jax.training.run_lock import CHECKPOINTS
from hma_jax.training.runs import describe_run, load_run

REPORT, CLIP = "report.json", "clip.gif"
LARGEST = 10 * 2**20
"""Bytes of everything that is shipped."""

EPISODES = 8
FRAMES = 24
"""Frames after the start that are compared."""

TIMED = 60
"""Frames over which frames per second are measured."""

ZOOM, COLOURS = 2, 128  # of the clip


class Shipped(NamedTuple):
    """What a checkpoint for inference holds: the averaged weights if `train.ema_decay` is not 0, as `load_run` takes
    them."""

    params: Params


def ship(
    source: Path,
    out: Path,
    decode: DecodeConfig | None = None,
    add: Callable[[Path], None] = lambda made: None,
    *,
    replace: bool = False,
) -> None:
    """Writes the model to `out`, completely or not at all, with what `add` writes beside it. `replace`: in place of an
    earlier shipped model.

    Raises ConfigError if `out` holds anything that may not be replaced, for a robot outside the suite, and if the model
    would be too large.
    """
    if out.exists() and any(out.iterdir()):
        require(
            (out / REPORT).is_file(),
            f"--out {out} has no {REPORT}, so it is not a shipped model, and it would be overwritten; choose another "
            "--out",
        )
        require(replace, f"--out {out} holds a shipped model; choose another --out, or add --replace to replace it")
    run = load_run(source, "auto")
    simulator = load_simulator(source)
    foreign = [name for name, robot in simulator.robots.items() if not in_suite(robot)]
    require(
        not foreign,
        f"{', '.join(foreign)}: not robots of the suite, so there is no true simulator to compare with. A model of them is "
        "handed on as docs/checkpoints.md says, in A simulator to hand on",
    )
    aside = out.with_name(f".{out.name}.making")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        described = describe_run(run.model, run.train, run.table, run.provenance)
        with Checkpoints(aside / CHECKPOINTS, described) as checkpoints:
            checkpoints.save(run.step, Shipped(to_half_precision(run.params)))
        strip_machine_paths(aside / CHECKPOINTS / str(run.step))
        save_beside(simulator, aside, decode)
        add(aside)
        size = sum(path.stat().st_size for path in aside.rglob("*") if path.is_file())
        require(
            size <= LARGEST, f"the model has {size:,} bytes, more than the {LARGEST:,} bytes allowed for the repository"
        )
        publish(aside, out)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def to_half_precision(params: Params) -> Params:
    """The parameters in float16, which `load_model` reads as float32. Raises ConfigError for a weight that is too large
    for it."""
    half = jax.tree.map(lambda x: np.asarray(x, np.float16), params)
    require(all(np.isfinite(x).all() for x in jax.tree.leaves(half)), "a weight is too large for float16")
    return half


def strip_machine_paths(checkpoint: Path) -> None:
    """Removes paths of this machine from the marker files by which orbax marks a finished checkpoint."""
    for mark in checkpoint.rglob("commit_success.txt"):
        write_file(mark, "finished\n")
    write_list(checkpoint)


class Rollouts(NamedTuple):
    """Rollouts under held-out actions, uint8 [1 + FRAMES, EPISODES, H, W, 3]: the first frames, and one after each
    chunk."""

    true: np.ndarray
    model: np.ndarray
    shuffled: np.ndarray  # the model's frames under the actions of the episode before


def roll_out(simulator: Simulator, robot: Robot) -> Rollouts:
    starts, futures = held_out(robot, simulator.tokenizer.image_size, FRAMES, EPISODES)
    longest = SPECS[robot.name].seconds[1]
    require(len(starts) == EPISODES, f"{robot.name}: too few of its episodes (at most {longest:g} s) are long enough")
    others = np.roll(futures, 1, axis=0)
    runs = (true_simulator(simulator, [robot], len(starts)), futures), (simulator, futures), (simulator, others)
    return Rollouts(*(np.stack([image.copy() for image in frames_of(by, starts, chunks)]) for by, chunks in runs))


def make_report(run: Path, simulator: Simulator, rollouts: Mapping[str, Rollouts]) -> dict[str, Any]:
    """The content of report.json."""
    return {
        "step": simulator.model.step,
        "parameters": simulator.model.declared.count(),
        "pixels": simulator.tokenizer.image_size,
        "episodes": EPISODES,
        "frames": FRAMES,
        "robots": {name: psnr_by_frame(one) for name, one in rollouts.items()},
        "frames_per_second": round(time_simulator(run, 1, TIMED).frames_per_second, 1),
        "machine": describe_machine(jax.devices()),
    }


def psnr_by_frame(rollouts: Rollouts) -> dict[str, list[float]]:
    """Mean PSNR in dB by frame after the start, against the true simulator under the same held-out actions."""

    def against_truth(images: np.ndarray) -> list[float]:
        return [round(float(np.mean(psnr(a, b))), 2) for a, b in zip(images[1:], rollouts.true[1:], strict=True)]

    still = np.broadcast_to(rollouts.true[:1], rollouts.true.shape)
    kinds = {"model": rollouts.model, "still": still, "shuffled": rollouts.shuffled}
    return {kind: against_truth(images) for kind, images in kinds.items()}


def write_clip(rollouts: Mapping[str, Rollouts], path: Path, hz: float) -> None:
    """A GIF of the first episode of every robot, `hz` frames per second, a column each: the truth above, below it the
    model."""
    columns = [np.concatenate([one.true[:, 0], one.model[:, 0]], axis=1) for one in rollouts.values()]
    film = np.concatenate(columns, axis=2)
    size = (ZOOM * film.shape[2], ZOOM * film.shape[1])
    smooth = [Image.fromarray(frame).resize(size, Image.Resampling.BICUBIC) for frame in film]  # as the page shows them
    palette = Image.fromarray(np.concatenate(smooth)).quantize(COLOURS)
    larger = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in smooth]
    write_file(path, animation(larger, round(1000 / hz), "GIF"))


def frames_of(simulator: Simulator | SuiteSimulator, starts: Sequence[Start], futures: np.ndarray):
    """The frames of all episodes [B, H, W, 3], the first ones and those after each chunk."""
    yield simulator.reset(starts)
    for t in range(futures.shape[1]):
        yield simulator.step(list(futures[:, t]))


def describe(run: Path) -> None:
    """Writes report.json and clip.gif beside a model that is about to be shipped, and prints what they say."""
    simulator = load_simulator(run, episodes=EPISODES)
    rollouts = {name: roll_out(simulator, robot) for name, robot in simulator.robots.items()}
    report = make_report(run, simulator, rollouts)
    write_file(run / REPORT, json.dumps(report, indent=1) + "\n")
    write_clip(rollouts, run / CLIP, min(robot.hz / robot.stride for robot in simulator.robots.values()))
    for name, by in report["robots"].items():
        means = ", ".join(f"{kind} {np.mean(values):.2f}" for kind, values in by.items())
        print(f"{name:16s} PSNR over {FRAMES} frames: {means} dB")
    print(f"{report['frames_per_second']} frames/s at batch 1; step {report['step']:,}")


def ship_run(
    run: Annotated[Positional[Path], arg(metavar="RUN")],
    out: Annotated[Path, arg(metavar="DIR")],
    unmask_steps: Annotated[int, arg(name="unmask-steps", metavar="M")] = DEFAULT_DECODE.unmask_steps,
    temperature: float = DEFAULT_DECODE.temperature,
    replace: Annotated[FlagCreatePairsOff[bool], UNSET] = False,
) -> None:
    """Makes a run small enough for the repository, and describes it.

    Args:
        run: Directory of a training run.
        out: Directory for the model.
        unmask_steps: Unmasking steps per frame; more are slower.
        temperature: Temperature at which tokens or latents are sampled; 0: greedy decoding.
        replace: Replace the shipped model that --out holds.
    """
    decode = change_decode(DEFAULT_DECODE, temperature, unmask_steps=unmask_steps)
    ship(run, out, decode, describe, replace=replace)


def main() -> None:
    run_module(ship_run, __doc__)


if __name__ == "__main__":
    sys.exit(exit_code_of(main, resumes=False))
