from __future__ import annotations

import numpy as np
import pytest
import tensorflow_datasets as tfds

from data_pipelines.errors import DataError
from data_pipelines.sources.rlds.example import encode_example, parse_example
from data_pipelines.sources.rlds.tfrecord import read_record
from tests.data_pipelines.fakes import REAL_DATA
from tests.data_pipelines.shards import index_shard


@pytest.fixture(scope="module")
def records():
    shard = next(REAL_DATA.glob("*/*.tfrecord*"))
    index = index_shard(shard)
    return [read_record(shard, int(o), int(n)) for o, n in zip(index.offsets, index.lengths, strict=True)]


def test_real_records_equal_what_tfds_decodes(records):
    features = tfds.builder_from_directory(str(REAL_DATA / "1.0.0")).info.features
    for record in records:
        ours = parse_example(record)
        theirs = features.deserialize_example_np(record)
        assert ours["episode_metadata/episode_id"].tolist() == [theirs["episode_metadata"]["episode_id"]]
        for t, step in enumerate(theirs["steps"]):
            assert np.array_equal(ours["steps/action"].reshape(10, 7)[t], step["action"])
            state = step["observation"]["state"]
            assert np.array_equal(ours["steps/observation/state"].reshape(10, 7)[t], state)
            for key in ("reward", "discount", "is_first", "is_last", "is_terminal"):
                assert ours[f"steps/{key}"][t] == step[key]
            assert ours["steps/language_instruction"][t] == step["language_instruction"]


def test_real_records_equal_a_protobuf_message(records):
    """The wire format itself, against protobuf's own parser with a message made at run time."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="example.proto", package="t", syntax="proto3")
    for name, kind in (("BytesList", 12), ("FloatList", 2), ("Int64List", 3)):
        file.message_type.add(name=name).field.add(name="value", number=1, label=3, type=kind)
    feature = file.message_type.add(name="Feature")
    feature.oneof_decl.add(name="kind")
    for number, name in ((1, "BytesList"), (2, "FloatList"), (3, "Int64List")):
        feature.field.add(name=name.lower(), number=number, label=1, type=11, type_name=f".t.{name}", oneof_index=0)
    features = file.message_type.add(name="Features")
    entry = features.nested_type.add(name="FeatureEntry")
    entry.options.map_entry = True
    entry.field.add(name="key", number=1, label=1, type=9)
    entry.field.add(name="value", number=2, label=1, type=11, type_name=".t.Feature")
    features.field.add(name="feature", number=1, label=3, type=11, type_name=".t.Features.FeatureEntry")
    file.message_type.add(name="Example").field.add(
        name="features", number=1, label=1, type=11, type_name=".t.Features"
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Example"))

    odd = encode_example({"i": np.array([-1, 0, 127, 128, 2**62, -(2**63)]), "none": [], "f": np.zeros(0)})
    for record in [*records, odd]:
        ours, theirs = parse_example(record), message.FromString(record).features.feature
        assert set(ours) == set(theirs)
        for key, value in ours.items():
            kind = theirs[key].WhichOneof("kind")
            assert list(value) == list(getattr(theirs[key], kind).value)
        assert message.FromString(encode_example(ours)).features.feature == theirs


def test_only_the_wanted_keys_are_decoded(records):
    found = parse_example(records[0], {"steps/action", "absent"})
    assert list(found) == ["steps/action"]


def test_round_trip_keeps_every_kind_of_value():
    features = {
        "floats": np.linspace(-1, 1, 9, dtype=np.float32).reshape(3, 3),
        "big": np.array([2**40, -5, 0, 300]),
        "flags": np.array([True, False]),
        "bytes": [b"", b"\x00\xff", b"x" * 1000],
        "nothing": [],
    }
    back = parse_example(encode_example(features))
    assert back["floats"].dtype == np.float32 and np.array_equal(back["floats"], features["floats"].ravel())
    assert back["big"].tolist() == [2**40, -5, 0, 300]
    assert back["flags"].tolist() == [1, 0]
    assert back["bytes"] == features["bytes"] and back["nothing"] == []


def test_encoding_does_not_depend_on_the_order_of_keys():
    a, b = np.zeros(3, np.float32), [b"x"]
    assert encode_example({"a": a, "b": b}) == encode_example({"b": b, "a": a})


def test_unpacked_numbers_are_read_as_well():
    """Older writers store each number with its own tag."""
    ints = b"\x1a\x05" + b"\x08\x01\x08\x96\x01"  # Feature{Int64List{1, 150}}
    floats = b"\x12\x05" + b"\x0d" + np.float32(2.5).tobytes()
    for feature, value in ((ints, [1, 150]), (floats, [2.5])):
        entry = b"\x0a\x01k\x12" + bytes([len(feature)]) + feature
        features = b"\x0a" + bytes([len(entry)]) + entry
        assert parse_example(b"\x0a" + bytes([len(features)]) + features)["k"].tolist() == value


def test_floats_that_do_not_fill_their_list_are_refused():
    feature = b"\x12\x07" + b"\x0a\x05" + bytes(5)  # Feature{FloatList of 5 bytes}
    entry = b"\x0a\x01k\x12" + bytes([len(feature)]) + feature
    features = b"\x0a" + bytes([len(entry)]) + entry
    with pytest.raises(DataError, match=r"is 5 bytes long, which is not a multiple of 4(?!, which)"):
        parse_example(b"\x0a" + bytes([len(features)]) + features)


def test_cut_off_or_foreign_bytes_are_refused_not_misread(records):
    whole = records[0]
    for data in (whole[:-7], whole[: len(whole) // 2], b"\xff" * 40, b"\x0a\x05abc"):
        with pytest.raises(DataError, match="not a tf.train.Example"):
            parse_example(data)


def test_values_that_cannot_be_stored_are_named():
    with pytest.raises(DataError, match="'text' cannot be stored"):
        encode_example({"text": ["a str"]})
