"""`hma tokenize` in several processes, and on data in a remote store."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from experiments.cli.main import main
from experiments.preparing import sources
from experiments.progress import Pace
from experiments.setting import Where, make_setting
from tests.data_pipelines.fakes import write_rlds
from tests.data_pipelines.tokens.job_process import contents
from tests.experiments.test_cli_errors import ARM, BASE, LENGTHS, SMOKE, idle_training  # noqa: F401


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("rlds")
    return ["--data", *(str(write_rlds(root, spec, LENGTHS)) for spec in (ARM, BASE))]


def test_shares_make_the_store_and_the_last_one_finishes_it(data, tmp_path, capsys):
    out = ["--out", str(tmp_path / "out"), *data]
    shares = [["tokenize", *SMOKE, *out, "--process", str(i), "--processes", "2"] for i in (0, 1)]
    assert main(shares[0]) == 2
    message = capsys.readouterr().err
    assert "no tokenizer" in message
    assert f"hma tokenizer train --preset smoke --out {tmp_path / 'out'} --data {data[1]} {data[2]}" in message
    assert main(["tokenizer", "train", *SMOKE, *out]) == 0
    said = []
    for share in shares:
        assert main(share) == 0
        said.append(capsys.readouterr().out)
    assert "will be complete when the others are" in said[0] and "eval_manifest.json" in said[1]
    assert f"{ARM.name}" in said[1] and "held out" in said[1]
    whole = ["--out", str(tmp_path / "whole"), *data, "--tokenizer", str(tmp_path / "out" / "tokenizer")]
    assert main(["tokenize", *SMOKE, *whole, "--batch", "3", "--threads", "1"]) == 0
    assert contents(tmp_path / "whole" / "tokens") == contents(tmp_path / "out" / "tokens")


def test_two_ways_of_saying_the_share_are_explained(data, tmp_path, capsys):
    arguments = ["tokenize", *SMOKE, "--out", str(tmp_path), *data]
    assert main([*arguments, "--process", "1"]) == 2
    assert "--process and --processes are given together" in capsys.readouterr().err


def test_remote_data_is_neither_mangled_nor_copied(data, tmp_path, capsys):
    UPath = pytest.importorskip("upath").UPath
    root = UPath("memory://bucket") / ARM.name
    try:
        for path in Path(data[1]).iterdir():
            copy = root / "1.0.0" / path.name
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
        setting = make_setting(Where("smoke", tmp_path, (str(root),)))
        assert setting.data == (f"memory://bucket/{ARM.name}",)
        ((spec, directory),) = sources.find_sources(setting.study, setting.data)
        assert spec == ARM and directory == root
        assert main(["tokenize", *SMOKE, "--out", str(tmp_path / "out"), "--data", str(root)]) == 0
        assert f"--data memory://bucket/{ARM.name}" in capsys.readouterr().out.replace("\n", " ")
        assert json.loads((tmp_path / "out/data.json").read_text())[ARM.name]["episodes"] == 5
    finally:
        root.fs.rm("/bucket", recursive=True)


def test_store_of_an_older_format_is_made_again_when_asked_for(data, tmp_path, capsys):
    arguments = ["tokenize", *SMOKE, "--out", str(tmp_path), *data[:2]]
    assert main(arguments) == 0
    before = contents(tmp_path / "tokens")
    manifest = tmp_path / "tokens" / ARM.name / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"format": 1}))
    capsys.readouterr()
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "manifest format 1; this reads 2" in said and "--replace tokens" in said
    assert main([*arguments, "--replace", "tokens"]) == 0
    assert contents(tmp_path / "tokens") == before


def test_processes_that_share_the_work_replace_nothing(data, tmp_path, capsys):
    arguments = ["tokenize", *SMOKE, "--out", str(tmp_path), *data[:2]]
    assert main(arguments) == 0
    shared = [*arguments, "--process", "0", "--processes", "2", "--set", "store.frame_step=1"]
    before = contents(tmp_path / "tokens")
    assert main(shared) == 2
    assert "store.frame_step: 3 -> 1" in capsys.readouterr().err
    assert main([*shared, "--replace", "tokens"]) == 2
    assert "replace nothing" in capsys.readouterr().err
    assert contents(tmp_path / "tokens") == before


def test_time_left_does_not_count_what_was_there_before():
    now = [0.0]
    pace = Pace(lambda: now[0])
    assert pace(90, 100) == ""
    now[0] = 10.0
    assert pace(91, 100) == ", 1 min 30 s left"
    assert pace(100, 100) == ""
