"""Trials that run at a time on one machine divide it: no GPU or chip belongs to two unless it must."""

import os
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from experiments.running import slots
from experiments.running.children import child_environment
from experiments.running.slots import Accelerators, Slot, core_place, cut, find_accelerators
from hma_jax.config import ConfigError

EIGHT = Accelerators("gpu", tuple("01234567"))


def gpus(count: int, accelerators: Accelerators = EIGHT) -> list[str | None]:
    return [slot.environment().get("CUDA_VISIBLE_DEVICES") for slot in cut(count, accelerators, range(4))]


def test_every_slot_owns_its_gpus():
    assert gpus(8) == list("01234567")
    assert gpus(2) == ["0,1,2,3", "4,5,6,7"]
    assert gpus(3) == ["0,1", "2,3", "4,5"]
    assert gpus(1) == [None]  # a single trial has all of them, as JAX finds them


def test_more_slots_than_gpus_share_their_memory():
    three = cut(3, Accelerators("gpu", ("0", "1")), range(4))
    told = [slot.environment() for slot in three]
    assert [t["CUDA_VISIBLE_DEVICES"] for t in told] == ["0", "1", "0"]
    assert [t.get("XLA_PYTHON_CLIENT_MEM_FRACTION") for t in told] == ["0.450", None, "0.450"]


def test_tpu_chips_are_never_shared():
    chips = Accelerators("tpu", ("0", "1", "2", "3"))
    two = [slot.environment() for slot in cut(2, chips, ())]
    assert [t["TPU_VISIBLE_CHIPS"] for t in two] == ["0,1", "2,3"]
    assert {t["TPU_CHIPS_PER_PROCESS_BOUNDS"] for t in two} == {"1,2,1"}
    with pytest.raises(ConfigError, match="--workers 5: a TPU chip belongs to one process"):
        cut(5, chips, ())


def test_slots_share_the_cores():
    shares = [set(slot.cores) for slot in cut(2, None, range(5))]
    assert shares[0] | shares[1] == set(range(5)) and not shares[0] & shares[1]
    assert cut(2, None, (0, 4, 1, 5))[0].cores == (0, 4)  # neighbours, as the launcher orders them
    assert [slot.cores for slot in cut(3, None, (7,))] == [(7,), (7,), (7,)]
    assert cut(1, None, range(5))[0].cores == ()


@pytest.mark.parametrize(
    ("environment", "found"),
    [
        ({"CUDA_VISIBLE_DEVICES": "2,5"}, Accelerators("gpu", ("2", "5"))),
        ({"CUDA_VISIBLE_DEVICES": "MIG-a, MIG-b"}, Accelerators("gpu", ("MIG-a", "MIG-b"))),
        ({"CUDA_VISIBLE_DEVICES": ""}, None),
        ({"CUDA_VISIBLE_DEVICES": "-1"}, None),
        ({"CUDA_VISIBLE_DEVICES": "NoDevFiles"}, None),
        ({"CUDA_VISIBLE_DEVICES": "0,-1,1"}, Accelerators("gpu", ("0",))),  # as CUDA reads it
        ({"CUDA_VISIBLE_DEVICES": "0,1", "JAX_PLATFORMS": "cpu"}, None),
        ({"CUDA_VISIBLE_DEVICES": "", "TPU_VISIBLE_CHIPS": "1"}, Accelerators("tpu", ("1",))),
        ({}, Accelerators("gpu", ("0", "1"))),
    ],
)
def test_what_the_user_allows_is_what_is_divided(environment, found, monkeypatch):
    monkeypatch.setattr(slots, "_gpus", lambda: ("0", "1"))
    monkeypatch.setattr(slots, "_tpu_chips", lambda: ())
    plugins = [EntryPoint("xla_cuda13", "jax_plugins.xla_cuda13", "jax_plugins")]
    monkeypatch.setattr(slots, "entry_points", lambda group: plugins)
    assert find_accelerators(environment) == found
    plugins.clear()  # JAX for the processor alone, as a plain install brings it
    assert find_accelerators(environment) == (found if environment else None)


def test_tpu_chips_count_where_jax_has_their_library(monkeypatch):
    monkeypatch.delenv("TPU_LIBRARY_PATH", raising=False)
    monkeypatch.setattr(slots, "_gpus", lambda: ())
    monkeypatch.setattr(slots, "_tpu_chips", lambda: ("0",))
    for library, found in ((None, None), (object(), Accelerators("tpu", ("0",)))):
        monkeypatch.setattr(slots, "find_spec", lambda name: library)
        assert find_accelerators({}) == found


def test_gpus_are_counted_by_their_devices_where_a_container_has_no_program_that_lists_them(tmp_path, monkeypatch):
    for name in ("nvidia3", "nvidia5", "nvidiactl", "nvidia-uvm", "null"):
        (tmp_path / name).touch()
    monkeypatch.setenv("PATH", str(tmp_path))
    assert slots._gpus(tmp_path) == ("0", "1")
    (tmp_path / "nvidia-smi").write_text(
        "#!/bin/sh\nexit 18\n"
    )  # the driver was updated, and does not fit the kernel's
    (tmp_path / "nvidia-smi").chmod(0o755)
    slots._gpus.cache_clear()
    assert slots._gpus(tmp_path) == ("0", "1")


def test_tpu_chips_are_counted_on_the_bus(tmp_path):
    for number, (vendor, device) in enumerate(
        [
            ("0x1ae0", "0x0063"),
            ("0x1ae0", "0x0063"),
            ("0x1ae0", "0x0042"),
            ("0x10de", "0x0063"),
        ]  # a network card, a GPU
    ):
        (tmp_path / str(number)).mkdir()
        (tmp_path / str(number) / "vendor").write_text(f"{vendor}\n")
        (tmp_path / str(number) / "device").write_text(f"{device}\n")
    assert slots._tpu_chips(tmp_path) == ("0", "1")


def test_cores_are_ordered_by_socket_and_core(tmp_path):
    """As hardware threads are numbered: 0 and 2 of one core, 1 and 3 of one on the other socket."""
    for number, (socket, core) in enumerate([("0", "0"), ("1", "0"), ("0", "0"), ("1", "0")]):
        topology = tmp_path / f"cpu{number}" / "topology"
        topology.mkdir(parents=True)
        (topology / "physical_package_id").write_text(f"{socket}\n")
        (topology / "core_id").write_text(f"{core}\n")
    assert sorted(range(4), key=lambda n: core_place(n, tmp_path)) == [0, 2, 1, 3]
    assert core_place(5, tmp_path) == (0, 0, 5)  # not Linux


def test_a_child_is_told_its_slot_but_the_users_memory_stays(monkeypatch):
    monkeypatch.setenv("HMA_CORES", "0")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,1")
    monkeypatch.delenv("XLA_PYTHON_CLIENT_MEM_FRACTION", raising=False)
    slot = Slot((1, 2), Accelerators("gpu", ("1",)), sharers=2)
    told = child_environment(Path("compiled"), slot)
    assert (told["HMA_CORES"], told["CUDA_VISIBLE_DEVICES"]) == ("1,2", "1")
    assert told["XLA_PYTHON_CLIENT_MEM_FRACTION"] == "0.450" and told["HMA_PARENT_PID"] == str(os.getpid())
    monkeypatch.setenv("XLA_PYTHON_CLIENT_MEM_FRACTION", "0.2")
    assert child_environment(Path("compiled"), slot)["XLA_PYTHON_CLIENT_MEM_FRACTION"] == "0.2"
    assert "HMA_CORES" not in child_environment(Path("compiled"))
    assert child_environment(Path("compiled"), slot, "gpu")["HMA_ACCELERATOR"] == "gpu"
