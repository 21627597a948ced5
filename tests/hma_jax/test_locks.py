"""Locks on files: one holder, free when it dies, and leases between machines that see no lock of each other."""

from __future__ import annotations

import errno
import json
import os
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest

from hma_jax.config import ConfigError
from hma_jax.convert.atomic import atomic_directory
from hma_jax.runtime import locks
from hma_jax.runtime.locks import Held, Holder, exclusive, find_held
from hma_jax.runtime.outputs import make_directory
from hma_jax.training.run_lock import locked_run
from tests.holding import start_holder


def test_the_holder_is_named_and_its_death_frees_the_lock(tmp_path: Path):
    holder = start_holder(exclusive, tmp_path / "lock", lease=True, remove=True)
    with pytest.raises(Held, match=f"held by process {holder.pid} on ") as held, exclusive(tmp_path / "lock"):
        pass
    assert held.value.holder.process == holder.pid and isinstance(held.value, ConfigError)
    holder.kill()
    holder.join()
    with exclusive(tmp_path / "lock", lease=True, remove=True) as lock:  # at once: this machine knows that it died
        assert lock.holder.process == os.getpid() and not lock.lost()
    assert not list(tmp_path.iterdir())


def test_threads_exclude_each_other_too(tmp_path: Path):
    inside, most = [], []

    def work(_: int) -> None:
        while True:
            try:
                with exclusive(tmp_path / "lock", lease=True, remove=True):
                    inside.append(1)
                    most.append(len(inside))
                    time.sleep(0.001)
                    inside.pop()
                return
            except Held:
                time.sleep(0.0005)

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(64)))
    assert most == [1] * 64 and not list(tmp_path.iterdir())


def leave(path: Path, age: float, **facts) -> None:
    """The file of a holder whose lock the file system does not show here."""
    holder = {"process": 7, "host": "other", "since": "then", "machine": "other", "token": "x", "locked": True}
    path.write_text(json.dumps(holder | facts))
    now = path.stat().st_mtime
    os.utime(path, (now - age, now - age))


def test_a_lease_of_another_machine_holds_until_it_expires(tmp_path: Path):
    path = tmp_path / "lock"
    leave(path, age=locks.EXPIRES - 5)
    with pytest.raises(Held, match="process 7 on other"), exclusive(path, lease=True):
        pass
    with exclusive(path):  # no lease asked for: only the lock counts
        pass
    leave(path, age=locks.EXPIRES + 5)
    with exclusive(path, lease=True) as lock:
        assert not lock.lost()
    assert [p.name for p in tmp_path.iterdir()] == ["lock"]


@pytest.mark.parametrize("code", [errno.EACCES, errno.EROFS])
def test_whether_a_lease_is_held_is_seen_without_writing_and_of_another_user_s_where_it_can_be(
    tmp_path: Path, monkeypatch, code: int
):
    path = tmp_path / "lock"
    leave(path, age=locks.EXPIRES + 5)
    before = path.read_text(), path.stat().st_mtime
    assert find_held(path) is None and (path.read_text(), path.stat().st_mtime) == before
    leave(path, age=0)
    assert "process 7 on other" in str(find_held(path))

    def refuse(*arguments, **options):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(Path, "touch", refuse)
    assert "process 7 on other" in str(find_held(path))  # by this host's clock
    leave(path, age=locks.EXPIRES + 5)
    assert find_held(path) is None
    with exclusive(path):
        assert find_held(path).holder.process == os.getpid()
    with monkeypatch.context() as patch, pytest.raises(OSError, match=os.strerror(code)):
        patch.setattr(locks.os, "open", refuse)
        find_held(path)


def test_a_lock_that_is_handed_over_while_it_is_looked_at_is_held(tmp_path: Path, monkeypatch):
    path, flock = tmp_path / "lock", locks.fcntl.flock
    path.touch()

    def handed_over(fd: int, kind: int) -> None:
        """The holder ends and removes its file, and the next makes one."""
        monkeypatch.setattr(locks.fcntl, "flock", flock)
        path.unlink()
        stack.enter_context(exclusive(path, lease=True))
        flock(fd, kind)

    with ExitStack() as stack:
        monkeypatch.setattr(locks.fcntl, "flock", handed_over)
        assert find_held(path).holder.process == os.getpid()


def test_a_lease_from_a_clock_that_was_ahead_is_over_as_well(tmp_path: Path):
    """Of a machine that died before its clock was set right, or this one: it would be held for as long as it was
    ahead."""
    path = tmp_path / "lock"
    leave(path, age=-locks.EXPIRES + 5)
    with pytest.raises(Held, match="process 7 on other"), exclusive(path, lease=True):
        pass
    leave(path, age=-locks.EXPIRES - 5)
    with exclusive(path, lease=True):
        pass


def test_a_lock_of_this_machine_needs_no_expiry(tmp_path: Path):
    leave(tmp_path / "lock", age=0, machine=locks.machine())
    with exclusive(tmp_path / "lock", lease=True):
        pass


def test_where_no_lock_is_taken_a_lease_still_excludes(tmp_path: Path, monkeypatch, caplog):
    def refuse(fd, operation):
        raise OSError(95, "not supported")

    monkeypatch.setattr(locks.fcntl, "flock", refuse)
    path = tmp_path / "lock"
    with exclusive(path, lease=True), pytest.raises(Held), exclusive(path, lease=True):
        pass
    assert not caplog.records
    with exclusive(path):
        assert "supports no locks" in caplog.text


def unreadable(monkeypatch: pytest.MonkeyPatch, path: Path) -> None:
    """As on a shared disk that does not answer for a while."""
    read = Path.read_text

    def fail(self: Path, *arguments, **options) -> str:
        if self == path:
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))
        return read(self, *arguments, **options)

    monkeypatch.setattr(Path, "read_text", fail)


@pytest.mark.parametrize("ask", [lambda path: locked_run(path.parent).__enter__(), find_held])
def test_a_disk_that_fails_when_it_is_asked_for_a_lock_is_none_that_takes_no_locks(ask, tmp_path: Path, monkeypatch):
    """Otherwise a second process would train in the run of the first."""

    def fail(fd: int, kind: int) -> None:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))

    path = tmp_path / ".lock"
    with locked_run(tmp_path) as lock:
        monkeypatch.setattr(locks.fcntl, "flock", fail)
        with pytest.raises(OSError, match=os.strerror(errno.ESTALE)) as error:
            ask(path)
        assert error.value.filename == str(path) and not lock.lost()


def test_a_lock_is_lost_when_it_is_gone_or_another_s_not_when_its_disk_does_not_answer(tmp_path: Path, monkeypatch):
    path = tmp_path / "run" / "lock"
    path.parent.mkdir()
    with exclusive(path, lease=True, remove=True) as lock:
        with monkeypatch.context() as patch:
            unreadable(patch, path)
            assert not lock.lost()
        leave(path, age=0)
        assert lock.lost()
        path.unlink()
        assert lock.lost()
        path.parent.rmdir()
        path.parent.write_text("no directory")
        assert lock.lost()


def test_a_lease_that_cannot_be_read_is_not_taken_for_free(tmp_path: Path, monkeypatch):
    leave(tmp_path / "lock", age=0)
    unreadable(monkeypatch, tmp_path / "lock")
    with pytest.raises(OSError, match=os.strerror(errno.ESTALE)), exclusive(tmp_path / "lock", lease=True):
        pass


def test_a_lock_without_a_lease_is_had_whoever_held_it(tmp_path: Path, monkeypatch):
    unreadable(monkeypatch, tmp_path / "lock")
    with exclusive(tmp_path / "lock"):
        pass


def make(directory: Path) -> None:
    with atomic_directory(directory):
        pass


def lock(directory: Path) -> None:
    with locked_run(directory):
        pass


@pytest.mark.parametrize("write", [make_directory, make, lock])
def test_a_disk_that_does_not_answer_is_no_wrong_choice_of_a_directory(write, tmp_path: Path, monkeypatch):
    """Refused as one, the trial would not be tried again."""

    def fail(self: Path, *arguments, **options):
        raise OSError(code, os.strerror(code), str(self))

    monkeypatch.setattr(Path, "mkdir", fail)
    code = errno.EACCES
    with pytest.raises(ConfigError, match="choose another"):
        write(tmp_path / "out" / "run")
    code = errno.ESTALE
    with pytest.raises(OSError, match=os.strerror(errno.ESTALE)):
        write(tmp_path / "out" / "run")


def test_a_lease_is_renewed_while_it_is_held_and_given_back_at_the_end(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(locks, "RENEWED_EVERY", 0.01)
    path = tmp_path / "lock"
    with exclusive(path, lease=True):
        os.utime(path, (0, 0))
        until = time.monotonic() + 10
        while path.stat().st_mtime == 0:
            assert time.monotonic() < until
            time.sleep(0.005)
    assert path.read_text() == ""


def test_who_loses_a_lease_finds_out_and_takes_nothing_from_the_next(tmp_path: Path):
    path = tmp_path / "lock"
    with exclusive(path, lease=True, remove=True) as lock:
        assert not lock.lost()
        path.unlink()
        leave(path, age=0)
        assert lock.lost()
    assert Holder(**json.loads(path.read_text())).host == "other"
