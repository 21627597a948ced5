"""Results in a directory are never taken for those of other settings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.applications.settings_file import hash_of, pin_settings
from hma_jax.config import ConfigError, DecodeConfig, SamplerConfig
from hma_jax.config.json import to_dict
from hma_jax.simulator.robots import Robot

PARAMS = {"trunk": {"w": np.arange(3.0)}}
SETTINGS = {"robot": "arm", "seeds": (0, 1), "search": {"candidates": 4}}
ARM = Robot("arm", 2, (-1.0,), (1.0,), (0.0,))


def simulator(params=PARAMS, decode=DecodeConfig(8, temperature=0.7), robot: Robot = ARM, channels: int = 0):
    model, tokenizer = SimpleNamespace(params=params), SimpleNamespace(channels=channels)
    return SimpleNamespace(model=model, tokenizer=tokenizer, decode=decode, robots={robot.name: robot})


def test_what_was_made_otherwise_is_refused_by_name(tmp_path):
    out, run, other = tmp_path / "out", Path("runs/model"), simulator({"trunk": {"w": np.zeros(3)}})
    pin_settings(out, run, simulator(), SETTINGS)
    before = (out / "settings.json").read_text()
    kept = json.loads(before)
    assert kept.pop("simulator")["decode"] == to_dict(DecodeConfig(8, temperature=0.7))
    assert kept == {
        "run": "model", "weights": hash_of(PARAMS), "robot": "arm", "seeds": [0, 1], "search": {"candidates": 4}
    }  # fmt: skip
    pin_settings(out, run, simulator(), SETTINGS)
    with pytest.raises(ConfigError, match="search.candidates: 4 -> 5.*another --out"):
        pin_settings(out, run, simulator(), SETTINGS | {"search": {"candidates": 5}})
    with pytest.raises(ConfigError, match="run: 'model' -> 'other'"):
        pin_settings(out, Path("runs/other"), simulator(), SETTINGS)
    pin_settings(out, Path("runs/model/"), simulator(), SETTINGS)
    with pytest.raises(ConfigError, match="weights: "):
        pin_settings(out, Path("elsewhere/model"), other, SETTINGS)
    assert (out / "settings.json").read_text() == before


def test_other_decode_settings_and_other_ranges_of_the_same_weights_are_refused(tmp_path):
    out, run = tmp_path / "out", Path("runs/model")
    pin_settings(out, run, simulator(), SETTINGS)
    with pytest.raises(ConfigError, match="simulator.decode.temperature: 0.7 -> 0.0"):
        pin_settings(out, run, simulator(decode=DecodeConfig(8, temperature=0.0)), SETTINGS)
    pin_settings(out, run, simulator(decode=DecodeConfig(4)), SETTINGS, unused=("simulator.decode",))
    with pytest.raises(ConfigError, match="simulator.decode.temperature: 0.7 -> 0.0"):
        pin_settings(out, run, simulator(decode=DecodeConfig(8, temperature=0.0)), SETTINGS, unused=("simulator.dec",))
    with pytest.raises(ConfigError, match="simulator.robots.arm: "):
        pin_settings(out, run, simulator(robot=replace(ARM, high=(2.0,))), SETTINGS)


def test_how_latents_are_sampled_counts_in_models_on_latents_alone(tmp_path):
    run, sampled = Path("runs/model"), DecodeConfig(8, temperature=0.7, sampler=SamplerConfig(temperature=0.7))
    for channels in (0, 4):
        pin_settings(tmp_path / str(channels), run, simulator(channels=channels), SETTINGS)
    pin_settings(tmp_path / "0", run, simulator(decode=sampled), SETTINGS)
    with pytest.raises(ConfigError, match="simulator.decode.sampler.temperature: 1.0 -> 0.7"):
        pin_settings(tmp_path / "4", run, simulator(decode=sampled, channels=4), SETTINGS)


def test_results_that_do_not_say_how_frames_were_filled_are_not_gone_on_with(tmp_path):
    """As settings.json was written before it said so. Whoever knows that nothing has changed removes the file."""
    file, run = tmp_path / "settings.json", Path("runs/model")
    pin_settings(tmp_path, run, simulator(), SETTINGS)
    known = json.loads(file.read_text())
    del known["simulator"]
    file.write_text(json.dumps(known))
    with pytest.raises(ConfigError, match="settings.json does not contain the decoding of frames.*remove this file"):
        pin_settings(tmp_path, run, simulator(), SETTINGS)
    with pytest.raises(ConfigError, match="search.candidates: 4 -> 5"):
        pin_settings(tmp_path, run, simulator(), SETTINGS | {"search": {"candidates": 5}})
    file.unlink()
    pin_settings(tmp_path, run, simulator(), SETTINGS)


def test_more_of_the_same_is_not_otherwise(tmp_path):
    pin_settings(tmp_path, Path("model"), simulator(), SETTINGS)
    more = SETTINGS | {"seeds": (0, 1, 2)}
    pin_settings(tmp_path, Path("model"), simulator(), more, may_differ=("seeds",))
    with pytest.raises(ConfigError, match="seeds"):
        pin_settings(tmp_path, Path("model"), simulator(), more)
