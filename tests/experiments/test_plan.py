"""`hma plan`: the real training step, compiled and not run."""

import os
import subprocess
import sys
from types import SimpleNamespace
from typing import get_args

import jax
import pytest
from jax.experimental import topologies

from experiments.bench import plan as planning
from experiments.bench.collectives import Collective, Sent, count_kinds, find_collectives
from experiments.bench.models import MODELS
from experiments.bench.plan import Plan, abstract_inputs, chips_of, find_devices, make_plan
from experiments.cli.bench.arguments import Model
from experiments.cli.main import main
from experiments.cli.plan import how_often, read_memory
from hma_jax.config import ConfigError, ExecutionConfig, MeshConfig
from hma_jax.model.hma import declare_model
from hma_jax.runtime.mesh import make_mesh
from hma_jax.training.state import init_state
from tests.tiny import SMALLER, TABLE, model_config, train_config


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
    assert [(x.shape, x.dtype) for x in jax.tree.leaves(state)] == [(x.shape, x.dtype) for x in jax.tree.leaves(real)]
    assert batch["tokens"].shape == (train.batch, config.frames, config.tokens)


def plan_of(**train):
    return make_plan(model_config(**SMALLER), TABLE, train_config(**train), ExecutionConfig(), jax.devices()[:1])


@pytest.fixture(scope="module")
def plan():
    return plan_of()


def test_a_step_that_fits_is_reported_with_its_memory_and_parameters(plan):
    assert plan.parameters == declare_model(model_config(**SMALLER), TABLE).count() and plan.devices == 1
    assert plan.stored == 4 * plan.parameters
    assert plan.arguments > 3 * plan.stored  # weights and two moments
    assert plan.peak == plan.arguments + plan.temporary > plan.temporary > 0
    assert not plan.refusal and not plan.collectives


def test_what_is_frozen_is_planned_without_moments(plan):
    one = plan_of(only=("arm",))
    assert plan.moments == 2 * plan.stored == 2 * one.stored
    assert plan.arguments - one.arguments == plan.moments - one.moments > one.stored


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
  %s = f32[4]{0} all-to-all(%x), channel_id=1, replica_groups={{0,1},{2,3}}, metadata={op_name="jit(step)/orthogonalise_matrices/shard_map/all_to_all"}
  %t = f32[4]{0} all-to-all(%y), channel_id=1, replica_groups={{0,1},{2,3}}, metadata={op_name="jit(step)/orthogonalise_matrices/shard_map/all_to_all"}
  ROOT %d = f32[8]{0} add(f32[8]{0} %a, f32[8]{0} %a)
"""  # noqa: E501


def test_collectives_are_counted_once_with_what_is_sent_over_which_axes():
    found = find_collectives(TEXT, {"data": 2, "fsdp": 2, "tensor": 2})
    assert count_kinds(found) == {
        "all-gather": 1,
        "all-reduce": 1,
        "reduce-scatter": 1,
        "all-to-all": 3,
        "collective-permute": 1,
    }
    to_examples = Collective("all-to-all", "fsdp", 0, "robots' parameters, to their examples")
    assert found[to_examples] == Sent(1, 8 * 4096 * 4 // 2, 8 * 4096 * 4 // 2)
    shared_out = Collective("all-to-all", "tensor", 0, "Muon's matrices, to one device each and back")
    assert found[shared_out] == Sent(2, 2 * 4 * 4 // 2, 2 * 4 * 4 // 2)
    gathered = Collective("all-gather", "fsdp+tensor", 1, "parameters, from storage to compute")
    assert found[gathered] == Sent(1, 2 * 128 * 3 // 4, 2 * 128 * 3 // 4)
    by_axes = {c.kind: c.over for c in found}
    assert by_axes["all-reduce"] == "data" and by_axes["collective-permute"] == "fsdp"
    assert by_axes["reduce-scatter"] == "data+fsdp"


@pytest.mark.parametrize(
    ("instruction", "received"),
    [
        ("f32[32,8]{1,0} all-gather(%x)", 32 * 8 * 4 * 7 // 8),
        ("f32[32,8]{1,0} all-reduce(%x)", 2 * 32 * 8 * 4 * 7 // 8),
        ("f32[4,8]{1,0} reduce-scatter(%x)", 7 * 4 * 8 * 4),
        ("f32[32,8]{1,0} all-to-all(%x)", 32 * 8 * 4 * 7 // 8),
        ("f32[32,8]{1,0} all-reduce-start(%x)", 2 * 32 * 8 * 4 * 7 // 8),
        # Several at once, as XLA combines them.
        ("((f32[4,8]{1,0}, f32[8,8]{1,0}), (f32[32,8]{1,0}, f32[64,8]{1,0})) all-gather-start(%x, %y)", 96 * 8 * 4 * 7 // 8),
        ("((f32[32,8]{1,0:T(8,128)}), f32[4,8]{1,0:T(8,128)}, u32[]{:S(2)}) reduce-scatter-start(%x)", 7 * 4 * 8 * 4),
    ],
)  # fmt: skip
def test_a_device_receives_the_parts_of_the_others(instruction, received):
    """Not its own; of sums every part once for each that is added."""
    (sent,) = find_collectives(
        f"  %a = {instruction}, replica_groups={{}}", {"data": 1, "fsdp": 8, "tensor": 1}
    ).values()
    assert sent == Sent(1, received, received)


NESTED = """
%layer (p: f32[8]) -> f32[8] {
  %a = f32[8]{0} all-reduce(%p), replica_groups={}, metadata={op_name="while/body/while/body/x"}
}
%micro_batch (p: f32[8]) -> f32[8] {
  %w = f32[8]{0} while(%p), condition=%less, body=%layer, backend_config={"known_trip_count":{"n":"5"}}
}
ENTRY %main (p: f32[8]) -> f32[8] {
  %b = f32[8]{0} all-reduce(%p), replica_groups={}, metadata={op_name="y"}
  %w = f32[8]{0} while(%p), condition=%less, body=%micro_batch, backend_config={"known_trip_count":{"n":"4"}}
}
"""


def test_what_is_sent_in_a_loop_counts_as_often_as_the_loop_runs():
    """Four micro-batches sent as much as one in the sum, which counted the text."""
    found = find_collectives(NESTED, {"data": 8, "fsdp": 1, "tensor": 1})
    assert {c.loops: sent for c, sent in found.items()} == {2: Sent(1, 56, 20 * 56), 0: Sent(1, 56, 56)}


@pytest.mark.parametrize(
    ("loops", "accumulate", "words"),
    [
        (0, 4, "once"), (1, 1, "each layer"), (2, 1, "each layer"), (1, 4, "each micro-batch"),
        (2, 4, "each layer of each micro-batch"), (3, 4, "each layer of each micro-batch"),
    ],
)  # fmt: skip
def test_what_is_sent_in_loops_says_how_often(loops, accumulate, words):
    assert how_often(loops, accumulate) == words


@pytest.fixture
def compiler(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict]]:
    """What a TPU compiler that knows v4 and v5e was asked for."""
    asked = []

    def get_topology_desc(platform, topology_name, **options):
        asked.append((topology_name, options))
        if topology_name.partition(":")[0] not in ("v4", "v5e"):
            raise RuntimeError(f"Invalid TPU external name: {topology_name}\nmore of it")
        return SimpleNamespace(devices=["device"])

    monkeypatch.setattr(topologies, "get_topology_desc", get_topology_desc)
    monkeypatch.setattr(planning.importlib.util, "find_spec", lambda name: name)
    return asked


def test_an_unknown_topology_is_refused_with_names_to_try(compiler):
    with pytest.raises(ConfigError, match="knows no topology v99:1x1; give one such as v4:2x2x4, .*external name"):
        find_devices("v99:1x1")


def test_chips_of_a_v4_are_one_device_each(compiler):
    """A mesh over their cores is none: JAX ends with an assertion."""
    assert find_devices("v4-32") == find_devices("v5e:2x4") == ["device"]
    assert compiler == [("v4:2x2x4", {"chip_config_name": "megacore"}), ("v5e:2x4", {})]


def test_without_the_compiler_it_is_asked_for(monkeypatch):
    monkeypatch.setattr(planning.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"v5e:2x4: the TPU compiler is not installed: pip install -e '\.\[tpu\]'$"):
        find_devices("v5e:2x4")


def test_absent_devices_are_planned_on_the_processor_whatever_is_here():
    """JAX reads where it computes when it is imported: nothing of the program may have done so before."""
    code = (
        "import sys; from experiments.cli.main import main; main(['plan', '--topology', 'v5e:3x5']); import jax; "
        "sys.exit((jax.config.jax_platforms, jax.config.jax_enable_compilation_cache) != ('cpu', False))"
    )
    environment = {name: value for name, value in os.environ.items() if not name.startswith("JAX_")}
    done = subprocess.run([sys.executable, "-c", code], env=environment, timeout=120, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_gpus_are_not_taken_for_tpus_without_a_compiler(monkeypatch):
    monkeypatch.setattr(planning.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="^no TPU called h100; .* `hma plan --topology local` there$"):
        find_devices("h100:8")


@pytest.mark.parametrize(
    ("cloud", "chips"),
    [
        ("v4-8", "v4:2x2x1"), ("v4-16", "v4:2x2x2"), ("v4-32", "v4:2x2x4"), ("v4-64", "v4:2x4x4"),
        ("v5p-8", "v5p:2x2x1"), ("v5p-128", "v5p:4x4x4"), ("v3-8", "v3:2x2"), ("v5e-4", "v5e:2x2"),
        ("v5e-8", "v5e:2x4"), ("v5litepod-16", "v5e:4x4"), ("v6e-32", "v6e:4x8"), ("v5e-256", "v5e:16x16"),
        ("v5e:2x4", "v5e:2x4"), ("v9-8", "v9-8"),
    ],
)  # fmt: skip
def test_names_of_clouds_are_said_in_chips(cloud, chips):
    assert chips_of(cloud) == chips


@pytest.mark.parametrize(
    ("cloud", "words"),
    [
        ("v4-33", "counts cores, two for each chip, and must come to 4, 8, 16, ... chips; .* such as v4:2x2x4"),
        ("v4-4", "must come to 4"),
        ("v5e-12", "counts chips, and must come to 4, 8, 16, ... chips; .* such as v5e:2x4"),
    ],
)
def test_a_number_that_is_no_slice_is_explained(cloud, words):
    with pytest.raises(ConfigError, match=words):
        chips_of(cloud)


def test_sizes_of_memory_are_read():
    assert (read_memory("80GiB"), read_memory("1.5 GB"), read_memory(None)) == (80 * 2**30, 1.5e9, None)
    with pytest.raises(ConfigError, match="--memory 80: write it as 80GiB"):
        read_memory("80")


@pytest.fixture
def planned(monkeypatch: pytest.MonkeyPatch, capsys):
    """Runs `hma plan` without compiling; returns what was to be compiled, and the last row that it printed."""
    calls = []

    def make(*asked):
        calls.append(asked)
        return Plan((), 8, {"data": 8, "fsdp": 1, "tensor": 1}, 0.0, 8e12, temporary=3 * 2**30, peak=4 * 2**30)

    monkeypatch.setattr(planning, "make_plan", make)

    def run(*arguments: str):
        assert main(["plan", "--brief", *arguments]) == 0
        out = capsys.readouterr().out
        assert "(1 devices)" not in out and "1 robots" not in out
        lines = map(str.strip, out.splitlines())
        return calls[-1], next(line for line in lines if line.startswith("local "))

    return run


def test_memory_gives_a_verdict_where_the_compiler_has_none(planned):
    for memory, verdict in (((), "1.0 TFLOP"), (("--memory", "4GiB"), "fits"), (("--memory", "3GiB"), "does not fit")):
        assert planned(*memory)[1].endswith(verdict)


def test_an_average_of_the_weights_has_a_column(planned):
    for averaging, copies in ((), 2), (("--set", "train.ema_decay=0.9"), 3):
        assert planned("--preset", "smoke", *averaging)[1].count(" 0 B ") == copies


def test_the_plan_of_a_study_is_of_the_model_that_it_trains(planned):
    (model, table, train, execution, _), _ = planned(
        "--preset", "paper", "--set", "model.width=768", "--set", "train.batch=8", "--mesh", "1", "-1", "1"
    )
    assert (model.width, model.layers, train.batch, table.size, len(set(table.names))) == (768, 32, 8, 40, 40)
    assert execution == ExecutionConfig("bfloat16", mesh=MeshConfig(1, -1, 1))
    assert planned("--preset", "smoke")[0][3].mesh == MeshConfig()  # as it trains
    assert planned()[0][3].mesh == MeshConfig(1, -1, 1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--preset", "paper", "--batch", "64"], "set model.*, train.batch"),
        (["--preset", "paper", "--model", "base"], "cannot be used with --preset"),
        (["--set", "model.width=768"], "these settings need a study; add --preset"),
    ],
)
def test_a_study_and_a_fixed_model_are_not_mixed(arguments, words, capsys):
    assert main(["plan", *arguments]) == 2 and words in capsys.readouterr().err
