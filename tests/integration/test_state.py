"""What a process holds and leaves behind: one state in memory, one message when the disk is full."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from hma_jax.training.loop import LoopOptions
from hma_jax.training.reading import find_damage, list_steps
from tests.toy import fit_toy

ROOT = Path(__file__).parents[2]


def run(program: str, *arguments: object) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", f"tests.integration.{program}", *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)


def test_a_new_run_and_a_resumed_one_hold_one_state(tmp_path: Path):
    done = run("live_bytes", tmp_path / "run")
    assert done.returncode == 0, done.stderr[-3000:]
    said = [json.loads(line) for line in done.stdout.splitlines()[-2:]]
    assert [start["resumed_from"] for start in said] == [0, 2]
    assert all(1 <= start["states"] <= 1.05 for start in said), said


@pytest.mark.parametrize(
    ("mode", "reason"),
    [
        ("full", r"File too large\. It takes about 8 kB, and [0-9.]+ .?B are free there"),
        pytest.param("read-only", "Permission denied", marks=pytest.mark.slow),
    ],
)
def test_a_disk_that_takes_no_more_is_one_message_and_the_last_checkpoint_is_kept(mode, reason, tmp_path: Path):
    failed = run("train_full_disk", tmp_path, mode)
    assert failed.returncode == 1
    assert failed.stderr.count("\n") == 1, failed.stderr[-3000:]
    assert failed.stderr.startswith(f"error: the checkpoint of step 4 could not be written to {tmp_path}/checkpoints: ")
    assert re.search(rf": {reason}.* Make sure that there is space and permission", failed.stderr), failed.stderr
    assert failed.stderr.endswith("the same command again: it continues from step 2, the last complete checkpoint\n")
    assert list_steps(tmp_path / "checkpoints") == [2]
    assert find_damage(tmp_path / "checkpoints" / "2") is None
    (tmp_path / "checkpoints").chmod(0o755)
    again = fit_toy(tmp_path, options=LoopOptions(checkpoint_every=2))
    assert again.resumed_from == 2 and list_steps(tmp_path / "checkpoints") == [4, 6]
    assert {p.name for p in (tmp_path / "checkpoints").iterdir()} == {"4", "6"}
