"""Directories that appear whole or not at all."""

import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.convert.atomic import atomic_directory
from hma_jax.convert.tensors import write_safetensors
from tests.full_disk import full_disk
from tests.written import record_writes


def test_a_directory_appears_whole_or_not_at_all(tmp_path):
    with pytest.raises(KeyError), atomic_directory(tmp_path / "out") as temporary:
        (temporary / "a").touch()
        raise KeyError
    assert not list(tmp_path.iterdir())
    with atomic_directory(tmp_path / "out") as temporary:
        (temporary / "a").touch()
        assert not (tmp_path / "out").exists()
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "a"]
    with pytest.raises(ConfigError, match="out exists already"), atomic_directory(tmp_path / "out"):
        pass


@pytest.mark.parametrize("there", [True, False])
def test_a_link_to_an_empty_directory_or_to_none_is_followed(there, tmp_path):
    """As of a disk that is linked to; the link itself cannot be replaced by a directory."""
    (tmp_path / "disk").mkdir()
    if there:
        (tmp_path / "disk" / "out").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk" / "out")
    with atomic_directory(tmp_path / "link") as temporary:
        (temporary / "a").touch()
    assert (tmp_path / "link").is_symlink() and [p.name for p in (tmp_path / "disk").rglob("*")] == ["out", "a"]


def test_all_of_it_is_on_the_disk_before_it_is_seen(tmp_path, monkeypatch):
    """A loss of power left a directory of empty files."""
    with atomic_directory(tmp_path / "out") as temporary:
        (temporary / "a").touch()
        done = record_writes(tmp_path, monkeypatch)
    assert done == ["a", temporary.name, "rename", tmp_path.name]


def test_what_a_killed_process_left_half_written_is_removed(tmp_path):
    with pytest.raises(KeyError), atomic_directory(tmp_path / "out") as temporary:
        raise KeyError
    temporary.mkdir()
    (temporary / "half").touch()
    with atomic_directory(tmp_path / "out") as temporary:
        (temporary / "a").touch()
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "a"]


def test_a_full_disk_is_said_of_the_place_and_leaves_nothing(tmp_path):
    weights = {"one": np.zeros(9000, np.float32)}
    for write in (lambda path: path.write_text("a" * 9000), lambda path: write_safetensors(path, weights)):
        with full_disk(1000), pytest.raises(OSError, match="out.*"), atomic_directory(tmp_path / "out") as temporary:
            write(temporary / "model.safetensors")
        assert not list(tmp_path.iterdir())


def test_two_that_write_to_one_place_do_not_meet(tmp_path):
    with atomic_directory(tmp_path / "out") as temporary:
        (temporary / "a").touch()
        with pytest.raises(ConfigError, match="out is being written .process"), atomic_directory(tmp_path / "out"):
            pass
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "a"]
