"""The protocol in two real processes: every window's numbers and every clip as in one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hma_jax.evaluation.windows import WindowTable
from tests.conftest import FAST_COMPILATION
from tests.multihost.processes import run


def evaluate(path: Path, processes: int, devices: int) -> tuple[WindowTable, dict[str, np.ndarray]]:
    run(
        "tests.multihost.evaluate_together", [str(path)], processes=processes, devices=devices,
        flags=" ".join(FAST_COMPILATION),
    )  # fmt: skip
    return WindowTable.load(path), dict(np.load(f"{path}.npz"))


@pytest.mark.slow
def test_two_processes_evaluate_as_one_does(tmp_path: Path):
    (one, one_clips), (two, two_clips) = evaluate(tmp_path / "one", 1, 2), evaluate(tmp_path / "two", 2, 1)
    assert one.names == two.names and len(one) == 6
    for metric, column in one.metrics.items():
        np.testing.assert_allclose(two.metrics[metric], column, rtol=1e-5, atol=1e-5, err_msg=metric)
    assert one_clips.keys() == two_clips.keys() >= {"true", "predicted"}
    for kind, clip in one_clips.items():
        np.testing.assert_array_equal(two_clips[kind], clip)
