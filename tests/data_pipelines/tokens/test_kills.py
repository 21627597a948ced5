"""The tokenising job as a user runs it, with a real tokenizer, killed at random."""

from __future__ import annotations

import random
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
from tests.data_pipelines.tokens.job_process import SPEC, contents

CONFIG = TokenizerConfig(image_size=64, downsample=8, channels=32)
KILLS, EPISODES = 20, 160


@pytest.mark.slow
def test_twenty_kills_leave_no_trace(tmp_path):
    tokenizer = tmp_path / "tokenizer"
    save_tokenizer(LfqTokenizer(CONFIG, declare_tokenizer(CONFIG).init(0)), tokenizer)
    rlds = write_rlds(tmp_path / "rlds", SPEC, [40] * EPISODES, shards=4, change=noise)
    process, startup = start(rlds, tmp_path / "undisturbed", tokenizer)
    began = time.monotonic()
    assert process.wait() == 0
    work = time.monotonic() - began
    expected = contents(tmp_path / "undisturbed")
    store, draw, kept = tmp_path / "killed", random.Random(1), []
    for _ in range(KILLS):
        if draw.random() < 0.2:  # while it is still starting
            process = spawn(rlds, store, tokenizer)
            time.sleep(draw.uniform(0, startup))
        else:
            process, _ = start(rlds, store, tokenizer)
            time.sleep(draw.uniform(0, 2 * work / KILLS))
        process.send_signal(signal.SIGKILL)
        assert process.wait() == -signal.SIGKILL, "it ended before it could be killed"
        kept.append(len(list(store.glob(".toy.*/parts/*.json"))))
    assert spawn(rlds, store, tokenizer).wait() == 0
    print(f"{KILLS} kills of a job of {work:.1f} s; finished parts after each, of {EPISODES}: {kept}")
    assert len(set(kept)) > KILLS // 2
    assert contents(store) == expected


def start(rlds: Path, store: Path, tokenizer: Path) -> tuple[subprocess.Popen, float]:
    """A process that has come to its first part, and the seconds that took."""
    began = time.monotonic()
    process = spawn(rlds, store, tokenizer)
    assert process.stdout.readline() == b"at work\n"
    return process, time.monotonic() - began


def spawn(rlds: Path, store: Path, tokenizer: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "tests.data_pipelines.tokens.job_process", rlds, store, tokenizer]
    return subprocess.Popen([str(c) for c in command], stdout=subprocess.PIPE)


def noise(episode: int, features: dict) -> None:
    rng = np.random.default_rng(episode)
    frames = rng.integers(0, 256, (40, 48, 64, 3)).astype(np.uint8)
    features["steps/observation/image"] = [png(frame) for frame in frames]
