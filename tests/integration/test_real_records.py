"""Real records and a dataset that only a TOML file knows, from RLDS to an evaluated model."""

import json

import numpy as np
import pytest

from data_pipelines.registry import table as registry_table
from experiments.cli.main import main
from tests.data_pipelines.fakes import REAL_DATA, make_spec, png, write_rlds


@pytest.fixture
def stranger(tmp_path):
    """A robot nobody knows: a dict-valued action of 2 + 3 values, 10 Hz, one value constant."""
    rng = np.random.default_rng(0)

    def change(episode, features):
        images = features["steps/observation/image"]
        images[:] = [png(rng.integers(0, 256, (8, 8, 3), np.uint8)) for _ in images]

    return write_rlds(tmp_path / "data", make_spec("stranger", (2, 3)), [30] * 6, change=change)


@pytest.mark.slow
def test_real_and_unknown_robots_are_inspected_mixed_trained_and_evaluated(stranger, tmp_path, monkeypatch):
    monkeypatch.setattr(registry_table, "_registered", {})
    entries = str(tmp_path / "my.toml")
    inspect = ["data", "inspect", str(stranger), "--hz", "10", "--entry", entries, "--out", str(tmp_path)]
    assert main(inspect) == 0
    where = [
        "--preset", "smoke", "--out", str(tmp_path / "out"), "--registry", entries,
        "--data", str(REAL_DATA), str(stranger), "--set", "tokenizer_train.steps=2", "--set", "train.steps=2",
    ]  # fmt: skip
    assert main(["train", *where]) == 0
    assert main(["evaluate", str(tmp_path / "out" / "model"), *where]) == 0
    text = (tmp_path / "out" / "model" / "evaluation.json").read_text()
    evaluation = json.loads(text, parse_constant=pytest.fail)  # no NaN, which other programs do not read
    assert set(evaluation) == {"bridge_dataset", "stranger"}
    assert evaluation["stranger"]["psnr"]["episodes"] == 1 and evaluation["stranger"]["psnr"]["sem"] is None
    for metrics in evaluation.values():
        assert 0 < metrics["perplexity"]["mean"] < 2 * 256 and np.isfinite(metrics["delta_psnr"]["mean"])
    manifest = json.loads((tmp_path / "out" / "tokens" / "stranger" / "manifest.json").read_text())
    assert manifest["spec"]["action_keys"] == ["action/part_0", "action/part_1"]
    assert manifest["action_std"][2:] == [0, 0, 0]  # constant, and the loss is finite all the same
