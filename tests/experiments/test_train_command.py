"""`hma train`: its own settings, and what it says it trains on."""

import pytest

from experiments import trial as trials
from experiments.cli.main import main
from hma_jax.training.train import load_run
from tests.data_pipelines.fakes import write_rlds
from tests.experiments.test_cli_errors import ARM, BASE, SMOKE, idle_training  # noqa: F401


@pytest.fixture(scope="module")
def where(tmp_path_factory) -> list[str]:
    """Ten training episodes of one robot with 3 windows each, of another none that is long enough."""
    root = tmp_path_factory.mktemp("data")
    data = [write_rlds(root, ARM, [12] * 12), write_rlds(root, BASE, [5, 6, 7, 5])]
    return [*SMOKE, "--out", str(root / "out"), "--data", *map(str, data)]


@pytest.fixture
def train(where, tmp_path, monkeypatch, capsys):
    """Runs `hma train`; returns what it said and how training was called."""
    calls, real = [], trials.train_trial

    def spy(trial, materials, run, **how):
        calls.append((trial, how["options"]))
        return real(trial, materials, run, **how)

    monkeypatch.setattr(trials, "train_trial", spy)

    def run(*arguments: str):
        capsys.readouterr()
        assert main(["train", *where, "--run", str(tmp_path / "run"), *arguments]) == 0
        return capsys.readouterr().out, *calls[-1]

    return run


def test_all_trajectories_unless_told_otherwise(train, tmp_path):
    """The smoke study has at most 4 of each robot; no sweep's bound holds for a single model."""
    said, trial, _ = train()
    assert trial.max_trajectories is None
    assert "training on 1 of 2 robots: 10 of 12 trajectories, 30 windows of 4 frames" in said
    assert f"note: not trained on {BASE.name}: 4 frames need 8 native frames, the longest of its 2 train" in said
    assert load_run(tmp_path / "run").provenance["loader"]["max_trajectories"] is None


def test_fewer_trajectories_when_asked_for(train):
    said, trial, _ = train("--trajectories", "3")
    assert trial.max_trajectories == 3
    assert "3 of 12 trajectories (at most 3 of each robot), 9 windows" in said


@pytest.mark.parametrize(("asked", "every"), [(None, 2), ("3", 3), ("0", 0)])
def test_checkpoints_are_saved_as_often_as_asked_for(train, asked, every):
    _, _, options = train("--set", "train.steps=12", *(["--checkpoint-every", asked] if asked else []))
    assert options.checkpoint_every == every


@pytest.mark.parametrize("setting", [["--trajectories", "0"], ["--checkpoint-every", "-1"]])
def test_settings_of_its_own_are_checked_before_any_work(setting, where, capsys):
    assert main(["train", *where, *setting]) == 2
    assert f"{setting[0]} must " in capsys.readouterr().err


def test_a_width_that_no_sweep_has(train, where, tmp_path):
    _, trial, _ = train("--set", "model.width=24")
    assert trial.model.width == 24
    assert load_run(tmp_path / "run").model.width == 24
