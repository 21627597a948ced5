"""A tokenising job in a process of its own, which tests kill or run beside others.

As a command it does the same with a real tokenizer, for the test of twenty kills:
`python -m tests.data_pipelines.tokens.job_process RLDS STORE TOKENIZER [unfinished]`. It prints a line when it is at
work and one after each episode; "unfinished", it waits before the last one until it is killed.
"""

from __future__ import annotations

import multiprocessing
import sys
import time
from pathlib import Path

import numpy as np
import tensorflow_datasets  # noqa: F401  once, in the server that processes are forked from

from data_pipelines.tokens.manifest import Manifest
from tests.data_pipelines.fakes import FakeTokenizer, make_spec
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec(hz=4)
PART_SIZE = 2000  # bytes: about two episodes


class SlowTokenizer(FakeTokenizer):
    def encode(self, images: np.ndarray) -> np.ndarray:
        time.sleep(0.01)
        return super().encode(images)


def run(rlds: Path, store: Path, tokenizer=None, **options) -> Manifest | None:
    options = {"part_size": PART_SIZE, "batch": 4} | options
    return tokenize_dataset(SPEC, rlds, tokenizer or FakeTokenizer(), store, **options)


def start(rlds: Path, store: Path, **options) -> multiprocessing.Process:
    """`run` with a slow tokenizer. Not forked from here: ArrayRecord's threads do not survive that."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    process = context.Process(target=run, args=(rlds, store, SlowTokenizer()), kwargs=options)
    process.start()
    return process


if __name__ == "__main__":
    from hma_jax.tokenizers.io import load_tokenizer

    rlds, store, directory = map(Path, sys.argv[1:4])
    unfinished = sys.argv[4:] == ["unfinished"]
    tokenizer = load_tokenizer(directory)
    tokenizer.encode(np.zeros((64, tokenizer.image_size, tokenizer.image_size, 3), np.uint8))  # compiled

    def progress(done: int, total: int) -> None:
        print(f"{done} of {total}", flush=True)
        if unfinished and done >= total - 1:
            time.sleep(3600)

    run(rlds, store, tokenizer, part_size=60_000, batch=64, progress=progress)
