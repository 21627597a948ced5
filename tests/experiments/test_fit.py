"""`hma fit`: the real training step, compiled and not run."""

from typing import get_args

import jax
import pytest

from experiments.bench.fit import abstract_inputs, check_fit, count_collectives, find_devices
from experiments.bench.models import MODELS
from experiments.cli.bench import Model
from hma_jax.config import ConfigError, ExecutionConfig, MeshConfig
from hma_jax.model.hma import declare_model
from hma_jax.runtime.sharding import make_mesh
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
    fit = check_fit(config, TABLE, train, ExecutionConfig(), jax.devices()[:1])
    assert fit.parameters == declare_model(config, TABLE).count() and fit.devices == 1
    assert fit.arguments > 3 * 4 * fit.parameters  # weights and two moments
    assert not fit.refusal and not fit.collectives


def test_a_mesh_that_does_not_suit_the_devices_is_refused():
    with pytest.raises(ConfigError, match="does not fit 1 device"):
        check_fit(model_config(), TABLE, train_config(), ExecutionConfig(mesh=MeshConfig(2, 1, 1)), jax.devices()[:1])


def test_collectives_are_counted_whole_or_started():
    text = """
      %a = f32[8]{0} all-reduce(f32[8]{0} %x), replica_groups={}
      %b = (f32[8]{0}, f32[64]{0}) all-gather-start(f32[8]{0} %x), dimensions={0}
      %c = f32[64]{0} all-gather-done(%b)
      ROOT %d = f32[8]{0} add(f32[8]{0} %a, f32[8]{0} %a)
    """
    assert count_collectives(text) == (("all-gather", 1), ("all-reduce", 1))


def test_an_unknown_topology_is_refused_with_names_to_try(monkeypatch):
    monkeypatch.setenv("TPU_SKIP_MDS_QUERY", "1")
    with pytest.raises(ConfigError, match="no topology 'v99:1x1'.*v5e:2x4"):
        find_devices("v99:1x1")
