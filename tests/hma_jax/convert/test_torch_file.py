"""Torch files, made here byte by byte without torch; and that none of them can run code."""

from __future__ import annotations

import argparse
import collections
import enum
import functools
import io
import os
import pickle
import zipfile
from pathlib import Path

import ml_dtypes
import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.convert import read_official, write_official
from hma_jax.convert.torch_file import LARGEST, read_torch
from tests.hma_jax.convert.fakes import DISCRETE, official_config, random_tensors, write_checkpoint

STORAGES = {
    "float32": "FloatStorage",
    "float16": "HalfStorage",
    "bfloat16": "BFloat16Storage",
    "int64": "LongStorage",
}


class Global:
    """Pickled as the name of something that need not exist here."""

    def __init__(self, module: str, name: str):
        self.module, self.name = module, name


class Call:
    """Pickled as a call of a global."""

    def __init__(self, function: Global, *arguments):
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


class Storage:
    def __init__(self, kind: str, key: str, numel: int):
        self.id = ("storage", Global("torch", kind), key, "cpu", numel)


class Writer(pickle._Pickler):
    """What torch.save does, in Python: named globals, and storages by persistent ids."""

    def save(self, obj, save_persistent_id=True):
        if isinstance(obj, Global):
            self.write(pickle.GLOBAL + f"{obj.module}\n{obj.name}\n".encode())
            return None
        return super().save(obj, save_persistent_id)

    def save_reduce(self, func, args, state=None, *rest, obj=None, **more):
        if isinstance(func, (Global, Call)):
            self.save(func)
            self.save(args)
            self.write(pickle.REDUCE)
            return
        super().save_reduce(func, args, state, *rest, obj=obj, **more)

    def persistent_id(self, obj):
        return obj.id if isinstance(obj, Storage) else None


def rebuild(storage: Storage, shape, stride, offset=0, function="_rebuild_tensor_v2") -> Call:
    empty = collections.OrderedDict()
    return Call(Global("torch._utils", function), storage, offset, shape, stride, False, empty)


def write_torch(path: Path, state, elements: dict[str, bytes], root: str = "archive", order: str = "little") -> Path:
    buffer = io.BytesIO()
    Writer(buffer, protocol=2).dump(state)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{root}/data.pkl", buffer.getvalue())
        archive.writestr(f"{root}/byteorder", order)
        for key, data in elements.items():
            archive.writestr(f"{root}/data/{key}", data)
    return path


def state_dict(arrays: dict[str, np.ndarray]) -> tuple[collections.OrderedDict, dict[str, bytes]]:
    state, elements = collections.OrderedDict(), {}
    for key, (name, x) in enumerate(arrays.items()):
        assert x.flags.c_contiguous
        storage = Storage(STORAGES[x.dtype.name], str(key), x.size)
        stride = tuple(s // x.itemsize for s in x.strides)
        state[name], elements[str(key)] = rebuild(storage, x.shape, stride), x.tobytes()
    return state, elements


def test_every_type_comes_out_as_it_went_in(tmp_path):
    rng = np.random.default_rng(0)
    arrays = {
        "a.weight": rng.standard_normal((3, 4)).astype(np.float32),
        "a.half": rng.standard_normal((2, 2, 2)).astype(np.float16),
        "a.brain": rng.standard_normal(5).astype(ml_dtypes.bfloat16),
        "a.count": np.array(7, np.int64),
        "a.empty": np.zeros((0, 3), np.float32),
    }
    read = read_torch(write_torch(tmp_path / "x.bin", *state_dict(arrays)))
    assert list(read) == list(arrays)
    for name, x in arrays.items():
        assert (read[name].shape, read[name].dtype) == (x.shape, x.dtype)
        assert read[name].read().tobytes() == x.tobytes()


def test_views_of_one_storage_are_read_with_their_strides(tmp_path):
    data, storage = np.arange(12, dtype=np.float32), Storage("FloatStorage", "0", 12)
    state = {"transposed": rebuild(storage, (4, 3), (1, 4)), "part": rebuild(storage, (2,), (1,), offset=5)}
    read = read_torch(write_torch(tmp_path / "x.bin", state, {"0": data.tobytes()}))
    np.testing.assert_array_equal(read["transposed"].read(), data.reshape(3, 4).T)
    np.testing.assert_array_equal(read["part"].read(), [5, 6])


@pytest.mark.parametrize("name", ["pytorch_model.bin", "model.bin"])
def test_an_official_checkpoint_may_be_a_torch_file(name, tmp_path):
    robots = [("push", 2, 1)]
    config = official_config(DISCRETE, robots)
    tensors = random_tensors(config, robots)
    folder = write_checkpoint(tmp_path / "a", config, tensors)
    (folder / "model.safetensors").rename(tmp_path / "expected.safetensors")
    write_torch(folder / name, *state_dict({f"module.{key}": x for key, x in tensors.items()}))
    write_official(read_official(folder), tmp_path / "b")
    assert (tmp_path / "b" / "model.safetensors").read_bytes() == (tmp_path / "expected.safetensors").read_bytes()


class Outer:
    """Of what is pickled as `getattr` of it in protocol 2."""

    class Inner:
        pass

    class Kind(enum.Enum):
        FIRST = 1

    @classmethod
    def made(cls) -> Outer:
        return cls()

    def method(self) -> None:
        pass

    def __reduce__(self):
        return Outer.made, ()


def test_what_a_trainer_keeps_is_passed_over_whatever_it_is(tmp_path):
    """In protocol 2, which torch writes, built-in types are of `__builtin__`, and bytes come out of a call of one."""
    besides = {
        "types": [set, int, bytes],
        "sets": [{1, 2}, frozenset("a"), collections.Counter("aab"), collections.defaultdict(list, a=[1])],
        "bytes": [b"a", bytearray(b"b")],
        "numpy": [np.float64(1.5), np.arange(3), np.dtype("int8")],
        "others": [tmp_path, argparse.Namespace(lr=1), functools.partial(max, 3)],
        "torch": [Call(Global("torch", "device"), "cpu"), Storage("ComplexFloatStorage", "9", 1)],
        "nested": [Outer.Inner(), Outer.Kind.FIRST, Outer.made, Outer().method, Outer()],
        "instance called": Call(Call(Global("cloud", "make"), "Model"), 1),
        "made": rebuild(Storage("ComplexFloatStorage", "9", 1), (1,), (1,)),
    }
    state, elements = state_dict({"w": np.arange(3, dtype=np.float32)})
    for name, kept in besides.items():
        path = write_torch(tmp_path / f"{name}.ckpt", {"hyper_parameters": kept, "state_dict": state}, elements)
        assert read_torch(path, within="state_dict")["w"].read().tolist() == [0, 1, 2], name
        with pytest.raises(ConfigError, match="needs|cannot be read"):
            read_torch(path)


class Malicious:
    def __init__(self, target: Path):
        self.target = target

    def __reduce__(self):
        return os.system, (f"touch {self.target}",)


def test_code_is_refused_by_name_and_not_run(tmp_path):
    victim = tmp_path / "was_here"
    path = write_torch(tmp_path / "x.bin", {"weight": Malicious(victim)}, {})
    with pytest.raises(ConfigError, match=r"needs (posix|nt)\.system"):
        read_torch(path)
    assert not victim.exists()


@pytest.mark.parametrize(
    "function",
    [
        Global("builtins", "eval"),
        Global("torch._utils", "_rebuild_parameter"),
        Global("torch", "load"),
        Global("collections", "Counter"),
        Global("torch.storage", "FloatStorage"),
    ],
    ids=lambda g: f"{g.module}.{g.name}",
)
def test_every_other_name_is_refused(function, tmp_path):
    path = write_torch(tmp_path / "x.bin", {"weight": Call(function, "1")}, {})
    with pytest.raises(ConfigError, match=f"needs {function.module}.{function.name}"):
        read_torch(path)


@pytest.mark.parametrize(
    ("shape", "stride", "offset"),
    [
        ((4, 4), (4, 1), 0),
        ((2,), (1,), 11),
        ((2,), (100,), 0),
        ((2,), (-1,), 5),
        ((2**40,), (0,), 0),
        ((2, 2), (1,), 0),
        ((2,), (1,), -1),
    ],
)
def test_a_tensor_that_reaches_beyond_its_storage_is_refused(shape, stride, offset, tmp_path):
    storage = Storage("FloatStorage", "0", 12)
    path = write_torch(tmp_path / "x.bin", {"w": rebuild(storage, shape, stride, offset)}, {"0": bytes(48)})
    with pytest.raises(ConfigError, match="cannot be read"):
        read_torch(path)


def test_other_files_and_other_contents_are_named(tmp_path):
    (tmp_path / "old.bin").write_bytes(pickle.dumps({"weight": 1}))
    with pytest.raises(ConfigError, match="saved by torch before 1.6"):
        read_torch(tmp_path / "old.bin")
    for state, named in (({"step": 3}, "step"), ({"model": {}, "epoch": 1}, "model, epoch"), ([], "list")):
        with pytest.raises(ConfigError, match=rf"something other than names and tensors \({named}\); save it with"):
            read_torch(write_torch(tmp_path / "x.bin", state, {}))
    with pytest.raises(ConfigError, match="cannot be read"):
        read_torch(write_torch(tmp_path / "y.bin", {"w": rebuild(Storage("FloatStorage", "9", 1), (1,), (1,))}, {}))
    with pytest.raises(ConfigError, match="its byte order is not little-endian; save it on"):
        read_torch(write_torch(tmp_path / "big.bin", {}, {}, order="big"))
    with zipfile.ZipFile(tmp_path / "z.bin", "w") as archive:
        archive.writestr("readme", "")
    with pytest.raises(ConfigError, match="without a torch state dict"):
        read_torch(tmp_path / "z.bin")


@pytest.mark.parametrize(
    ("description", "said"),
    [
        (b"\x80\x02" + pickle.NONE + pickle.LONG_BINPUT + (2**32 - 1).to_bytes(4, "little") + b".", "other than names"),
        (b"\x80\x04" + pickle.BYTEARRAY8 + (2**60).to_bytes(8, "little"), "cannot be read"),
        (b"\x80\x02" + pickle.BININT + b"\x01", "cannot be read"),
        (bytes(LARGEST + 1), f"cannot be read .{LARGEST + 1:,} bytes, more than {LARGEST:,}"),
    ],
    ids=["remembered far away", "long", "short", "large"],
)
def test_a_description_takes_no_more_memory_than_it_has_bytes(description, said, tmp_path):
    """A damaged or hostile one took tens of gigabytes; it ended in a MemoryError or was killed."""
    path = tmp_path / "x.bin"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", description)
    with pytest.raises(ConfigError, match=said):
        read_torch(path)


@pytest.mark.parametrize(
    ("byte", "value", "said"),
    [
        (0, None, "data/0 is damaged .*CRC-32"),  # of its elements
        (6, 1, "cannot be read .*encrypted"),  # of its entry in the archive, as the next
        (8, 99, "cannot be read .*compression"),
    ],
)
def test_damage_is_told_in_words(byte, value, said, tmp_path):
    x = np.arange(64, dtype=np.float32)
    path = write_torch(
        tmp_path / "x.bin", {"w": rebuild(Storage("FloatStorage", "0", 64), (64,), (1,))}, {"0": x.tobytes()}
    )
    content = bytearray(path.read_bytes())
    if value is None:
        content[content.find(x.tobytes()) + byte] ^= 1
    else:  # `data.pkl` is the first entry; its header stands before it, and once more in the directory at the end
        content[content.find(b"PK\x03\x04") + byte] = content[content.find(b"PK\x01\x02") + 2 + byte] = value
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=f"x.bin.*{said}"):
        read_torch(path)["w"].read()
