"""Names and paths that files of others give."""

from __future__ import annotations

from pathlib import Path

import pytest

from data_pipelines.names import MAX_NAME_LENGTH, is_dataset_name, made_name, quote, safe_join
from data_pipelines.registry import DatasetSpec, all_specs
from data_pipelines.registry.toml_file import load_entries
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import make_spec

GOOD = ["toy", "bridge_dataset", "fractal20220817_data", "_x", "0", "A.b-c", "x" * MAX_NAME_LENGTH]
BAD = [
    "",
    ".",
    "..",
    ".hidden",
    "../x",
    "/x",
    "a/b",
    "a\\b",
    "a b",
    "a\n",
    "-rf",
    "ä",
    "\x00",
    "x" * (MAX_NAME_LENGTH + 1),
]


def test_every_name_of_the_registry_is_one():
    assert all(is_dataset_name(spec.name) for spec in all_specs())


@pytest.mark.parametrize("name", GOOD)
def test_name(name):
    assert is_dataset_name(name) and make_spec(name).name == name


@pytest.mark.parametrize("name", BAD)
def test_text_that_is_no_name(name):
    assert not is_dataset_name(name)
    with pytest.raises(ConfigError, match="cannot be the name of a dataset: use up to 128 letters"):
        make_spec(name)


@pytest.mark.parametrize("name", ["../x", "/x", ".x"])
def test_entry_of_a_file_cannot_be_called_like_a_path(tmp_path, name):
    path = tmp_path / "own.toml"
    path.write_text(f'["{name}"]\nimage_key = "image"\naction_keys = ["action"]\naction_dims = [7]\nhz = 5\n')
    with pytest.raises(ConfigError, match="own.toml: .* cannot be the name of a dataset"):
        load_entries(path)


def test_file_of_entries_that_is_nested_too_deeply_is_named(tmp_path):
    path = tmp_path / "own.toml"
    path.write_text("a = " + "[" * 5000)
    with pytest.raises(ConfigError, match="own.toml: not a TOML file"):
        load_entries(path)


def test_part_of_a_field_with_a_huge_number_is_no_crash():
    with pytest.raises(ConfigError):
        DatasetSpec("toy", "image", ("action[:" + "9" * 5000 + "]",), (7, 7), 5.0)


@pytest.mark.parametrize("text", ["a", "a/b", "..a/b..", "a/./b", "videos/x/chunk-000/file.mp4"])
def test_path_inside(text):
    assert safe_join(Path("/root"), text) == Path("/root") / text


@pytest.mark.parametrize("text", ["", "..", "../a", "a/../../b", "/a", "a\\..\\b", "a\0b", "a\nb", "a" * 1025, 7, None])
def test_path_that_may_leave(text):
    with pytest.raises(ValueError):
        safe_join(Path("/root"), text)


@pytest.mark.parametrize(
    ("text", "name"),
    [("pusher_sand", "pusher_sand"), ("My-Arm 2.0", "my_arm_2_0"), ("7_dof", "dataset_7_dof"), ("Ä", "dataset_")],
)
def test_a_name_is_made_of_any_text(text, name):
    assert made_name(text) == name


def test_values_of_others_are_shown_on_one_short_line():
    deep = []
    for _ in range(5000):
        deep = [deep]
    for value in (deep, "\x1b[31m" * 99, b"\n" * 999, ["x"] * 999, {"a": "\ud800"}, None):
        assert quote(value).isprintable() and len(quote(value)) < 100
