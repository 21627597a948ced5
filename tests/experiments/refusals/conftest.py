"""The study whose commands are refused: prepared and trained once for all files here."""

from __future__ import annotations

import pytest

from experiments.cli.main import main
from tests.data_pipelines.fakes import write_rlds
from tests.experiments.idle import ARM, BASE, LENGTHS, SMOKE, idle, idle_training  # noqa: F401


@pytest.fixture(scope="session")
def arm(tmp_path_factory):
    return write_rlds(tmp_path_factory.mktemp("rlds"), ARM, LENGTHS, shards=2)


@pytest.fixture(scope="session")
def study(arm, tmp_path_factory):
    """A prepared study with a trained model; its second dataset is too short for any window."""
    root = tmp_path_factory.mktemp("study")
    short = write_rlds(root / "rlds", BASE, [3, 2, 3, 3])
    data = ("--data", str(arm), str(short))
    with idle():
        assert main(["train", *SMOKE, "--out", str(root / "out"), *data, "--checkpoint-every", "1"]) == 0
    return root / "out", data


@pytest.fixture
def refused(capsys):
    """Runs a command that must fail; returns its message."""

    def run(code: int, *arguments: object) -> str:
        capsys.readouterr()
        assert main([str(a) for a in arguments]) == code
        said = capsys.readouterr().err
        assert said.startswith("error: ") and said.count("error: ") == 1, said
        assert "Traceback" not in said and len(said) < 1500, said
        return said

    return run
