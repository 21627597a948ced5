"""`hma plan`: the real training step, compiled and not run."""

from typing import get_args

import jax
import pytest

from experiments.bench.collectives import Collective, Sent, count_kinds, find_collectives
from experiments.bench.models import MODELS
from experiments.bench.plan import abstract_inputs, find_devices, make_plan
from experiments.cli.bench.arguments import Model
from hma_jax.config import ConfigError, ExecutionConfig, MeshConfig
from hma_jax.model.hma import declare_model
from hma_jax.runtime.mesh import make_mesh
from hma_jax.training.state import init_state
from tests.tiny import TABLE, model_config, train_config


def test_the_command_line_offers_the_models_of_the_table():
    assert set(get_args(Model)) == set(MODELS)


def test_the_abstract_state_has_the_shapes_of_a_real_one():
    config, train = model_config(), train_config()
    declared = declare_model(config, TABLE)
    state, batch = abstract_inputs(
        declared, TABLE, config, train, MeshConfig(), make_mesh(MeshConfig(), jax.devices()[:1])
    )
    real = init_state(declared, TABLE, 0)
    assert jax.tree.structure(state) == jax.tree.structure(real)
    assert [(x.shape, x.dtype) for x in jax.tree.leaves(state)] == [
        (x.shape, x.dtype) for x in jax.tree.leaves(real)
    ]
    assert batch["tokens"].shape == (train.batch, config.frames, config.tokens)


def test_a_step_that_fits_is_reported_with_its_memory_and_parameters():
    config, train = model_config(layers=1), train_config()
    plan = make_plan(config, TABLE, train, ExecutionConfig(), jax.devices()[:1])
    assert plan.parameters == declare_model(config, TABLE).count() and plan.devices == 1
    assert plan.stored == 4 * plan.parameters
    assert plan.arguments > 3 * plan.stored  # weights and two moments
    assert not plan.refusal and not plan.collectives


def test_a_mesh_that_does_not_suit_the_devices_is_refused():
    with pytest.raises(ConfigError, match="does not fit 1 device"):
        make_plan(model_config(), TABLE, train_config(), ExecutionConfig(mesh=MeshConfig(2, 1, 1)), jax.devices()[:1])


TEXT = """
  %a = f32[8]{0} all-reduce(f32[8]{0} %x), replica_groups={{0,4},{1,5}}, metadata={op_name="jit(step)/reduce_sum"}
  %b = (bf16[1,8]{0}, bf16[2,64]{1,0}) all-gather-start(%x), channel_id=7, replica_groups=[2,4]<=[8], metadata={op_name="jit(step)/jvp()/while/body/gather_parameters/x"}
  %again = bf16[2,64]{1,0} all-gather(%x), channel_id=7, replica_groups=[2,4]<=[8], metadata={op_name="jit(step)/jvp()/while/body/gather_parameters/x"}
  %c = bf16[64]{0} all-gather-done(%b)
  %m = f32[8]{0} reduce-scatter(%x), replica_groups=mesh['axis_0'=4,'axis_1'=2] {'axis_0'}, metadata={op_name="jit(step)/z"}
  %p = (bf16[4]{0}, bf16[4]{0}, u32[], u32[]) collective-permute-start(%x), source_target_pairs={{0,2},{2,0}}, metadata={op_name="jit(step)/transpose(jvp())/dot_general"}
  %q = f32[8,4096]{1,0} all-to-all(%x), replica_groups=[4,2]<=[2,2,2]T(0,2,1), metadata={op_name="jit(step)/robots_to_examples/y"}
  ROOT %d = f32[8]{0} add(f32[8]{0} %a, f32[8]{0} %a)
"""  # noqa: E501


def test_collectives_are_counted_once_with_what_is_sent_over_which_axes():
    found = find_collectives(TEXT, {"data": 2, "fsdp": 2, "tensor": 2})
    assert count_kinds(found) == {"all-gather": 1, "all-reduce": 1, "reduce-scatter": 1, "all-to-all": 1, "collective-permute": 1}
    assert found[Collective("all-to-all", "fsdp", False, "robots' parameters, to their examples")] == Sent(1, 8 * 4096 * 4)
    gathered = Collective("all-gather", "fsdp+tensor", True, "parameters, from storage to compute")
    assert found[gathered] == Sent(1, 2 * 128)
    by_axes = {c.kind: c.over for c in found}
    assert by_axes["all-reduce"] == "data" and by_axes["collective-permute"] == "fsdp"
    assert by_axes["reduce-scatter"] == "data+fsdp"


def test_an_unknown_topology_is_refused_with_names_to_try(monkeypatch):
    monkeypatch.setenv("TPU_SKIP_MDS_QUERY", "1")
    with pytest.raises(ConfigError, match="no topology 'v99:1x1'.*v5e:2x4"):
        find_devices("v99:1x1")
