"""Results in a directory are never taken for those of other settings."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from experiments.applications.made_with import claim
from hma_jax.config import ConfigError

SETTINGS = {"robot": "arm", "seeds": (0, 1), "search": {"candidates": 4}}


def test_what_was_made_otherwise_is_refused_by_name(tmp_path):
    out, run = tmp_path / "out", Path("runs/model")
    claim(out, run, SETTINGS)
    before = (out / "settings.json").read_text()
    assert json.loads(before) == {"run": "model", "robot": "arm", "seeds": [0, 1], "search": {"candidates": 4}}
    claim(out, run, SETTINGS)
    with pytest.raises(ConfigError, match="search.candidates: 4 -> 5.*another --out"):
        claim(out, run, SETTINGS | {"search": {"candidates": 5}})
    with pytest.raises(ConfigError, match="run: 'model' -> 'other'"):
        claim(out, Path("runs/other"), SETTINGS)
    assert (out / "settings.json").read_text() == before


def test_more_of_the_same_is_not_otherwise(tmp_path):
    claim(tmp_path, Path("model"), SETTINGS)
    more = SETTINGS | {"seeds": (0, 1, 2)}
    claim(tmp_path, Path("model"), more, grows=("seeds",))
    with pytest.raises(ConfigError, match="seeds"):
        claim(tmp_path, Path("model"), more)
