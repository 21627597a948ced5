"""features.json and dataset_info.json, read as tfds reads them, and refused where they are hostile."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from data_pipelines import json_file
from data_pipelines.errors import DataError
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.features import MAX_DEPTH, MAX_FIELDS, parse_features
from data_pipelines.sources.rlds.schema import MAX_SHARDS, read_features, read_info, read_metadata
from tests.data_pipelines.fakes import REAL_DATA, make_spec, write_rlds

NOT_RECOGNISED = {"pythonClassName": "somebody.features.Own", "text": {}}


def tfds_fields(feature, key: str = "", lists: int = 0) -> dict[str, tuple]:
    """(image, size, shape, dtype) of each field, by tfds itself; `lists`: sequences that it lies in, one in the
    other."""
    import tensorflow_datasets as tfds

    if isinstance(feature, tfds.features.FeaturesDict):
        found = {}
        for name, child in feature.items():
            found |= tfds_fields(child, f"{key}/{name}" if key else name, lists)
        return found
    if isinstance(feature, tfds.features.Image) and lists < 2:
        return {key: (True, 0, tuple(feature.shape), np.dtype(feature.np_dtype).name)}
    if isinstance(feature, (tfds.features.Dataset, tfds.features.Sequence)):
        return tfds_fields(feature.feature, key, lists + 1)
    shape, dtype = (None,) * (lists - 1) + tuple(feature.shape), np.dtype(feature.np_dtype)
    numbers = dtype.kind in "fiub" and None not in shape
    size = int(np.prod(shape)) if numbers else 0
    return {key: (False, size, shape, dtype.name if dtype.kind in "fiub" else "string")}


def our_fields(directory: Path) -> dict[str, tuple]:
    return {k: (f.image, f.size, f.shape, f.dtype) for k, f in read_features(directory).items()}


def random_tree(rng: np.random.Generator, depth: int = 0):
    """A feature of any kind that tfds makes without TensorFlow, nested at random."""
    from tensorflow_datasets import features as tf

    dtypes = [np.float32, np.float64, np.int32, np.int64, np.uint8, np.bool_, np.float16]
    dtype = dtypes[rng.integers(len(dtypes))]
    shape = tuple(int(n) for n in rng.integers(1, 9, rng.integers(0, 4)))
    size = (int(rng.integers(8, 99)), None)[rng.integers(2)]
    leaves = [
        lambda: tf.Tensor(shape=shape, dtype=dtype),
        lambda: tf.Tensor(shape=(None, *shape), dtype=dtype),
        lambda: tf.Scalar(dtype=dtype),
        lambda: tf.Tensor(shape=shape, dtype=np.object_),
        lambda: tf.Text(),
        lambda: tf.Image(shape=(size, size, 3), encoding_format="jpeg"),
        lambda: tf.Image(shape=(size, size, 1), dtype=np.uint16, encoding_format="png"),
        lambda: tf.Image(),
        lambda: tf.LabeledImage(labels=5, shape=(None, None, 1)),
        lambda: tf.ClassLabel(num_classes=4),
        lambda: tf.BBoxFeature(),
        lambda: tf.Translation(languages=["de", "en"]),
    ]
    if depth < 4 and rng.random() < (0.9 if depth < 2 else 0.3):
        children = {f"f{n}": random_tree(rng, depth + 1) for n in range(rng.integers(1, 5))}
        group = tf.FeaturesDict(children)
        return (lambda: tf.Dataset(children), lambda: group, lambda: tf.Sequence(group))[rng.integers(3)]()
    return leaves[rng.integers(len(leaves))]()


# --- as tfds ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(40))
def test_any_tree_of_features_is_read_as_tfds_reads_it(tmp_path, seed):
    from tensorflow_datasets import features as tf

    rng = np.random.default_rng(seed)
    tree = tf.FeaturesDict({f"top{n}": random_tree(rng) for n in range(3)})
    tree.save_config(str(tmp_path))
    read_back = tf.FeaturesDict.from_config(str(tmp_path))
    assert our_fields(tmp_path) == tfds_fields(read_back)


def test_real_metadata_is_read_as_tfds_reads_it():
    import tensorflow_datasets as tfds

    directory = REAL_DATA / "1.0.0"
    info = tfds.builder_from_directory(str(directory)).info
    assert our_fields(directory) == tfds_fields(info.features)
    meta = read_metadata(directory, "train")
    assert (meta.name, meta.version) == (info.name, str(info.version))
    assert [s.name for s in meta.shards] == [Path(p).name for p in info.splits["train"].filepaths]
    assert meta.shard_lengths == info.splits["train"].shard_lengths
    assert read_info(directory).splits["train"].bytes == info.splits["train"].num_bytes


@pytest.mark.parametrize("count", [1, 7, 12])
def test_shards_are_called_as_tfds_calls_them(tmp_path, count):
    import tensorflow_datasets as tfds

    directory = write_rlds(tmp_path, make_spec(), [3])
    for template in ("", "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}", "{SPLIT}_{SHARD_INDEX}.{FILEFORMAT}"):
        change_info(directory, template=template, lengths=["1"] * count)
        split = tfds.builder_from_directory(str(directory)).info.splits["train"]
        assert read_info(directory).shard_names("train") == [Path(p).name for p in split.filepaths]


def test_form_of_tfds_4_0_is_read(tmp_path):
    core = "tensorflow_datasets.core.features"
    schema = {
        "type": f"{core}.features_dict.FeaturesDict",
        "content": {
            "steps": {
                "type": f"{core}.dataset_feature.Dataset",
                "content": {
                    "feature": {
                        "type": f"{core}.features_dict.FeaturesDict",
                        "content": {
                            "image": {
                                "type": f"{core}.image_feature.Image",
                                "content": {"shape": [64, 64, 3], "dtype": "uint8", "encoding_format": "png"},
                            },
                            "action": {
                                "type": f"{core}.tensor_feature.Tensor",
                                "content": {"shape": [7], "dtype": "float32", "encoding": "none"},
                            },
                            "reward": {
                                "type": f"{core}.scalar.Scalar",
                                "content": '{"dtype": "float32", "shape": {}}',
                                "proto_cls": "tensorflow_datasets.TensorFeature",
                            },
                        },
                    },
                    "length": None,
                },
            }
        },
    }
    (tmp_path / "features.json").write_text(json.dumps(schema))
    fields = our_fields(tmp_path)
    assert fields["steps/image"] == (True, 0, (64, 64, 3), "uint8")
    assert fields["steps/action"] == (False, 7, (7,), "float32")
    assert fields["steps/reward"] == (False, 1, (), "float32")


# --- what is not done -------------------------------------------------------------------------


def test_module_that_a_schema_names_is_not_imported(tmp_path, monkeypatch):
    directory = write_rlds(tmp_path, make_spec(), [3, 3])
    (tmp_path / "planted_module.py").write_text("raise SystemExit('planted_module was imported')")
    monkeypatch.syspath_prepend(tmp_path)
    schema = json.loads((directory / "features.json").read_text())
    fields = schema["featuresDict"]["features"]
    fields["own"] = {"pythonClassName": "planted_module.Own", "text": {}}
    fields["old"] = {"pythonClassName": "planted_module.Old", "jsonFeature": {"json": '{"a": [1]}'}}
    (directory / "features.json").write_text(json.dumps(schema))
    assert read_metadata(directory, "train").features["own"].size == 0
    assert "planted_module" not in sys.modules


def test_reading_metadata_imports_neither_tfds_nor_protobuf(tmp_path):
    code = (
        "import sys; from data_pipelines.sources.rlds.schema import read_metadata, resolve_version; "
        f"read_metadata(resolve_version({str(REAL_DATA)!r}), 'train'); "
        "print([m for m in ('tensorflow_datasets', 'google.protobuf', 'etils', 'grain') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


# --- what is refused --------------------------------------------------------------------------


def change_info(directory: Path, lengths=None, template=None, **fields) -> None:
    path = directory / "dataset_info.json"
    info = json.loads(path.read_text()) | fields
    if lengths is not None:
        info["splits"][0]["shardLengths"] = lengths
    if template is not None:
        info["splits"][0]["filepathTemplate"] = template
    path.write_text(json.dumps(info))


def tensor(dimensions, dtype="float32"):
    return {"tensor": {"shape": {"dimensions": dimensions}, "dtype": dtype}}


def group(features):
    return {"featuresDict": {"features": features}}


def nested(levels: int):
    node = NOT_RECOGNISED
    for _ in range(levels):
        node = group({"a": node})
    return node


REFUSED_SCHEMAS = {
    "deep": nested(MAX_DEPTH + 1),
    "many": group({f"f{n}": NOT_RECOGNISED for n in range(MAX_FIELDS + 1)}),
    "huge": group({"a": tensor(["65536", "65536"])}),
    "beyond": group({"a": tensor([str(2**70)])}),
    "negative": group({"a": tensor(["-2"])}),
    "fraction": group({"a": tensor([1.5])}),
    "dimensions": group({"a": tensor(["1"] * 9)}),
    "escape": group({"\x1b[31m": NOT_RECOGNISED}),
    "surrogate": group({"\ud800": NOT_RECOGNISED}),
    "two": group({"a": {"text": {}, "tensor": {}}}),
    "list": group({"a": [1]}),
    "json": group({"a": {"pythonClassName": "x.Image", "jsonFeature": {"json": "[" * 5000}}}),
}


@pytest.mark.parametrize("name", REFUSED_SCHEMAS)
def test_schema_beyond_its_bounds_is_refused(name):
    with pytest.raises(ValueError) as caught:
        parse_features(REFUSED_SCHEMAS[name])
    assert len(str(caught.value)) < 400 and str(caught.value).isprintable()


@pytest.mark.parametrize("file", ["features.json", "dataset_info.json"])
@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 100_000, "\xff\xfe", '{"a": ' + "9" * 5000 + "}"])
def test_json_that_no_parser_survives_names_its_file(tmp_path, file, text):
    directory = write_rlds(tmp_path, make_spec(), [3])
    (directory / file).write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=file):
        read_metadata(directory, "train")


def test_json_file_has_bounds(tmp_path, monkeypatch):
    directory = write_rlds(tmp_path, make_spec(), [3])
    monkeypatch.setattr(json_file, "MAX_VALUES", 5)
    with pytest.raises(DataError, match=r"dataset_info.json has more than 5 values"):
        read_info(directory)
    monkeypatch.setattr(json_file, "MAX_BYTES", 99)
    with pytest.raises(DataError, match=r"dataset_info.json has more than 99 bytes"):
        read_info(directory)


@pytest.mark.parametrize("name", ["../x", "/x", ".x", "", "a/b", "a\nb", "x" * 129, 7, None])
def test_name_that_is_no_name_of_a_directory_is_refused(tmp_path, name):
    directory = write_rlds(tmp_path, make_spec(), [3])
    change_info(directory, name=name)
    with pytest.raises(DataError, match=r"dataset_info.json: name is .*use up to 128 letters"):
        read_metadata(directory, "train")


def test_name_that_tfds_takes_is_to_be_changed_not_restored(tmp_path):
    directory = write_rlds(tmp_path, make_spec(), [3])
    change_info(directory, name="küche")
    with pytest.raises(DataError, match="Change it there and in the names of the shards") as refused:
        read_metadata(directory, "train")
    assert "Restore" not in str(refused.value)
    change_info(directory, name="kueche")
    (shard,) = directory.glob("*.tfrecord-*")
    shard.rename(directory / shard.name.replace(make_spec().name, "kueche"))
    assert len(RldsDataset(directory)) == 1


@pytest.mark.parametrize(
    "template", ["{DATASET.__class__}", "{SPLIT:>999999999}", "{0}", "..", "a/..", "/", ".hidden", "x" * 256]
)
def test_template_makes_plain_names_of_shards_only(tmp_path, template):
    directory = write_rlds(tmp_path, make_spec(), [3])
    change_info(directory, template=template)
    with pytest.raises(DataError, match=r"dataset_info.json: .*filepathTemplate"):
        read_metadata(directory, "train")


@pytest.mark.parametrize("lengths", [["-1"], ["x"], [1.5], [2**63], "7", ["9" * 30], ["0"] * (MAX_SHARDS + 1)])
def test_shard_lengths_are_counts(tmp_path, lengths):
    directory = write_rlds(tmp_path, make_spec(), [3])
    change_info(directory, lengths=lengths)
    with pytest.raises(DataError, match=r"dataset_info.json: .*train"):
        read_metadata(directory, "train")


def test_shard_outside_of_the_directory_is_not_read(tmp_path):
    """A template with a folder names a file in the directory itself, as ever."""
    directory = write_rlds(tmp_path, make_spec(), [3])
    shutil.copy(next(directory.glob("*.tfrecord*")), tmp_path / "outside")
    change_info(directory, template="../../outside")
    assert read_metadata(directory, "train").shards == [directory / "outside"]
