"""What `kill_resume` kills: commands of `hma`, small, and what is compared of what they leave."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
from orbax.checkpoint import v1 as ocp

from hma_jax.training.reading import find_damage, list_steps

SMOKE = ("--preset", "smoke")
MACHINE = ("timing.jsonl", "execution.jsonl", ".lock")
"""Files of a run that say when and where it was computed."""

Contents = dict[str, bytes]


@dataclass(frozen=True)
class Subject:
    name: str
    share: float  # of all kills
    at_a_time: int  # kills before it is left to its end
    command: Callable[[Path], tuple[str, ...]]  # for a directory of its own
    contents: Callable[[Path], Contents]  # of that directory, when it is finished


def prepared(root: Path) -> Path:
    """A study with everything that training reads, which subjects share or start from a copy of."""
    return root / "prepared"


def prepare_command(root: Path) -> tuple[str, ...]:
    return ("tokenize", *SMOKE, "--out", str(prepared(root)))


def subjects(root: Path) -> tuple[Subject, ...]:
    def train(place: Path) -> tuple[str, ...]:
        steps = ("--set", "train.steps=120", "--checkpoint-every", "10", "--validate-every", "40")
        return ("train", *SMOKE, "--out", str(prepared(root)), "--run", str(place / "run"), *steps)

    def tokenizer(place: Path) -> tuple[str, ...]:
        settings = ("tokenizer_train.steps=120", "suite.scale=0.01", "suite.validation=2")
        return ("tokenizer", "train", *SMOKE, "--out", str(place / "out"), *_set(*settings))

    def sweep(place: Path) -> tuple[str, ...]:
        out = place / "out"
        if not out.exists():
            shutil.copytree(prepared(root), place / "copy")
            (place / "copy").rename(out)
        settings = _set("trajectory_counts=2", "train.steps=40")
        return ("sweep", "trajectories", *SMOKE, "--out", str(out), *settings)

    return (
        Subject("training", 0.35, 5, train, lambda place: dict(_run(place / "run"))),
        Subject("tokenizer training", 0.25, 5, tokenizer, lambda place: dict(_tokenizer(place / "out"))),
        Subject("sweep", 0.15, 5, sweep, lambda place: dict(_sweep(place / "out"))),
    )


def _set(*settings: str) -> tuple[str, ...]:
    return tuple(word for setting in settings for word in ("--set", setting))


def _run(run: Path) -> Iterator[tuple[str, bytes]]:
    """Loss series, and every array of the last checkpoint, which is whole."""
    for path in sorted(run.iterdir()):
        if path.is_file() and path.name not in MACHINE:
            yield path.name, path.read_bytes()
    step = list_steps(run / "checkpoints")[-1]
    checkpoint = run / "checkpoints" / str(step)
    if find_damage(checkpoint) is not None:
        raise AssertionError(f"{checkpoint}: {find_damage(checkpoint)}")
    yield "last step", str(step).encode()
    for place, leaf in jax.tree.leaves_with_path(ocp.load_checkpointables(checkpoint)):
        yield jax.tree_util.keystr(place), np.asarray(leaf).tobytes()
    left = [p.name for p in (run / "checkpoints").iterdir() if not p.name.isdigit()]
    yield "left over", " ".join(sorted(left)).encode()


def _tokenizer(out: Path) -> Iterator[tuple[str, bytes]]:
    """The suite, byte by byte; the tokenizer, and how it was trained."""
    for path in sorted((out / "suite").rglob("*")):
        if path.is_file():
            yield str(path.relative_to(out)), path.read_bytes()
    yield from _run(out / "tokenizer")
    left = [p.name for p in out.iterdir() if p.name not in ("suite", "tokenizer", ".lock")]
    yield "left over beside it", " ".join(sorted(left)).encode()


def _sweep(out: Path) -> Iterator[tuple[str, bytes]]:
    """The CSV, and of every trial its windows, losses and parameters."""
    yield "results.csv", (out / "results.csv").read_bytes()
    for trial in sorted((out / "trials").iterdir()):
        yield f"{trial.name}/windows", (trial / "windows.parquet").read_bytes()
        for name, value in _run(trial / "run"):
            yield f"{trial.name}/{name}", value
