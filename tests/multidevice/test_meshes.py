"""The same program on eight (fake) devices as on one: losses, checkpoints, every mesh."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.multidevice.run import run_on

ONE = "1,1,1"
MESHES = ("8,1,1", "1,8,1", "1,1,8", "4,2,1", "4,1,2", "2,4,1", "1,4,2", "2,1,4", "1,2,4", "2,2,2")
"""Every factorisation of eight devices."""


@pytest.fixture(scope="module")
def communicated() -> dict[str, Any]:
    return run_on(8, "communicated")


def test_a_weight_whose_heads_are_split_gets_its_gradient_where_they_are(communicated):
    """Each device computed that of all heads, from the activations of all devices."""
    found = communicated["product"]
    assert found["kinds"] == {"all-reduce": 1}
    assert found["temporary"] < 2**17


def test_each_device_makes_its_share_of_muon_s_matrices_orthogonal(communicated):
    """Products of matrices in parts gathered all matrices on every device, fifteen times."""
    found = communicated["muon"]
    assert found["kinds"] == {"all-to-all": 4, "all-gather": 1}  # there and back along fsdp and tensor; back along data
    matrices = 4 * 6 * 64 * 128
    assert found["temporary"] < 4 * matrices / 3  # bytes: three matrices of 24, a few times
    assert found["flops"] < 1.1 * 5 * (4 * 64 * 64 * 128 + 2 * 64**3) * 24 / 8
    assert found["off"] < 1e-6


def check_forty_robots(kind: str, steps: int, meshes: tuple[str, ...], robots: int = 40) -> dict[str, Any]:
    found = run_on(8, "forty_robots", kind, str(steps), str(robots), ONE, *meshes)
    losses = found[ONE]["losses"]
    assert len(losses) == steps and losses[-1] < losses[0]
    for mesh in meshes:
        np.testing.assert_allclose(found[mesh]["losses"], losses, rtol=1e-5, err_msg=f"{kind} on {mesh}")
    return found


@pytest.mark.slow
def test_forty_robots_train_on_eight_devices_as_on_one():
    check_forty_robots("ids", 4, ("2,2,2",))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", ["ids", "latents", "attended"])
def test_forty_robots_train_on_every_mesh_as_on_one_device(kind: str):
    found = check_forty_robots(kind, 20, MESHES)
    assert found[ONE]["losses"][-1] < 0.995 * found[ONE]["losses"][0]  # parameters have moved, and it shows
    sharded = found["1,8,1"]
    assert sharded["bytes_on_first"] <= 1.05 * sharded["bytes"] / 8


@pytest.mark.slow
def test_a_number_of_robots_that_eight_does_not_divide_is_no_hindrance():
    found = check_forty_robots("ids", 10, ("1,8,1",), robots=41)
    assert found["1,8,1"]["bytes_on_first"] <= 1.05 * found["1,8,1"]["bytes"] / 8


@pytest.mark.slow
def test_values_that_are_kept_for_the_backward_pass_are_those_of_one_device():
    check_forty_robots("kept", 5, ("2,2,2",))


@pytest.mark.slow
def test_latents_with_recall_and_muon_train_on_every_axis_of_the_mesh_as_on_one_device():
    check_forty_robots("recipe", 10, ("2,2,2",))


@pytest.mark.slow
def test_a_run_goes_on_on_another_mesh(tmp_path: Path):
    def train(devices: int, mesh: str, name: str, steps: int) -> Any:
        return run_on(devices, "train_on_mesh", mesh, str(tmp_path / name), str(steps))

    one, eight = train(1, ONE, "one", 5), train(8, "2,2,2", "eight", 5)
    np.testing.assert_allclose(eight["losses"], one["losses"], rtol=1e-5)
    assert eight["split"] > 0.9 and one["split"] == 0
    longer, back = train(8, "1,4,2", "one", 7), train(1, ONE, "eight", 7)
    assert longer["resumed_from"] == back["resumed_from"] == 5
    np.testing.assert_allclose(longer["losses"], back["losses"], rtol=1e-5)


@pytest.mark.slow
def test_what_eight_shards_saved_is_restored_on_two_by_four_and_on_one_with_equal_logits(tmp_path: Path):
    eight, two_by_four, one = run_on(8, "restore_on_meshes", str(tmp_path))
    assert eight["split"] == two_by_four["split"] > 20 and one["split"] == 0
    for name in ("state", "few"):
        assert eight[name] == two_by_four[name] == one[name]
    assert np.std(one["logits"]) > 0.1
    for other in (eight, two_by_four):
        np.testing.assert_allclose(other["logits"], one["logits"], rtol=1e-5, atol=1e-5)
