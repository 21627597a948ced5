"""One of several processes that tokenise the same datasets: logs which parts it makes, and may die in a save.

Started by `tokenize_kills`, from a server that has the imports, so that starting one takes no time.
"""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tensorflow_datasets  # noqa: F401  once, in the server that processes are forked from

from data_pipelines.registry import get_spec
from data_pipelines.tokens import part_maker
from tests.data_pipelines.fakes import FakeTokenizer
from tests.data_pipelines.tokenizing import tokenize_dataset

STEPS_OF_A_SAVE = ("replace", "rename", "fsync", "unlink")


@dataclass(frozen=True)
class Work:
    """What every process does."""

    suite: Path
    names: tuple[str, ...]
    store: Path
    log: Path
    part_size: int
    pause: float  # seconds for a batch of frames: so long that processes meet
    one_split: bool = False  # as fakes are written, not as the registry says


class SlowTokenizer(FakeTokenizer):
    def __init__(self, pause: float):
        super().__init__()
        self.pause = pause

    def encode(self, images: np.ndarray) -> np.ndarray:
        time.sleep(self.pause)
        return super().encode(images)


def tokenize(work: Work, dies_in: int = 0) -> None:
    """All datasets, as `hma tokenize` does. `dies_in`: kills itself before this step of its saves, from 1 on."""
    log_parts(work.log)
    if dies_in:
        end_in_save(work.log, dies_in)
    tokenizer = SlowTokenizer(work.pause)

    def make(name: str, wait: bool) -> bool:
        spec = get_spec(name)
        if work.one_split:
            spec = replace(spec, split="train", val_split="")
        manifest = tokenize_dataset(
            spec, work.suite / name, tokenizer, work.store,
            batch=16, threads=1, part_size=work.part_size, wait=wait,
        )  # fmt: skip
        return manifest is not None

    try:
        for name in [name for name in work.names if not make(name, wait=False)]:
            make(name, wait=True)
    except KeyboardInterrupt:
        pass  # it leaves


def log_parts(log: Path) -> None:
    make = part_maker.write_part

    def logged(directory: Path, part, *rest):
        place = f"{directory.name.split('.')[1]}/{part.number}"
        write(log, "begin", place)
        facts = make(directory, part, *rest)
        write(log, "end", place)
        return facts

    part_maker.write_part = logged


def end_in_save(log: Path, at: int, how: signal.Signals = signal.SIGKILL) -> Callable[[], int]:
    """From now on counts the steps of saves, and sends itself the signal `how` before the one numbered `at`, if
    there are so many (0: before none). Returns what tells how many there were."""
    done = 0

    def patched(call: Callable) -> Callable:
        def step(*arguments: object, **options: object) -> object:
            nonlocal done
            done += 1
            if done == at:
                write(log, "dies", call.__name__)
                os.kill(os.getpid(), how)
            return call(*arguments, **options)

        return step

    for name in STEPS_OF_A_SAVE:
        setattr(os, name, patched(getattr(os, name)))
    return lambda: done


def write(log: Path, what: str, place: str = "") -> None:
    """One line, whole: the file is open for appending."""
    with open(log, "ab", buffering=0) as file:
        file.write(json.dumps({"process": os.getpid(), "what": what, "place": place}).encode() + b"\n")


def read(log: Path) -> Sequence[dict]:
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []
