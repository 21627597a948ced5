import tracemalloc

import jax
import numpy as np
import pytest
from flax import nnx
from jax.sharding import AbstractMesh, AxisType

from hma_jax.config import ConfigError, ModelConfig
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.model.initial import input_fan_out
from hma_jax.model.params import Initializer, declare, normal, param, stack, xavier_uniform, zeros
from hma_jax.runtime.sharding import MESH_AXES, find_layouts
from tests.tiny import TABLE, model_config

ONE_ROBOT = EmbodimentTable((Embodiment("table", 2, 1, (0.0, 0.0), (1.0, 1.0)),))

OFFICIAL = {128: 11_320_962, 256: 43_645_186, 1024: 678_680_578}


@pytest.mark.parametrize("width", OFFICIAL)
def test_parameter_count_is_the_release_s(width: int):
    assert declare_model(ModelConfig(width=width), ONE_ROBOT).count() == OFFICIAL[width]


def test_a_table_may_be_written_with_lists_and_arrays():
    """They have no hash, by which declarations are kept."""
    table = EmbodimentTable([Embodiment("table", 2, 1, [0.0, 0.0], np.ones(2, np.float32), low=[], high=())])
    assert table == ONE_ROBOT and hash(table) == hash(ONE_ROBOT)


def test_robots_of_a_table_have_names_of_their_own():
    """The windows of the second would train the first."""
    (robot,) = ONE_ROBOT.entries
    with pytest.raises(ConfigError, match=r"embodiment names repeat: \['table', 'table'\]"):
        EmbodimentTable((robot, robot))
    with pytest.raises(ConfigError, match="the embodiment table is empty"):
        EmbodimentTable(())


class Pair(nnx.Module):
    def __init__(self, extra: bool):
        self.first = param((3, 4), ("D", None), normal(1.0), role="hidden")
        if extra:
            self.second = param((2,), ("E",), normal(1.0), role="vector")


def test_adding_a_parameter_leaves_the_others_initial_values_alone():
    without = declare(lambda: Pair(False)).init(3)
    with_extra = declare(lambda: Pair(True)).init(3)
    np.testing.assert_array_equal(without["first"], with_extra["first"])


def test_the_seed_decides_the_initial_values():
    declared = declare(lambda: Pair(True))
    assert not np.array_equal(declared.init(0)["first"], declared.init(1)["first"])
    np.testing.assert_array_equal(declared.init(1)["second"], declared.init(1)["second"])


def test_stacked_modules_gain_a_layer_axis_and_differ_between_layers():
    class Tower(nnx.Module):
        def __init__(self):
            self.floors = stack(lambda: Pair(False), 5)

    declared = declare(Tower)
    spec = declared.leaves()["floors/first"]
    assert spec.shape == (5, 3, 4) and spec.axes == ("N", "D", None)
    floors = declared.init(0)["floors"]["first"]
    assert len({float(x) for x in floors[:, 0, 0]}) == 5


def test_a_declaration_with_a_missing_axis_name_is_refused():
    with pytest.raises(ConfigError, match="needs 2 axes"):
        param((2, 3), ("D",), zeros, role="hidden")


def test_every_robot_s_own_parameter_is_known_by_its_axis():
    leaves = declare_model(model_config(), TABLE).leaves()
    own = {name for name, spec in leaves.items() if spec.embodiment_axis is not None}
    parts = ("stem", "conditioning", "action_head")
    assert own == {name for name in leaves if any(part in name for part in parts)}
    assert all(leaves[n].shape[leaves[n].embodiment_axis] == TABLE.size for n in own)


def test_a_stem_s_first_layer_starts_as_large_as_its_own_robot_s_chunk_asks_for():
    """However wide the widest robot's is."""
    config = model_config()
    kernel_EUD = declare_model(config, TABLE).init(0)["stem"]["into"]["kernel"]
    for kernel, entry in zip(np.asarray(kernel_EUD), TABLE.entries, strict=True):
        bound = config.stem_gain * np.sqrt(6 / (entry.chunk + input_fan_out(config)))
        assert 0.97 * bound < np.abs(kernel[: entry.chunk]).max() <= 1.000001 * bound
        assert not kernel[entry.chunk :].any()


@pytest.mark.parametrize("axes", [("batch", "copies"), ("data", "model"), ("data", "fsdp", "tensor")], ids="-".join)
def test_a_mesh_of_the_caller_s_own_is_left_to_the_caller(axes: tuple[str, ...]):
    """Under one, whatever was computed ended in a KeyError: its axes are called otherwise."""
    mesh = AbstractMesh((2, 2, 1)[: len(axes)], axes, axis_types=(AxisType.Auto,) * len(axes))
    with jax.sharding.use_abstract_mesh(mesh):
        found = find_layouts(("D", "D_out"), (4, 4), 1)
    assert (found is not None) == (axes == MESH_AXES)


def test_initial_arrays_follow_the_requested_sharding():
    declared = declare(lambda: Pair(False))
    device = jax.sharding.SingleDeviceSharding(jax.devices()[0])
    params = declared.init(0, {"first": device})
    assert params["first"].sharding == device


@pytest.mark.parametrize("init", [normal(0.5), xavier_uniform(3, 4)], ids=["normal", "uniform"])
def test_an_initial_array_is_drawn_without_a_second_one_in_memory(init: Initializer):
    """Every process draws every array whole: of the largest, a copy is gigabytes."""
    rng = np.random.default_rng(0)
    tracemalloc.start()
    try:
        drawn = init(rng, (512, 512))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert drawn.dtype == np.float32 and peak < 1.1 * drawn.nbytes
