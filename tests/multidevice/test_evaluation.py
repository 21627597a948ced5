"""The protocol on eight (fake) devices: every window's numbers as on one."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from hma_jax.evaluation.windows import WindowTable


def run_on(devices: int, mesh: str, path: Path) -> WindowTable:
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    done = subprocess.run(
        [sys.executable, "-m", "tests.multidevice.evaluate_on_mesh", mesh, str(path)],
        env=os.environ | {"XLA_FLAGS": flags},
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert int(done.stdout) == devices
    return WindowTable.load(path)


@pytest.mark.slow
def test_numbers_do_not_depend_on_the_number_of_devices(tmp_path: Path):
    """Batches of 5 windows: with 8 devices, padded; in groups of 1 and of 4 windows."""
    one = run_on(1, "1,1,1", tmp_path / "one.csv.gz")
    eight = run_on(8, "2,2,2", tmp_path / "eight.csv.gz")
    assert eight.names == one.names and len(one) == 14
    for metric, column in one.metrics.items():
        np.testing.assert_allclose(eight.metrics[metric], column, rtol=1e-5, atol=1e-5, err_msg=metric)
