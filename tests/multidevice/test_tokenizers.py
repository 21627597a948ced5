"""Tokenizers on eight (fake) devices: the same bytes as on one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest


def run_on(devices: int) -> dict:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    done = subprocess.run(
        [sys.executable, "-m", "tests.multidevice.tokenize_on_devices"],
        env=os.environ | {"XLA_FLAGS": flags},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.slow
def test_tokens_and_frames_do_not_depend_on_the_number_of_devices():
    one, eight = run_on(1), run_on(8)
    assert (one.pop("devices"), eight.pop("devices")) == (1, 8)
    assert (one.pop("at_once"), eight.pop("at_once")) == (2, 16)
    assert eight == one
