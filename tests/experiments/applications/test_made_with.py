"""Results in a directory are never taken for those of other settings."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from experiments.applications.made_with import claim, hash_of
from hma_jax.config import ConfigError

PARAMS = {"trunk": {"w": np.arange(3.0)}}
SETTINGS = {"robot": "arm", "seeds": (0, 1), "search": {"candidates": 4}}


def test_what_was_made_otherwise_is_refused_by_name(tmp_path):
    out, run = tmp_path / "out", Path("runs/model")
    claim(out, run, PARAMS, SETTINGS)
    before = (out / "settings.json").read_text()
    kept = {"run": "model", "weights": hash_of(PARAMS), "robot": "arm", "seeds": [0, 1], "search": {"candidates": 4}}
    assert json.loads(before) == kept
    claim(out, run, PARAMS, SETTINGS)
    with pytest.raises(ConfigError, match="search.candidates: 4 -> 5.*another --out"):
        claim(out, run, PARAMS, SETTINGS | {"search": {"candidates": 5}})
    with pytest.raises(ConfigError, match="run: 'model' -> 'other'"):
        claim(out, Path("runs/other"), PARAMS, SETTINGS)
    claim(out, Path("runs/model/"), PARAMS, SETTINGS)
    with pytest.raises(ConfigError, match="weights: "):
        claim(out, Path("elsewhere/model"), {"trunk": {"w": np.zeros(3)}}, SETTINGS)
    assert (out / "settings.json").read_text() == before


def test_more_of_the_same_is_not_otherwise(tmp_path):
    claim(tmp_path, Path("model"), PARAMS, SETTINGS)
    more = SETTINGS | {"seeds": (0, 1, 2)}
    claim(tmp_path, Path("model"), PARAMS, more, grows=("seeds",))
    with pytest.raises(ConfigError, match="seeds"):
        claim(tmp_path, Path("model"), PARAMS, more)
