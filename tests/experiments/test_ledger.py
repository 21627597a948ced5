"""The ledger keeps every whole line through a torn write; a workspace has one writer at a time."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments import run_study
from experiments.cli.main import main
from experiments.running.ledger import Ledger
from experiments.running.workspace import Workspace
from hma_jax.config import ConfigError
from hma_jax.runtime.locks import EXPIRES
from tests.full_disk import full_disk


@pytest.fixture
def ledger(tmp_path):
    return Ledger(tmp_path / "ledger.jsonl", clock=lambda: 7.0)


def test_last_line_of_a_trial_is_its_state(ledger):
    ledger.append("a", "started")
    ledger.append("b", "running")
    ledger.append("a", "failed", message="no luck")
    states = ledger.states()
    assert states["a"] == {"time": 7.0, "trial": "a", "event": "failed", "message": "no luck"}
    assert states["b"]["event"] == "running"


def test_messages_name_files_as_seen_from_the_study(ledger, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path.parent)
    near = Path(tmp_path.name)  # as the user gave it
    ledger.append("a", "failed", message=f"no checkpoint in {tmp_path}/trials/b/run; remove {tmp_path}/trials/b")
    Ledger(near / "ledger.jsonl").append("b", "lost", message=f"output in {near}/trials/b, not in /else/{near}/c")
    messages = [record["message"] for record in ledger.records()]
    assert messages[0] == "no checkpoint in trials/b/run; remove trials/b"
    assert messages[1] == f"output in trials/b, not in /else/{near}/c"


def test_a_full_disk_is_said_of_the_ledger(ledger):
    with full_disk(), pytest.raises(OSError, match="ledger.jsonl"):
        ledger.append("a", "running")


@pytest.mark.parametrize("torn", ['{"trial": "b", "ev', "{", '{"time": 1, "trial": "b", "event": "failed"}'])
def test_torn_last_line_is_dropped_and_cut(ledger, torn):
    ledger.append("a", "finished")
    with open(ledger.path, "a") as file:
        file.write(torn)  # no newline: the process died here
    assert list(ledger.states()) == ["a"]
    ledger.append("c", "started")
    assert [json.loads(line)["trial"] for line in ledger.path.read_text().splitlines()] == ["a", "c"]


def test_torn_only_line(ledger):
    ledger.path.write_text('{"tri')
    assert ledger.records() == []
    ledger.append("a", "started")
    assert len(ledger.records()) == 1


@pytest.mark.parametrize("line", ["garbage", "null", "[1]", '{"event": "failed"}', '{"trial": "b", "event": null}'])
def test_damage_before_the_end_is_reported_with_its_line(ledger, line):
    ledger.path.write_text(f'{{"trial": "a", "event": "started"}}\n{line}\n{{"trial": "b", "event": "started"}}\n')
    with pytest.raises(ConfigError, match=r"ledger.jsonl, line 2: .*; delete that line to continue"):
        ledger.states()


def test_second_writer_is_refused(tmp_path):
    with Workspace(tmp_path).locked(), pytest.raises(ConfigError, match="another command is using"):
        with Workspace(tmp_path).locked():
            pass
    with Workspace(tmp_path).locked():
        pass  # free again


def test_a_writer_on_another_machine_is_refused_where_its_lock_is_not_seen(tmp_path):
    """As on Lustre with localflock; one that died is no hindrance for longer than its lease."""
    lock = tmp_path / ".lock"
    lock.write_text(json.dumps({"process": 7, "host": "other", "since": "noon", "machine": "other", "token": "x"}))
    with pytest.raises(ConfigError, match=r"process 7 on other, since noon\).*\(if its machine died .*: 5 minutes\)"):
        with Workspace(tmp_path).locked():
            pass
    ago = lock.stat().st_mtime - EXPIRES - 1
    os.utime(lock, (ago, ago))
    with Workspace(tmp_path).locked() as held:
        assert not held.lost()


@pytest.mark.parametrize(("time_of_change", "said"), [(0, "it is ours"), (None, "another command is using")])
def test_a_study_that_starts_with_its_machine_waits_for_a_lease(tmp_path, monkeypatch, capsys, time_of_change, said):
    """It was refused, for minutes after a reboot. That of a command that lives is renewed, and not waited for."""
    lock = tmp_path / ".lock"
    lock.write_text(json.dumps({"process": 7, "host": "here", "since": "noon", "machine": "boot 1", "token": "x"}))
    os.utime(lock, (lock.stat().st_mtime - 60,) * 2)
    change = time_of_change if time_of_change is None else (time_of_change,) * 2
    monkeypatch.setattr(run_study, "time", SimpleNamespace(sleep=lambda _: os.utime(lock, change)))

    def prepare(*_):
        raise ConfigError("it is ours")

    monkeypatch.setattr(run_study, "prepare_apart", prepare)
    assert main(["sweep", "width", "--preset", "smoke", "--out", str(tmp_path)]) == 2
    out, err = capsys.readouterr()
    assert "was in use by process 7 on here, since noon; waiting 5 minutes at most" in out and said in err
