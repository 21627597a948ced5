"""Directories that appear whole or not at all."""

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


def test_what_a_killed_process_left_half_written_is_removed(tmp_path):
    with pytest.raises(KeyError), written_aside(tmp_path / "out") as aside:
        raise KeyError
    aside.mkdir()
    (aside / "half").touch()
    with written_aside(tmp_path / "out") as aside:
        (aside / "a").touch()
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "a"]


def test_two_that_write_to_one_place_do_not_meet(tmp_path):
    with written_aside(tmp_path / "out") as aside:
        (aside / "a").touch()
        with pytest.raises(ConfigError, match="out is being written .process"), written_aside(tmp_path / "out"):
            pass
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "a"]
