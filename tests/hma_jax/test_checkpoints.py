"""Checkpoints on disk: items, hashes, damage, and going on from the one before."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.training import checkpoints as module
from hma_jax.training import hashes, reading
from hma_jax.training.checkpoints import CheckpointError, Checkpoints, SaveError
from hma_jax.training.hashes import NAME, Damaged, ReadError, verify, write_list
from hma_jax.training.loop import LoopOptions
from hma_jax.training.reading import find_damage, list_steps, load_items
from hma_jax.training.state import TrainState
from tests.toy import fit_toy, toy_shapes, toy_state

EVERY_TWO = LoopOptions(checkpoint_every=2, log_every=1)
SKIP = LoopOptions(checkpoint_every=2, log_every=1, skip_damaged=True)


def flip(path: Path, at: int | None = None) -> None:
    """One bit, in the middle unless told otherwise."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2 if at is None else at] ^= 4
    path.write_bytes(content)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of 6 steps with checkpoints at 4 and 6."""
    run_dir = tmp_path_factory.mktemp("run")
    fit_toy(run_dir, 6, options=LoopOptions(checkpoint_every=4, log_every=1))
    return run_dir


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TrainState]:
    """(a run of 9 steps that nothing happened to, its last state)."""
    run_dir = tmp_path_factory.mktemp("whole")
    return run_dir, fit_toy(run_dir, 9, options=LoopOptions(log_every=1)).state


@pytest.fixture
def run_dir(trained: Path, tmp_path: Path) -> Path:
    return shutil.copytree(trained, tmp_path / "run")


def files_of(checkpoint: Path) -> list[str]:
    return sorted(p.relative_to(checkpoint).as_posix() for p in checkpoint.rglob("*") if p.is_file())


# --- Damage ----------------------------------------------------------------------------------


def test_several_processes_read_every_file_once(run_dir: Path, monkeypatch):
    checkpoint, read = run_dir / "checkpoints" / "6", []
    monkeypatch.setattr(hashes, "_compare", lambda path, *_: read.append(path))
    for share in range(3):
        before = len(read)
        verify(checkpoint, share=(share, 3))
        assert len(read) > before
    assert sorted(p.relative_to(checkpoint).as_posix() for p in read) == [n for n in files_of(checkpoint) if n != NAME]


def test_one_flipped_bit_in_any_file_is_refused_by_its_name(run_dir: Path):
    checkpoint = run_dir / "checkpoints" / "6"
    names = files_of(checkpoint)
    assert {name.split("/")[0] for name in names} > {"params", "opt_state", "step", "_CHECKPOINT_METADATA", NAME}
    for name in names:
        good = (checkpoint / name).read_bytes()
        if not good:
            continue
        flip(checkpoint / name)
        with pytest.raises(CheckpointError) as refused:
            fit_toy(run_dir, 8, options=EVERY_TWO)
        message = str(refused.value)
        assert str(checkpoint) in message and name in message, name
        assert "step 4 is undamaged" in message and "--skip-damaged" in message
        (checkpoint / name).write_bytes(good)
    assert list_steps(run_dir / "checkpoints") == [4, 6]
    assert fit_toy(run_dir, 8, options=EVERY_TWO).resumed_from == 6


def test_a_file_that_is_missing_or_cut_is_refused_too(run_dir: Path):
    checkpoint = run_dir / "checkpoints" / "6"
    metadata = checkpoint / "params" / "_METADATA"
    metadata.write_bytes(metadata.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="params/_METADATA has .* bytes, .* were written"):
        fit_toy(run_dir, 8)
    metadata.unlink()
    with pytest.raises(CheckpointError, match="params/_METADATA cannot be read"):
        fit_toy(run_dir, 8)


@pytest.mark.parametrize("name", ["params/_METADATA", NAME])
def test_a_file_that_cannot_be_read_now_is_not_taken_for_damaged(name: str, run_dir: Path, monkeypatch):
    """A shared disk that does not answer, or too many open files."""
    path, real = run_dir / "checkpoints" / "6" / name, open

    def fail(file, *arguments, **options):
        if Path(file) == path:
            raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), str(path))
        return real(file, *arguments, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", fail)
        patch.setattr(Path, "read_text", lambda self, *_: fail(self).read())
        with pytest.raises(ReadError, match=f"{path} cannot be read now .Too many open files.*same command again"):
            fit_toy(run_dir, 8, options=SKIP)
    assert list_steps(run_dir / "checkpoints") == [4, 6] and not (run_dir / "damaged").exists()
    assert fit_toy(run_dir, 8, options=SKIP).resumed_from == 6


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (OSError(errno.ESTALE, os.strerror(errno.ESTALE)), ReadError),
        (ValueError("NOT_FOUND: [os_error_code='24' source locations='..']"), ReadError),
        (FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT)), CheckpointError),
        (ValueError("DATA_LOSS: not a zarr"), CheckpointError),
    ],
)
def test_what_the_system_says_when_arrays_are_read_is_not_taken_for_damage_either(error, kind, run_dir, monkeypatch):
    def fail(*_):
        raise error

    monkeypatch.setattr(reading.ocp, "load_checkpointables", fail)
    with pytest.raises((ReadError, CheckpointError), match=str(run_dir / "checkpoints" / "6")) as refused:
        fit_toy(run_dir, 8)
    assert refused.type is kind


@pytest.mark.parametrize("which", ["verify", "list_steps"])
def test_the_damage_is_told_where_the_checkpoint_before_it_cannot_be_read_now(which: str, run_dir: Path, monkeypatch):
    """Not that there is no whole one: nobody knows."""
    checkpoints, real = run_dir / "checkpoints", getattr(reading, which)

    def fail(path: Path, *arguments):
        if path in (checkpoints, checkpoints / "4"):
            raise ReadError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))
        return real(path, *arguments)

    monkeypatch.setattr(reading, which, fail)
    flip(checkpoints / "6" / "params" / "_METADATA")
    with pytest.raises(CheckpointError, match="6 is damaged: params/_METADATA .*those before it cannot be read now"):
        load_items(checkpoints / "6", {"params": toy_shapes().params})


@pytest.mark.parametrize("kind", [CheckpointError, ReadError])
def test_what_one_of_several_processes_cannot_read_ends_all_of_them_alike(kind, monkeypatch):
    told: list[str] = []

    def all_gather(name: str, own: str) -> list[str]:
        told.append(own)
        return [told[0], own]

    monkeypatch.setattr(reading, "all_gather", all_gather)
    for own in ([kind("the first file")], [], [CheckpointError("another")], [ReadError("another")]):
        with pytest.raises((CheckpointError, ReadError)) as raised, reading.raised_in_all("name"):
            for error in own:
                raise error
        assert (raised.type, str(raised.value)) == (kind, "the first file")


@pytest.mark.parametrize("item", ["params", "opt_state", "_CHECKPOINT_METADATA"])
def test_a_run_goes_on_from_before_the_damage_when_told_to_and_ends_as_if_nothing_had_been(
    item: str, run_dir: Path, whole: tuple[Path, TrainState]
):
    checkpoint = run_dir / "checkpoints" / "6"
    flip(next(checkpoint / name for name in reversed(files_of(checkpoint)) if name.startswith(item)))
    resumed = fit_toy(run_dir, 9, options=SKIP)
    assert resumed.resumed_from == 4
    assert list_steps(run_dir / "damaged") == [6] and find_damage(run_dir / "damaged" / "6") is not None
    # The damaged one is not counted among those that are kept, and not taken for the latest.
    assert list_steps(run_dir / "checkpoints") == [8, 9]
    same = [(d / "metrics.jsonl").read_bytes() for d in (run_dir, whole[0])]
    assert same[0] == same[1]
    for a, b in zip(jax.tree.leaves(resumed.state), jax.tree.leaves(whole[1]), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()


def test_a_run_without_a_whole_checkpoint_is_not_started_again_in_silence(run_dir: Path):
    for step in ("4", "6"):
        flip(run_dir / "checkpoints" / step / "step" / "_METADATA")
    with pytest.raises(CheckpointError, match="no undamaged checkpoint before it: train again in a new output"):
        fit_toy(run_dir, 8)
    with pytest.raises(CheckpointError, match="all checkpoints in .* are damaged"):
        fit_toy(run_dir, 8, options=SKIP)
    assert list_steps(run_dir / "checkpoints") == [4, 6]


def test_a_checkpoint_whose_list_is_missing_counts_as_damaged(run_dir: Path):
    """Orbax reads a flipped bit of it without an error."""
    checkpoint = run_dir / "checkpoints" / "6"
    (checkpoint / NAME).unlink()
    flip(max((checkpoint / "params").rglob("*"), key=lambda path: path.stat().st_size * path.is_file()))
    with pytest.raises(CheckpointError, match=f"{NAME} is missing, .*; that of step 4 is undamaged: .*--skip-damaged"):
        fit_toy(run_dir, 8)
    assert fit_toy(run_dir, 8, options=SKIP).resumed_from == 4
    assert list_steps(run_dir / "damaged") == [6] and list_steps(run_dir / "checkpoints") == [6, 8]


def test_the_list_is_whole_or_absent(tmp_path: Path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "b").write_bytes(b"12")
    with pytest.raises(Damaged, match=f"{NAME}: is missing"):
        verify(tmp_path)
    write_list(tmp_path)
    verify(tmp_path)
    assert files_of(tmp_path) == ["a/b", NAME]
    listed = (tmp_path / NAME).read_bytes()
    for at in range(len(listed)):
        flip(tmp_path / NAME, at)
        with pytest.raises(Damaged, match=NAME):
            verify(tmp_path)
        (tmp_path / NAME).write_bytes(listed)


# --- Items -----------------------------------------------------------------------------------


def test_parameters_are_read_without_the_moments(run_dir: Path):
    checkpoint = run_dir / "checkpoints" / "6"
    shutil.rmtree(checkpoint / "opt_state")
    shapes = toy_shapes()
    params = load_items(checkpoint, {"params": shapes.params})["params"]
    assert np.isfinite(np.asarray(params["w"])).all()
    with pytest.raises(CheckpointError, match="opt_state/"):
        load_items(checkpoint, {"opt_state": shapes.opt_state})


# --- Failing saves ---------------------------------------------------------------------------


def test_a_checkpoint_is_on_disk_before_it_is_listed_and_listed_before_it_has_its_name(tmp_path: Path, monkeypatch):
    """Orbax flushes its arrays alone; after a loss of power its other files would be empty, or the checkpoint gone."""
    synced, missing, fsync, replace = set(), [], os.fsync, os.replace

    def record(fd: int) -> None:
        synced.add(os.fstat(fd).st_ino)
        fsync(fd)

    def check(old: Path, new: Path) -> None:
        if Path(new) == tmp_path / "1":
            missing.append([path.name for path in (old, *old.rglob("*")) if path.stat().st_ino not in synced])
            verify(old)
            synced.clear()
        replace(old, new)

    monkeypatch.setattr(os, "fsync", record)
    monkeypatch.setattr(os, "replace", check)
    with Checkpoints(tmp_path, {"toy": 1}) as checkpoints:
        checkpoints.save(1, toy_state())
    assert missing == [[]] and synced == {tmp_path.stat().st_ino}


def test_a_save_that_fails_in_the_background_is_one_message_and_keeps_the_last(tmp_path: Path, monkeypatch):
    with pytest.raises(SaveError, match="step 2 could not be written .*: No space left on device") as refused:
        with Checkpoints(tmp_path, {"toy": 1}, keep=1) as checkpoints:
            checkpoints.save(1, toy_state())
            checkpoints.wait()
            fail(monkeypatch, errno.ENOSPC, 1)
            checkpoints.save(2, toy_state())
            while checkpoints._pending is not None:
                checkpoints.raise_failure()  # noticed while training goes on, not at the next save only
    assert "run the same command again: it continues from step 1, the last complete" in str(refused.value)
    assert list_steps(tmp_path) == [1] and not refused.value.passing


def fail(monkeypatch: pytest.MonkeyPatch, code: int, times: int) -> list[Path]:
    """The next so many checkpoints cannot be flushed to disk; returns those that are tried."""
    real, tried = module.sync_tree, []

    def sync_tree(checkpoint: Path) -> None:
        tried.append(checkpoint)
        if len(tried) <= times:
            raise OSError(code, os.strerror(code))
        real(checkpoint)

    monkeypatch.setattr(module, "sync_tree", sync_tree)
    monkeypatch.setattr(module, "LONGEST_PAUSE", 0.0)
    monkeypatch.setattr(module, "TRIES", 4)
    return tried


def test_a_disk_that_does_not_answer_once_costs_one_save_and_not_the_run(tmp_path: Path, monkeypatch, caplog):
    tried = fail(monkeypatch, errno.ESTALE, 1)

    def wait(step: int, *_: object) -> None:
        if step == 5:  # that is told while step 6 is computed
            while not tried:
                time.sleep(0.01)
            time.sleep(0.2)

    with caplog.at_level(logging.WARNING):
        fit_toy(tmp_path, 9, options=LoopOptions(checkpoint_every=4, log_every=1, keep_checkpoints=9), progress=wait)
    assert "the checkpoint of step 4 could not be written" in caplog.text and "Stale file handle" in caplog.text
    assert list_steps(tmp_path / "checkpoints") == [6, 8, 9] and len(tried) == 4
    assert not any(find_damage(tmp_path / "checkpoints" / str(step)) for step in (6, 8, 9))
    assert sorted(p.name for p in (tmp_path / "checkpoints").iterdir()) == ["6", "8", "9"]


def test_the_last_save_is_repeated_until_the_disk_answers_and_given_up_in_the_end(tmp_path: Path, monkeypatch):
    fail(monkeypatch, errno.EIO, 3)
    fit_toy(tmp_path / "answers", 2)
    assert list_steps(tmp_path / "answers" / "checkpoints") == [2]
    tried = fail(monkeypatch, errno.EIO, 100)
    with pytest.raises(SaveError, match="step 2 could not be written .*it starts from step 0") as given_up:
        fit_toy(tmp_path / "does not", 2)
    assert given_up.value.passing and len(tried) == module.TRIES
    with pytest.raises(SaveError, match="step 2"), Checkpoints(tmp_path / "no loop", {"toy": 1}) as checkpoints:
        checkpoints.save(2, toy_state())  # whoever does not repeat it is told


def test_a_disk_that_does_not_even_list_its_checkpoints_costs_one_save_too(tmp_path: Path, monkeypatch, caplog):
    fail(monkeypatch, errno.EIO, 1)
    asked, real = [], module.list_steps

    def list_steps(directory: Path) -> list[int]:
        asked.append(directory)
        if len(asked) == 1:
            raise OSError(errno.EIO, os.strerror(errno.EIO), str(directory))
        return real(directory)

    monkeypatch.setattr(module, "list_steps", list_steps)
    fit_toy(tmp_path, 2)
    assert "step 2 could not be written" in caplog.text and real(tmp_path / "checkpoints") == [2]


def test_a_save_removes_what_saves_left_behind_and_nothing_else(run_dir: Path):
    checkpoints = run_dir / "checkpoints"
    left = ("5.unfinished", "5.unfinished.orbax-checkpoint-tmp-1", "2.removed", "3.orbax-checkpoint-tmp-1")
    for name in (*left, "2.before-the-spike"):
        (checkpoints / name).mkdir()
    fit_toy(run_dir, 8, options=EVERY_TWO)
    assert sorted(p.name for p in checkpoints.iterdir()) == ["2.before-the-spike", "6", "8"]


def test_a_path_that_orbax_takes_for_a_pattern_is_refused(tmp_path: Path):
    """Runs in such directories ended well, and no checkpoint of theirs could be read."""
    with pytest.raises(ConfigError, match=r"a path with \[2\] cannot hold checkpoints.*choose another"):
        fit_toy(tmp_path / "a [2]" / "run", 2)
    assert not (tmp_path / "a [2]" / "run" / "checkpoints").exists()
    fit_toy(tmp_path / "what? a[*b" / "run", 2)
    assert fit_toy(tmp_path / "what? a[*b" / "run", 3).resumed_from == 2


def test_what_one_of_several_processes_cannot_write_is_the_error_of_all(monkeypatch):
    monkeypatch.setattr(module, "all_gather", lambda name, own: [own, '{"failed": 116, "reason": "Stale file handle"}'])
    with pytest.raises(OSError, match="Stale file handle") as raised:
        module._in_all("hashes", list)
    assert raised.value.errno == errno.ESTALE
