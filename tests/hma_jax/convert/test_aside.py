"""Directories that appear whole or not at all."""

import os

import pytest

from hma_jax.config import ConfigError
from hma_jax.convert.aside import written_aside


def test_a_directory_appears_whole_or_not_at_all(tmp_path):
    with pytest.raises(KeyError), written_aside(tmp_path / "out") as aside:
        (aside / "a").touch()
        raise KeyError
    assert not list(tmp_path.iterdir())
    with written_aside(tmp_path / "out") as aside:
        (aside / "a").touch()
        assert not (tmp_path / "out").exists()
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "a"]
    with pytest.raises(ConfigError, match="out exists already"), written_aside(tmp_path / "out"):
        pass


def test_what_a_killed_process_of_the_same_number_left_is_in_nobody_s_way(tmp_path):
    """Programs in containers often have the same number each time."""
    (tmp_path / f".out.{os.getpid()}.tmp").mkdir()
    with written_aside(tmp_path / "out") as aside:
        (aside / "a").touch()
    assert (tmp_path / "out" / "a").exists()
