"""`hma convert`, from an official checkpoint through every format and back."""

import json
from pathlib import Path

from experiments.cli.main import main

CHECKPOINT = Path(__file__).parent.parent / "golden" / "04_discrete_mlp"


def test_a_checkpoint_goes_through_every_format_and_back(tmp_path, capsys):
    def convert(command: str, start: Path, out: str, *options: str) -> Path:
        assert main(["convert", command, str(start), "--out", str(tmp_path / out), *options]) == 0
        said = capsys.readouterr().out.replace("\n", "")
        assert f"wrote {tmp_path / out}" in said and "next: " in said and "robots: arm7, push2" in said
        return tmp_path / out

    run = convert("from-official", CHECKPOINT, "run")
    neutral = convert("to-safetensors", run, "neutral")
    again = convert("from-safetensors", neutral, "again")
    back = convert("to-official", again, "back")
    assert (back / "model.safetensors").read_bytes() == (CHECKPOINT / "model.safetensors").read_bytes()
    before, after = (json.loads((folder / "config.json").read_text()) for folder in (CHECKPOINT, back))
    assert before == after

    options = ("--prompt", "1", "--frames", "2", "--platforms", "cpu")
    program = convert("to-stablehlo", again, "program", *options)
    about = json.loads((program / "model.json").read_text())
    assert about["outputs"][0]["shape"] == [1, 1, 16]
    assert {path.name for path in program.iterdir()} == {"model.json", "model.safetensors", "model.stablehlo"}
