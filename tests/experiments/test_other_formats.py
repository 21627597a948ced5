"""A LeRobot folder and a robomimic file, from inspection to a token store, without an RLDS directory between."""

from __future__ import annotations

import json

import pytest

from experiments.cli.main import main
from tests.data_pipelines.convert.sources import write_lerobot, write_robomimic
from tests.experiments.idle import idle_training  # noqa: F401

pytest.importorskip("av")


def test_lerobot_and_robomimic_go_from_inspection_and_view_to_tokens(tmp_path, capsys):
    data = [
        str(write_lerobot(tmp_path / "toy-arm", "v3.0", lengths=(24,) * 5)),
        str(write_robomimic(tmp_path / "image.hdf5", lengths=(23, 24, 22, 24))),
    ]
    entries = tmp_path / "my.toml"
    for place in data:
        sheets = ["--out", str(tmp_path / "sheets")]
        assert main(["data", "inspect", place, "--entry", str(entries), "--frames", "2", *sheets]) == 0
        assert "Hz: stride" in capsys.readouterr().out  # the files say the rate
    assert main(["data", "view", *data, "--frames", "2", "--out", str(tmp_path / "first.html")]) == 0
    said = capsys.readouterr().out
    assert "rate unknown" not in said and "another rate" not in said
    # These recordings are short, and frames of one colour look blank, as real ones would not.
    text = entries.read_text().replace("video_targets = false\n", "")
    entries.write_text(text.replace("hz = 20.0", "hz = 4.0"))
    page = tmp_path / "page.html"
    assert main(["data", "view", *data, "--registry", str(entries), "--out", str(page)]) == 0 and page.is_file()
    assert "robomimic_lift: another rate: its files say 20 Hz, but 4 Hz are used" in capsys.readouterr().out
    assert main(["data", "inspect", data[1], "--registry", str(entries), *sheets]) == 0
    assert "rate 4 Hz (registry), although its files say 20: stride 2" in capsys.readouterr().out
    common = ["--preset", "smoke", "--out", str(tmp_path / "out"), "--registry", str(entries), "--data", *data]
    assert main(["tokenize", *common, "--set", "model.frames=4"]) == 0
    size, *notes = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert size.startswith("note: preset smoke trains a model of") and notes == [
        "note: robomimic_lift: its files say 20 Hz, but its registry entry 4 Hz, which is used; if the files are right, correct the "
        "entry"
    ]
    for name, keys in (("toy_arm", "observation/top"), ("robomimic_lift", "observation/agentview")):
        manifest = json.loads((tmp_path / "out" / "tokens" / name / "manifest.json").read_text())
        assert manifest["spec"]["image_key"] == keys and manifest["runs"]
    assert not list(tmp_path.rglob("*.tfrecord*"))
