"""The same program on eight (fake) devices: equal losses, every large array split."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError, DiffusionConfig, MeshConfig, ModelConfig
from hma_jax.model.hma import declare_model
from hma_jax.runtime.sharding import audit_sharding, describe_sharding, make_mesh, plan_sharding
from tests.tiny import TABLE, model_config

PROGRAM = Path(__file__).with_name("train_on_mesh.py")


def run_on(devices: int, mesh: str, run_dir: Path, steps: int = 5, kind: str = "ids") -> dict:
    flags = f"--xla_force_host_platform_device_count={devices}"
    done = subprocess.run(
        [sys.executable, "-m", "tests.multidevice.train_on_mesh", mesh, str(run_dir), str(steps), kind],
        env=os.environ | {"XLA_FLAGS": flags},
        cwd=PROGRAM.parents[2],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("moved", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["", "moved"])
def test_eight_devices_train_as_one_does_and_checkpoints_move_between_meshes(moved: bool, tmp_path: Path):
    one = run_on(1, "1,1,1", tmp_path / "one")
    eight = run_on(8, "2,2,2", tmp_path / "eight")
    np.testing.assert_allclose(eight["losses"], one["losses"], rtol=1e-5)
    assert eight["split"] > 0.9 and one["split"] == 0

    if not moved:
        return
    # The run of one device goes on on eight, and the other way round.
    longer = run_on(8, "1,4,2", tmp_path / "one", steps=7)
    back = run_on(1, "1,1,1", tmp_path / "eight", steps=7)
    assert longer["resumed_from"] == back["resumed_from"] == 5
    np.testing.assert_allclose(longer["losses"], back["losses"], rtol=1e-5)


@pytest.mark.slow
def test_latents_train_on_eight_shards_of_the_parameters_as_on_one_device(tmp_path: Path):
    one = run_on(1, "1,1,1", tmp_path / "one", steps=3, kind="latents")
    eight = run_on(8, "1,8,1", tmp_path / "eight", steps=3, kind="latents")
    np.testing.assert_allclose(eight["losses"], one["losses"], rtol=1e-5)
    assert eight["split"] > 0.9 and one["split"] == 0


def abstract_mesh(data: int, fsdp: int, tensor: int):
    class Fake:
        shape = {"data": data, "fsdp": fsdp, "tensor": tensor}

    return Fake()


@pytest.mark.parametrize("diffusion", [None, DiffusionConfig()])
@pytest.mark.parametrize("mesh", [(2, 4, 2), (1, 8, 1)])
def test_no_large_parameter_of_the_base_model_is_left_whole(diffusion, mesh):
    declared = declare_model(ModelConfig(diffusion=diffusion, action_heads=False), TABLE)
    mesh = abstract_mesh(*mesh)
    decisions = plan_sharding(declared, mesh, MeshConfig())
    audit_sharding(decisions, mesh)
    whole = [d.name for d in decisions if d.replicated and d.spec.size > 2**16]
    assert not whole, describe_sharding(decisions)


def test_a_width_that_does_not_divide_is_reported_not_replicated_in_silence():
    declared = declare_model(model_config(width=36), TABLE)
    mesh = abstract_mesh(1, 8, 1)
    decisions = plan_sharding(declared, mesh, MeshConfig(min_shard_size=1))
    with pytest.raises(ConfigError, match="would be replicated on every device"):
        audit_sharding(decisions, mesh)


def test_a_mesh_that_does_not_fit_the_devices_is_refused():
    with pytest.raises(ConfigError, match="does not fit 1 device"):
        make_mesh(MeshConfig(data=1, fsdp=3), jax.devices()[:1])
