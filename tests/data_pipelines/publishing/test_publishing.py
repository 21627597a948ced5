"""The scheme that tokens, conversions, the suite and the simulators share."""

from __future__ import annotations

import pytest

from data_pipelines.publishing import files
from data_pipelines.publishing.files import publish, remove
from data_pipelines.publishing.fingerprint import is_complete
from data_pipelines.publishing.journal import Journal
from data_pipelines.publishing.output_lock import find_held_lock, lock_output
from hma_jax.runtime.files import write_file
from hma_jax.runtime.locks import Held
from tests.full_disk import full_disk
from tests.holding import start_holder
from tests.written import record_writes


def test_scratch_of_the_living_is_kept_and_that_of_the_dead_removed(tmp_path):
    process = start_holder(lock_output, tmp_path / "thing")
    (scratch,) = tmp_path.glob("thing.scratch.*")
    (scratch / "half").touch()
    with pytest.raises(Held, match=f"process {process.pid}"), lock_output(tmp_path / "thing"):
        pass
    with lock_output(tmp_path / "other"):  # of something else: nobody's business
        assert (scratch / "half").exists()
    assert find_held_lock(tmp_path).holder.process == process.pid
    process.kill()
    process.join()
    assert find_held_lock(tmp_path) is None
    with lock_output(tmp_path / "thing") as lock:
        mine = lock.scratch
        assert [p for p in tmp_path.iterdir() if p.is_dir()] == [mine]
    assert not list(tmp_path.iterdir())


def test_a_directory_takes_the_place_of_another_and_leaves_nothing(tmp_path):
    (tmp_path / "1.0.0" / "old").mkdir(parents=True)
    (tmp_path / ".1.0.0.removed" / "older").mkdir(parents=True)  # of a process that died while it removed
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "new").touch()
    publish(tmp_path / "made", tmp_path / "1.0.0")
    assert [p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*")] == ["1.0.0", "1.0.0/new"]


def test_what_could_not_be_removed_is_in_nobodys_way(tmp_path, monkeypatch):
    """NFS keeps files that are open elsewhere as .nfs*, and their directory with them."""
    monkeypatch.setattr(files.shutil, "rmtree", lambda path, ignore_errors: None)
    for _ in range(2):
        (tmp_path / "1.0.0" / "open").mkdir(parents=True)
        remove(tmp_path / "1.0.0")
    assert not (tmp_path / "1.0.0").exists()
    monkeypatch.undo()
    remove(tmp_path / "1.0.0")  # whoever comes by later
    assert not list(tmp_path.iterdir())


def test_everything_is_forced_to_the_disk_before_it_is_seen(tmp_path, monkeypatch):
    (tmp_path / "made" / "inner").mkdir(parents=True)
    (tmp_path / "made" / "inner" / "file").touch()
    done = record_writes(tmp_path, monkeypatch)
    publish(tmp_path / "made", tmp_path / "final")
    assert done == ["made", "file", "inner", "rename", tmp_path.name]


def test_a_file_is_whole_or_as_it_was(tmp_path, monkeypatch):
    write_file(tmp_path / "file", "old")

    def fail(fd):
        raise OSError("no space")

    with monkeypatch.context() as full:
        full.setattr(files.os, "fsync", fail)
        with pytest.raises(OSError, match="no space"):
            write_file(tmp_path / "file", "new")
    assert [p.read_text() for p in tmp_path.iterdir()] == ["old"]
    write_file(tmp_path / "file", b"new")
    assert (tmp_path / "file").read_bytes() == b"new"
    with full_disk(10), pytest.raises(OSError, match="/file'"):
        write_file(tmp_path / "file", "longer than ten")
    assert [p.read_text() for p in tmp_path.iterdir()] == ["new"]


def test_a_line_of_a_journal_that_a_crash_cut_off_does_not_count(tmp_path):
    journal = Journal(tmp_path / "journal.jsonl")
    assert journal.read() == []
    for i in range(3):
        journal.append({"step": i})
    journal.path.write_bytes(journal.path.read_bytes()[:-4])
    torn = journal.path.read_bytes()
    with open(journal.path, "rb") as before:
        assert journal.read() == [{"step": 0}, {"step": 1}]
        assert before.read() == torn, "it was overwritten: killed in that moment, all lines would be lost"
    journal.append({"step": 5})
    assert journal.read() == [{"step": 0}, {"step": 1}, {"step": 5}]
    with full_disk(), pytest.raises(OSError, match=r"journal\.jsonl'"):
        journal.append({"step": 6})


@pytest.mark.parametrize("text", ["", "[]", '{"fingerprint": "other"}'])
def test_what_says_nothing_of_itself_is_not_complete(tmp_path, text):
    (tmp_path / "metadata.json").write_text(text)
    assert not is_complete(tmp_path, "mark")
