"""The tokenising job as a user runs it, with a real tokenizer, killed at random."""

from __future__ import annotations

import random
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from hma_jax.config import TokenizerConfig
from hma_jax.tokenizers.autoencoder import declare_tokenizer
from hma_jax.tokenizers.io import save_tokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer
from tests.data_pipelines.fakes import png, write_rlds
from tests.data_pipelines.tokens.job_process import SPEC
from tests.files import contents

CONFIG = TokenizerConfig(image_size=64, downsample=8, channels=32)
KILLS, EPISODES = 20, 160
MOST = 12
"""Episodes that are finished, at most, before a kill."""


@pytest.mark.slow
def test_twenty_kills_leave_no_trace(tmp_path):
    tokenizer = tmp_path / "tokenizer"
    save_tokenizer(LfqTokenizer(CONFIG, declare_tokenizer(CONFIG).init(0)), tokenizer)
    rlds = write_rlds(tmp_path / "rlds", SPEC, [40] * EPISODES, shards=4, change=noise)
    process, startup = start(rlds, tmp_path / "undisturbed", tokenizer)
    assert process.wait() == 0
    expected = contents(tmp_path / "undisturbed")
    store, draw, kept = tmp_path / "killed", random.Random(1), [0]
    for _ in range(KILLS):
        if draw.random() < 0.2:  # while it is still starting
            process = spawn(rlds, store, tokenizer, "unfinished")
            # Until its first part at most, should it start faster this time: beside other work it would be done.
            select.select([process.stdout], [], [], draw.uniform(0, startup))
        else:  # somewhere in the episode after so many: by its own count, however fast it is beside other work
            episodes = min(draw.randint(1, MOST), EPISODES - 1 - kept[-1])
            process, _ = start(rlds, store, tokenizer, "unfinished")
            began = time.monotonic()
            for _ in range(episodes):
                assert process.stdout.readline()
            time.sleep(draw.uniform(0, 1) * (time.monotonic() - began) / max(episodes, 1))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL
        kept.append(len(list(store.glob(".toy.*/parts/*.json"))))
    assert spawn(rlds, store, tokenizer).wait() == 0
    print(f"finished parts after each of {KILLS} kills, of {EPISODES}: {kept[1:]}")
    assert len(set(kept)) > KILLS // 2
    assert contents(store) == expected


def start(rlds: Path, store: Path, tokenizer: Path, *options: str) -> tuple[subprocess.Popen, float]:
    """A process that has come to its first part, and the seconds that took."""
    began = time.monotonic()
    process = spawn(rlds, store, tokenizer, *options)
    assert process.stdout.readline().endswith(f" of {EPISODES}\n".encode())
    return process, time.monotonic() - began


def spawn(rlds: Path, store: Path, tokenizer: Path, *options: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "tests.data_pipelines.tokens.job_process", rlds, store, tokenizer, *options]
    return subprocess.Popen([str(c) for c in command], stdout=subprocess.PIPE)


def noise(episode: int, features: dict) -> None:
    rng = np.random.default_rng(episode)
    frames = rng.integers(0, 256, (40, 48, 64, 3)).astype(np.uint8)
    features["steps/observation/image"] = [png(frame) for frame in frames]
