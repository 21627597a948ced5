"""What lies where on a mesh: layouts, the audit, and messages about meshes that do not fit."""

from __future__ import annotations

import jax
import pytest
from jax.sharding import PartitionSpec

from hma_jax.config import ConfigError, DiffusionConfig, MeshConfig, ModelConfig
from hma_jax.model.hma import declare_model
from hma_jax.runtime.audit import audit_sharding, describe_sharding, plan_sharding
from hma_jax.runtime.mesh import check_mesh, make_mesh, split_over_slices
from hma_jax.runtime.sharding import STORAGE, partition
from tests.multidevice.dump_sharding import FOLDER, dump, fake_mesh, models
from tests.multidevice.forty_robots import make_table
from tests.tiny import TABLE, model_config


@pytest.mark.parametrize("name", sorted(models()))
def test_the_presets_lie_where_they_lay(name: str):
    recorded = (FOLDER / f"{name}.txt").read_text()
    assert dump(models()[name]) == recorded, (
        f"the layout of {name} has changed; if it should, write the record anew: "
        "python -m tests.multidevice.dump_sharding"
    )


@pytest.mark.parametrize("robots", [40, 41])
@pytest.mark.parametrize("name", ["accelerator", "paper", "xl", "xl-continuous"])
def test_each_of_eight_devices_stores_an_eighth_whatever_the_number_of_robots(name: str, robots: int):
    declared = declare_model(models()[name], make_table(robots))
    decisions = plan_sharding(declared, fake_mesh(1, 8, 1), MeshConfig())
    assert sum(d.device_size for d in decisions) <= 1.05 * declared.count() / 8, describe_sharding(decisions)


@pytest.mark.parametrize("diffusion", [None, DiffusionConfig()], ids=["ids", "latents"])
@pytest.mark.parametrize("mesh", [(2, 4, 2), (1, 8, 1), (1, 64, 1)], ids=str)
@pytest.mark.parametrize("conditioning", ["concat+modulate", "cross_attention"])
def test_no_large_parameter_of_the_base_model_is_left_whole(diffusion, mesh, conditioning):
    declared = declare_model(ModelConfig(diffusion=diffusion, conditioning=conditioning), make_table(40))
    decisions = plan_sharding(declared, fake_mesh(*mesh), MeshConfig())
    audit_sharding(decisions, fake_mesh(*mesh))
    whole = [d.name for d in decisions if d.whole and d.spec.size > 2**16]
    assert not whole, describe_sharding(decisions)


def test_robots_are_split_by_width_and_by_their_number_only_where_no_width_divides():
    mesh = fake_mesh(1, 8, 1)
    assert partition(("N", "E", "D", "D_out"), (2, 40, 32, 32), mesh, STORAGE) == PartitionSpec(
        None, None, "fsdp", None
    )
    assert partition(("N", "E", "D", "D_out"), (2, 40, 36, 32), mesh, STORAGE) == PartitionSpec(
        None, None, None, "fsdp"
    )
    assert partition(("N", "E", "D", "D_out"), (2, 40, 36, 36), mesh, STORAGE) == PartitionSpec(
        None, "fsdp", None, None
    )
    assert partition(("E", "D"), (41, 36), mesh, STORAGE) == PartitionSpec(None, None)


def test_one_dimension_takes_two_mesh_axes_only_if_it_divides_by_both():
    mesh = fake_mesh(1, 2, 4)
    assert partition(("U", "F"), (7, 32), mesh, STORAGE) == PartitionSpec(None, ("tensor", "fsdp"))
    assert partition(("U", "F"), (7, 36), mesh, STORAGE) == PartitionSpec(None, "tensor")


def test_a_width_that_does_not_divide_is_reported_not_replicated_in_silence():
    declared = declare_model(model_config(width=36, heads=6), TABLE)
    mesh = fake_mesh(1, 7, 1)
    decisions = plan_sharding(declared, mesh, MeshConfig(min_shard_size=1))
    with pytest.raises(ConfigError, match=r"would be replicated on every device .* trunk/blocks/mlp_in/kernel \(2, 36"):
        audit_sharding(decisions, mesh)


MESHES_OF_EIGHT = [
    (data, fsdp, 8 // data // fsdp) for data in (1, 2, 4, 8) for fsdp in (1, 2, 4, 8) if data * fsdp <= 8
]


@pytest.mark.parametrize("mesh", MESHES_OF_EIGHT, ids=str)
@pytest.mark.parametrize("heads", [False, True], ids=["frames", "frames and actions"])
@pytest.mark.parametrize("diffusion", [None, DiffusionConfig()], ids=["ids", "latents"])
def test_every_mesh_of_eight_devices_fits_the_base_models_of_one_robot(diffusion, heads: bool, mesh):
    declared = declare_model(ModelConfig(diffusion=diffusion, action_heads=heads), make_table(1))
    audit_sharding(plan_sharding(declared, fake_mesh(*mesh), MeshConfig()), fake_mesh(*mesh))


def test_a_size_of_tensor_that_divides_no_width_is_refused_by_its_name():
    declared = declare_model(ModelConfig(mlp_ratio=1025 / 256), make_table(1))
    with pytest.raises(ConfigError, match="mlp_in/kernel .*; tensor=8 divides no size of theirs that it may split"):
        audit_sharding(plan_sharding(declared, fake_mesh(1, 1, 8), MeshConfig()), fake_mesh(1, 1, 8))


def test_an_array_that_is_split_along_tensor_alone_counts_as_whole_under_fsdp():
    """Every device along fsdp would hold a copy."""
    declared = declare_model(model_config(width=36, heads=6), TABLE)
    mesh = fake_mesh(1, 7, 2)
    decisions = plan_sharding(declared, mesh, MeshConfig(min_shard_size=1))
    with pytest.raises(ConfigError, match="would be replicated"):
        audit_sharding([d for d in decisions if "tensor" in d.storage], mesh)


def test_a_mesh_that_does_not_fit_the_devices_is_refused():
    with pytest.raises(ConfigError, match="does not fit 1 device"):
        make_mesh(MeshConfig(data=1, fsdp=3), jax.devices()[:1])


def test_a_mesh_that_does_not_fit_the_batch_or_the_model_is_refused_with_what_would():
    config = model_config(heads=4)
    check_mesh(fake_mesh(2, 2, 2), config, batch=8)
    with pytest.raises(ConfigError, match="batch of 6 cannot be divided over data=2 x fsdp=2.*multiple of 4"):
        check_mesh(fake_mesh(2, 2, 2), config, batch=6)
    with pytest.raises(ConfigError, match="batch of 8 in 4 micro-batches cannot be divided.*multiple of 16"):
        check_mesh(fake_mesh(2, 2, 2), config, batch=8, accumulate=4)
    with pytest.raises(ConfigError, match="tensor=8 does not divide the model's heads of 4"):
        check_mesh(fake_mesh(1, 1, 8), config, batch=8)


@pytest.mark.parametrize("sizes, slices, outer", [
    ((4, 2, 1), 2, [2, 1, 1]), ((1, 8, 1), 2, [1, 2, 1]), ((2, 4, 2), 4, [2, 2, 1]), ((3, 2, 4), 4, [1, 2, 2]),
])  # fmt: skip
def test_slices_are_joined_along_data_first_and_tensor_last(sizes, slices, outer):
    assert split_over_slices(sizes, slices) == outer
