"""Directories that applications write into: made, and held, before a model is loaded."""

from collections.abc import Callable
from pathlib import Path

import pytest

from experiments.applications.detector import train_for_run
from experiments.applications.endurance.__main__ import drive_run
from experiments.applications.endurance.hidden import measure_hidden
from experiments.applications.in_place import measure_run
from experiments.applications.own_policy import compare_in_run as compare_policies
from experiments.applications.plan_actions import plan_in_run
from experiments.applications.synthetic import compare_in_run as compare_synthetic
from experiments.cli.generate import generate
from experiments.cli.judge import judge
from experiments.running.workspace import Workspace
from hma_jax.config import ConfigError
from hma_jax.runtime.locks import Held

NOWHERE = Path("nowhere")
HOLDING: dict[str, Callable[[Path], None]] = {
    "judge": lambda out: judge(NOWHERE, robot="pusher_sand", out=out),
    "own_policy": lambda out: compare_policies(NOWHERE, out),
    "plan_actions": lambda out: plan_in_run(NOWHERE, out),
    "synthetic": lambda out: compare_synthetic(NOWHERE, out),
    "endurance": lambda out: drive_run(NOWHERE, out),
    "hidden": lambda out: measure_hidden(NOWHERE, out),
    "in_place": lambda out: measure_run(NOWHERE, out),
    "detector": lambda out: train_for_run(NOWHERE, out),
}
BY_NAME = ("endurance", "hidden")
"""Several of these may write into one directory, each under another --name."""

WRITING = HOLDING | {"generate": lambda out: generate(NOWHERE, actions="nowhere", out=out, clips=0)}


@pytest.mark.parametrize("command", WRITING)
def test_a_file_in_place_of_the_directory_is_said_before_a_model_is_loaded(command, tmp_path):
    """It was said, by some commands, after hours of work."""
    out = tmp_path / "out"
    out.touch()
    with pytest.raises(ConfigError, match=r"cannot write to \S+/out: \S+/out is a file .*; choose another --out"):
        WRITING[command](out)


@pytest.mark.parametrize("command", HOLDING)
def test_a_second_command_is_refused_in_a_directory_in_use(command, tmp_path):
    """Both removed what the other was reading."""
    lock = {"lock": ".model.lock"} if command in BY_NAME else {}
    with Workspace(tmp_path).locked(**lock), pytest.raises(Held, match="another command is using"):
        HOLDING[command](tmp_path)
