"""kill -9 in the middle of training, then the same command again."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from orbax.checkpoint import v1 as ocp

from hma_jax.training.reading import find_damage, list_steps
from tests.integration.train_slowly import train

pytestmark = pytest.mark.exact

ROOT = Path(__file__).parents[2]


def start(run_dir: Path) -> subprocess.Popen:
    command = [sys.executable, "-m", "tests.integration.train_slowly", str(run_dir)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def finish(run_dir: Path) -> None:
    process = start(run_dir)
    process.communicate(timeout=300)
    assert process.returncode == 0


def kill_after(run_dir: Path, step: int) -> None:
    process = start(run_dir)
    for line in process.stdout:
        if int(line) >= step:
            process.send_signal(signal.SIGKILL)
            break
    process.wait(timeout=60)
    assert process.returncode == -signal.SIGKILL


@pytest.mark.parametrize("step", [pytest.param(5, marks=pytest.mark.slow), 9])
def test_a_killed_run_continued_is_byte_equal_to_one_never_killed(tmp_path: Path, whole: Path, step: int):
    kill_after(tmp_path, step)
    finish(tmp_path)
    assert (tmp_path / "metrics.jsonl").read_bytes() == (whole / "metrics.jsonl").read_bytes()
    latest = [d / "checkpoints" / str(list_steps(d / "checkpoints")[-1]) for d in (tmp_path, whole)]
    assert [checkpoint.name for checkpoint in latest] == ["12", "12"]
    assert all((checkpoint / "sha256.json").exists() and not find_damage(checkpoint) for checkpoint in latest)
    a, b = map(ocp.load_checkpointables, latest)
    assert a.keys() == b.keys() == {"step", "params", "opt_state"}
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        assert np.asarray(x).tobytes() == np.asarray(y).tobytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """In this process, which compiles as those do."""
    directory = tmp_path_factory.mktemp("whole")
    train(directory)
    return directory
