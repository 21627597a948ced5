"""The table of simulated robots: what can be checked without a simulator."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import pytest

from data_pipelines.registry import all_specs, get_spec
from data_pipelines.simulators import EMBODIMENTS, select
from data_pipelines.simulators.packages import MODULES
from experiments.cli.data.sim import PRESETS
from hma_jax.config import ConfigError

SIX_SECONDS = 6.0
"""Twelve frames at 2 Hz, each with its chunk of actions."""


def test_forty_robots_from_2_to_28_dimensions_and_more():
    names = [spec.name for spec in EMBODIMENTS]
    assert len(names) == len(set(names)) >= 40
    dims = {spec.action_dim for spec in EMBODIMENTS}
    assert min(dims) == 2 and max(dims) >= 28 and len(dims) >= 15
    spaces = {(s.package, tuple(s.envs), repr(s.kwargs), s.layout) for s in EMBODIMENTS}
    assert len(spaces) == len(names), "two rows are the same robot"


def test_the_packages_of_the_issue_and_the_tasks_of_the_paper_are_there():
    packages = {spec.package for spec in EMBODIMENTS}
    assert packages == set(MODULES)
    (lift,) = select(["robosuite_panda_lift"])
    assert (lift.envs, lift.kwargs["robots"], lift.action_dim) == (("Lift",), "Panda", 7)
    assert lift.expert and lift.success
    (world,) = select(["metaworld_sawyer"])
    assert len(set(world.envs)) == 50 and world.success


def test_every_robot_has_a_registry_entry_with_its_actions():
    known = [spec.name for spec in all_specs()]
    assert len(known) == len(set(known))
    for s in EMBODIMENTS:
        entry = get_spec(s.name)
        assert (entry.hz, entry.action_dims, entry.action_keys) == (s.hz, (s.action_dim,), ("action",))
        assert entry.image_key == "observation/image"


@pytest.mark.parametrize("spec", EMBODIMENTS, ids=lambda spec: spec.name)
def test_every_episode_is_long_enough_for_a_window(spec):
    entry = get_spec(spec.name)
    frames = 12
    assert spec.steps[0] >= frames * entry.stride
    assert spec.seconds[0] > SIX_SECONDS
    assert abs(spec.hz / entry.stride - 2) < 0.25, "its frames are not near 2 Hz"


def test_presets_name_robots_of_the_table():
    assert len(select(PRESETS["smoke"].names)) >= 10
    assert select(PRESETS["full"].names) == EMBODIMENTS
    assert PRESETS["full"].episodes == 20 and PRESETS["full"].size == 128


def test_unknown_names_and_impossible_rows_are_refused():
    with pytest.raises(ConfigError, match=r"unknown simulator\(s\) dmc_reecher; the table has pusht"):
        select(["dmc_reecher"])
    with pytest.raises(ConfigError, match="hz must lie in 1..60"):
        replace(EMBODIMENTS[0], hz=100)
    with pytest.raises(ConfigError, match="not snake_case"):
        replace(EMBODIMENTS[0], name="Push-T")


def test_the_table_and_the_registry_load_no_simulator_and_no_jax():
    code = (
        "import sys; import data_pipelines.registry; "
        "print([m for m in ('mujoco', 'gymnasium', 'dm_control', 'jax', 'tensorflow') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
