"""Run directories of converted models."""

import errno
import os

import pytest

from hma_jax.convert import read_official, write_run
from hma_jax.training import checkpoints
from hma_jax.training.checkpoints import SaveError
from tests.hma_jax.convert.fakes import DISCRETE, make_checkpoint


def test_a_full_disk_is_said_of_the_directory_that_was_asked_for(tmp_path, monkeypatch):
    """The message was one of training: of a temporary directory, and of the step from which to go on."""

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(checkpoints, "sync_tree", full)
    run = read_official(make_checkpoint(tmp_path / "official", DISCRETE, [("arm", 7, 1)]))
    with pytest.raises(SaveError, match=f"^cannot write {tmp_path}/run: No space left on device. Make") as refused:
        write_run(run, tmp_path / "run")
    assert "step" not in str(refused.value) and [path.name for path in tmp_path.iterdir()] == ["official"]
