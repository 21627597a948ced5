"""The protocol on eight (fake) devices: every window's numbers as on one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hma_jax.evaluation.windows import WindowTable
from tests.multidevice.run import run_on


def evaluate_on(devices: int, mesh: str, path: Path, *stored: str) -> tuple[WindowTable, int]:
    """(the windows' numbers, gathers of parameters in loops)"""
    there, gathers = run_on(devices, "evaluate_on_mesh", mesh, str(path), *stored)
    assert there == devices
    return WindowTable.load(path), gathers


@pytest.mark.slow
def test_numbers_do_not_depend_on_the_number_of_devices(tmp_path: Path):
    """Batches of 5 windows: with 8 devices, padded; in groups of 1 and of 4 windows."""
    one, _ = evaluate_on(1, "1,1,1", tmp_path / "one.csv.gz")
    # Parameters whole along `fsdp`, or gathered in every pass.
    for mesh, *stored in (("2,2,2",), ("2,2,2", "stored"), ("1,8,1",)):
        eight, gathers = evaluate_on(8, mesh, tmp_path / "eight.csv.gz", *stored)
        assert gathers > 0 or not stored
        assert gathers == 0 or mesh != "1,8,1"
        assert eight.names == one.names and len(one) == 14
        for metric, column in one.metrics.items():
            np.testing.assert_allclose(eight.metrics[metric], column, rtol=1e-5, atol=1e-5, err_msg=metric)
