"""`hma data sim`: what it writes, what it says, and what it refuses."""

from __future__ import annotations

import pytest

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
    assert (tmp_path / "overview.png").stat().st_size > 0
    found = sorted(p.name for p in (tmp_path / "pusht").iterdir())
    assert found == ["1.0.0", "contact.png", "stats.json"]

    assert main(["data", "sim-table", str(tmp_path)]) == 0
    assert "| `pusht` | gym-pusht | 2 | 10 | push script | 2 | 160 |" in capsys.readouterr().out


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
