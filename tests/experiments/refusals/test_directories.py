"""Directories that cannot be written or hold nothing of use; what a process of its own says."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys

import pytest

from data_pipelines.sources.rlds.schema import DATASETS
from experiments.cli.data import registry as registry_commands
from experiments.cli.main import main
from experiments.preparing import windows
from hma_jax.training.hashes import write_list
from tests.experiments.idle import SMOKE

WRITERS = ("study", "sweep width", "data suite", "tokenizer train", "tokenize", "train")


@pytest.mark.parametrize("command", WRITERS)
def test_output_directory_that_cannot_be_made(command, tmp_path, refused):
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "out"
    message = refused(2, *command.split(), *SMOKE, "--out", out)
    assert f"cannot write to {out}" in message and "choose another --out" in message


def test_run_directory_that_cannot_be_made(study, tmp_path, refused):
    out, data = study
    (tmp_path / "file").write_text("")
    message = refused(2, "train", *SMOKE, "--out", out, *data, "--run", tmp_path / "file" / "run")
    assert str(tmp_path / "file" / "run") in message and "choose another output directory" in message


@pytest.mark.parametrize(
    "arguments", [["tokenize", "--out", "gs://bucket/out"], ["train", "--run", "s3://bucket/run"]], ids=["out", "run"]
)
def test_what_would_be_written_to_a_bucket_is_refused(arguments, refused, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    message = refused(2, *arguments, *SMOKE)
    assert "results cannot be written to a bucket, only to a directory of a file system" in message and not list(
        tmp_path.iterdir()
    )


def test_processes_that_do_not_know_each_other_are_refused(refused):
    message = refused(2, "train", *SMOKE, "--processes", "2")
    assert "--coordinator HOST:PORT, --processes N and --process I" in message


def test_disk_that_fills_up_later(study, tmp_path, refused, monkeypatch):
    def full(path, text):
        raise OSError(28, "No space left on device", str(path))

    out, data = study
    monkeypatch.setattr(windows, "write_file", full)
    message = refused(1, "tokenize", *SMOKE, "--out", out, *data)
    assert f"{out / 'data.json'}: No space left on device" in message and "the space on its disk" in message


@pytest.mark.parametrize("name", ["tokens", "tokenizer", "eval_manifest.json"])
def test_evaluation_without_what_was_prepared(name, study, tmp_path, refused):
    out, data = study
    other = tmp_path / "out"
    shutil.copytree(out, other)
    shutil.rmtree(other / name) if (other / name).is_dir() else (other / name).unlink()
    message = refused(2, "evaluate", out / "model", *SMOKE, "--out", other, *data)
    assert f"{other / name}: not made yet; run `hma tokenize --preset smoke --out {other} --data {data[1]}" in message


def test_report_of_an_empty_directory(tmp_path, refused):
    message = refused(2, "report", tmp_path)
    assert f"no study in {tmp_path}" in message and "hma study" in message


# --- The program -----------------------------------------------------------------------------


def hma(*arguments: object) -> tuple[int, str]:
    """Exit code and standard error of a real process."""
    command = [sys.executable, "-m", "experiments.cli", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    return done.returncode, done.stderr


def test_the_process_says_the_same(tmp_path):
    code, said = hma("tokenize", *SMOKE, "--out", tmp_path / "out", "--data", tmp_path / "none")
    assert code == 2
    assert said == f"error: {tmp_path / 'none'}: no such directory. Give {DATASETS}.\n"


def test_background_readers_of_a_damaged_checkpoint_stay_silent(study, tmp_path):
    """They complain from threads and destructors, in pages, until the process ends."""
    out, data = study
    run = shutil.copytree(out / "model", tmp_path / "run")
    for file in (run / "checkpoints" / "3").rglob("array_metadatas/process_0"):
        file.write_bytes(file.read_bytes()[:-30])
    write_list(run / "checkpoints" / "3")  # Orbax meets the damage
    code, said = hma("train", *SMOKE, "--out", out, *data, "--run", run)
    assert code == 2 and said.startswith("error: the checkpoint") and len(said.splitlines()) == 1


def test_a_bug_is_not_dressed_up_as_a_mistake_of_the_user(monkeypatch):
    def broken(*_):
        raise KeyError("oops")

    monkeypatch.setattr(registry_commands, "use_entries", broken)
    with pytest.raises(KeyError, match="oops"):
        main(["data", "list"])


def test_a_path_that_is_not_utf8_is_refused_at_the_start(tmp_path, monkeypatch, capsys):
    """Its suite was simulated first, and then there was a traceback."""
    latin = tmp_path / os.fsdecode(b"caf\xe9")
    latin.mkdir()
    assert main(["study", *SMOKE, "--out", str(latin)]) == 2
    assert "caf\\xe9 is not UTF-8" in capsys.readouterr().err and not any(latin.iterdir())
    monkeypatch.chdir(latin)
    assert main(["study", *SMOKE, "--out", "out"]) == 2
    assert "caf\\xe9 is not UTF-8" in capsys.readouterr().err and not any(latin.iterdir())
