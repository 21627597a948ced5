"""Results in a directory are never taken for those of other settings."""

from __future__ import annotations

import json
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.applications import own_policy
from experiments.applications.settings_file import hash_of, pin_settings
from experiments.running.machine import git_commit
from experiments.tables import make_once
from hma_jax.config import ConfigError, DecodeConfig, SamplerConfig
from hma_jax.config.base import later
from hma_jax.config.json import completed, to_dict
from hma_jax.simulator.robots import Robot
from tests.full_disk import full_disk

RESULTS = Path(__file__).parents[3] / "experiments" / "results"
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


def test_every_start_leaves_commit_machine_and_command_beside_the_settings(tmp_path, monkeypatch):
    """Trials are added to a directory by later commits, and its settings do not say by which."""
    monkeypatch.setattr(sys, "argv", ["somewhere/plan_actions.py", "runs/a model", "--out", "out"])
    module = SimpleNamespace(__spec__=SimpleNamespace(name="experiments.applications.plan_actions"))
    monkeypatch.setitem(sys.modules, "__main__", module)
    for _ in range(2):
        pin_settings(tmp_path, Path("runs/model"), simulator(), SETTINGS)
    with pytest.raises(ConfigError, match="search"):
        pin_settings(tmp_path, Path("runs/model"), simulator(), SETTINGS | {"search": {"candidates": 5}})
    first, second = map(json.loads, (tmp_path / "provenance.jsonl").read_text().splitlines())
    assert first["command"] == "python -m experiments.applications.plan_actions 'runs/a model' --out out"
    assert first["commit"] == git_commit() and first["processor"] and first["settings"] == "settings.json"
    assert second == first | {"began": second["began"]}
    time.strptime(first["began"], "%Y-%m-%dT%H:%M:%SZ")  # raises for another form


def test_a_file_that_was_cut_off_in_copying_is_named(tmp_path):
    """The command ended with a traceback."""
    pin_settings(tmp_path, Path("runs/model"), simulator(), SETTINGS)
    for path in (tmp_path / "settings.json", tmp_path / "outcome.json"):
        path.write_text('{"run": "mod')
    with pytest.raises(ConfigError, match=r"/settings\.json is damaged \(.*\); copy it again"):
        pin_settings(tmp_path, Path("runs/model"), simulator(), SETTINGS)
    with pytest.raises(ConfigError, match=r"/outcome\.json is damaged \(.*\); remove it"):
        make_once(tmp_path / "outcome.json", dict)


def test_a_start_that_a_full_disk_cut_off_spoils_no_other(tmp_path):
    """The next one was appended to its half line."""
    pin_settings(tmp_path, Path("runs/model"), simulator(), SETTINGS)
    starts = tmp_path / "provenance.jsonl"
    with full_disk(), pytest.raises(OSError, match=r"provenance\.jsonl'"):
        pin_settings(tmp_path, Path("runs/model"), simulator(), SETTINGS)
    starts.write_bytes(starts.read_bytes() + b'{"began": ')
    pin_settings(tmp_path, Path("runs/model"), simulator(), SETTINGS)
    assert ["settings.json"] * 2 == [json.loads(line)["settings"] for line in starts.read_text().splitlines()]


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
    run, sampled = Path("runs/model"), DecodeConfig(8, temperature=0.7, sampler=SamplerConfig(temperature=1.0))
    for channels in (0, 4):
        pin_settings(tmp_path / str(channels), run, simulator(channels=channels), SETTINGS)
    pin_settings(tmp_path / "0", run, simulator(decode=sampled), SETTINGS)
    with pytest.raises(ConfigError, match="simulator.decode.sampler.temperature: 0.7 -> 1.0"):
        pin_settings(tmp_path / "4", run, simulator(decode=sampled, channels=4), SETTINGS)


def test_results_that_do_not_say_how_frames_were_filled_are_not_gone_on_with(tmp_path):
    """As some that are committed."""
    file, run = tmp_path / "settings.json", Path("runs/model")
    pin_settings(tmp_path, run, simulator(), SETTINGS)
    known = json.loads(file.read_text())
    del known["simulator"]
    file.write_text(json.dumps(known))
    with pytest.raises(ConfigError, match="simulator: None -> "):
        pin_settings(tmp_path, run, simulator(), SETTINGS)


def test_more_of_the_same_is_not_otherwise(tmp_path):
    pin_settings(tmp_path, Path("model"), simulator(), SETTINGS)
    more = SETTINGS | {"seeds": (0, 1, 2)}
    pin_settings(tmp_path, Path("model"), simulator(), more, may_differ=("seeds",))
    with pytest.raises(ConfigError, match="seeds"):
        pin_settings(tmp_path, Path("model"), simulator(), more)


@dataclass(frozen=True)
class Search:
    candidates: int = 4


@dataclass(frozen=True)
class Cooled(Search):
    cooling: float = later(0.5, before=1.0)


@dataclass(frozen=True)
class Decode(DecodeConfig):
    cooling: float = later(0.5, before=1.0)


@pytest.mark.parametrize("within", [lambda search: search, lambda search: {"search": search}])
def test_a_setting_that_came_later_has_the_value_from_before_in_a_file_without_it(within, tmp_path):
    for out, first in ((tmp_path / "before", Search()), (tmp_path / "after", Cooled(cooling=1.0))):
        for search in (first, Cooled(cooling=1.0)):
            pin_settings(out, Path("model"), simulator(), within(search), {"robot": "arm"})
        with pytest.raises(ConfigError, match="cooling: 1.0 -> 0.5"):
            pin_settings(out, Path("model"), simulator(), within(Cooled()), {"robot": "arm"})


def test_a_setting_of_decoding_that_came_later_has_the_value_from_before_in_a_file_without_it(tmp_path):
    for decode in (DecodeConfig(8), Decode(8, cooling=1.0)):
        pin_settings(tmp_path, Path("model"), simulator(decode=decode), SETTINGS)
    with pytest.raises(ConfigError, match="simulator.decode.cooling: 1.0 -> 0.5"):
        pin_settings(tmp_path, Path("model"), simulator(decode=Decode(8)), SETTINGS)


@pytest.mark.parametrize("name", ["own_policy_chunk", "own_policy_grown"])
def test_committed_policies_can_be_gone_on_with(name):
    """Their files lack settings that came later."""
    known = json.loads((RESULTS / name / "settings.json").read_text())
    asked = own_policy.Settings(predicts="chunk" if name.endswith("chunk") else "noise", limits="spread")
    wanted = to_dict(asked)
    assert {key: x for key, x in completed(known, asked).items() if key in wanted} == wanted
