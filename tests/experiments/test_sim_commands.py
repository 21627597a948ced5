"""`hma data sim`: what it writes, what it says, and what it refuses."""

from __future__ import annotations

import pytest
from PIL import Image

from data_pipelines.simulators import generate
from experiments.cli.data.contact_sheet import TILE
from experiments.cli.main import main
from tests.data_pipelines.simulators.fakes import fake_workers


@pytest.mark.parametrize("command", ["sim", "sim-table"])
def test_help(command, capsys):
    with pytest.raises(SystemExit) as end:
        main(["data", command, "--help"])
    assert end.value.code == 0
    assert f"usage: hma data {command}" in capsys.readouterr().out


def test_datasets_and_contact_sheets_are_written_and_named(tmp_path, monkeypatch, capsys):
    fake_workers(monkeypatch)
    command = ["data", "sim", "--names", "pusht", "--episodes", "2", "--size", "16", "--out", str(tmp_path)]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "2 of 2 episodes" in said
    assert f"next: hma study --preset smoke --out runs/sim --data {tmp_path}/*/1.0.0" in said
    assert f"or, to look at them first: hma data view {tmp_path}/*/1.0.0" in said
    assert Image.open(tmp_path / "pusht" / "contact.png").height > 2 * TILE  # a row for each episode
    found = sorted(p.name for p in (tmp_path / "pusht").iterdir())
    assert found == ["1.0.0", "contact.png", "stats.json"]

    assert main(["data", "sim-table", str(tmp_path)]) == 0
    assert "| `pusht` | gym-pusht | 2 | 10 | push script | 2 | 160 |" in capsys.readouterr().out


def test_what_is_there_is_not_replaced(tmp_path, monkeypatch, capsys):
    """Neither hours of simulation, by a smaller preset, nor somebody's recordings of a robot of that name."""
    workers = fake_workers(monkeypatch)

    def sim(*more: str) -> int:
        workers.made.clear()
        names = ["--names", "pusht", "--out", str(tmp_path)]
        return main(["data", "sim", *names, *(more or ("--episodes", "3", "--size", "16"))])

    assert sim() == 0
    shards = {p: p.read_bytes() for p in (tmp_path / "pusht" / "1.0.0").iterdir()}
    capsys.readouterr()
    assert sim("--preset", "smoke", "--seed", "1") == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "pusht/1.0.0: episodes: 3 -> 4; size: 16 -> 64; seed: 0 -> 1. Nothing was changed" in said
    monkeypatch.setattr(generate, "GENERATOR_VERSION", generate.GENERATOR_VERSION + 1)
    assert sim() == 0
    assert "pusht in" in (said := capsys.readouterr().out) and "made by other versions of the simulators" in said
    assert not workers.made and shards == {p: p.read_bytes() for p in shards}

    (tmp_path / "pusht" / "1.0.0" / "metadata.json").unlink()
    assert sim() == 2
    assert "it does not say how it was made" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    "arguments, message, code",
    [
        (["sim", "--names", "no_such_robot"], "unknown simulator(s) no_such_robot", 2),
        (["sim", "--names", "pusht", "--episodes", "0"], "episodes must be at least 1", 2),
        (["sim-table", "OUT"], "no simulator datasets", 1),
    ],
)
def test_mistakes_are_one_message(tmp_path, capsys, arguments, message, code):
    out = [] if "OUT" in arguments else ["--out", str(tmp_path)]
    arguments = [str(tmp_path) if a == "OUT" else a for a in arguments]
    assert main(["data", *arguments, *out]) == code
    assert message in " ".join(capsys.readouterr().err.split())
