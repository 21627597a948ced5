"""Where files are kept for later processes."""

from pathlib import Path

import pytest

from hma_jax.config import ConfigError
from hma_jax.runtime.files import cache_directory


def test_a_user_without_a_home_directory_is_told_to_choose_another(monkeypatch, tmp_path):
    def none() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("HMA_CACHE_DIR")
    monkeypatch.setattr(Path, "home", none)
    with pytest.raises(ConfigError, match="set HMA_CACHE_DIR to"):
        cache_directory()
    monkeypatch.setenv("HMA_CACHE_DIR", str(tmp_path))
    assert cache_directory() == tmp_path
