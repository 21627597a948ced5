"""A store made in parts: by killed processes, by several, by two that do the same."""

from __future__ import annotations

import errno
import json
import os
import random
import shutil
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.publishing.output_lock import lock_output
from data_pipelines.tokens.beside import beside
from data_pipelines.tokens.dataset_writer import cut_parts
from data_pipelines.tokens.moments import MOMENTS, Moments, merge_all, read_moments
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import write_rlds
from tests.data_pipelines.tokens.job_process import SPEC, run, start
from tests.files import contents

LENGTHS = [8 + i % 5 for i in range(24)]


@pytest.fixture(scope="module")
def rlds(tmp_path_factory):
    return write_rlds(tmp_path_factory.mktemp("rlds"), SPEC, LENGTHS, shards=3)


@pytest.fixture(scope="module")
def undisturbed(rlds, tmp_path_factory):
    root = tmp_path_factory.mktemp("store")
    run(rlds, root)
    return contents(root)


def work_directory(store: Path) -> Path:
    (work,) = [p for p in store.iterdir() if p.name.startswith(".toy.") and not p.name.endswith(".claims")]
    return work


def kept_parts(store: Path) -> list[Path]:
    return list(store.glob(".toy.*/parts/*.json"))


# --- restarts ----------------------------------------------------------------------------------


def test_killed_again_and_again_it_ends_with_the_same_bytes(rlds, undisturbed, tmp_path):
    assert len([name for name in undisturbed if "parts/" in name]) >= 10
    draw, kept = random.Random(0), [0]
    while len(kept) <= 5:
        process = start(rlds, tmp_path)
        while process.is_alive() and len(kept_parts(tmp_path)) == kept[-1]:
            time.sleep(0.002)  # until it has finished a part more
        time.sleep(draw.uniform(0, 0.05))
        os.kill(process.pid, signal.SIGKILL)
        process.join()
        kept.append(len(kept_parts(tmp_path)))
        assert process.exitcode == -signal.SIGKILL and kept[-1] > kept[-2]
    run(rlds, tmp_path)
    assert contents(tmp_path) == undisturbed


def test_finished_parts_are_not_made_again(rlds, tmp_path):
    begin(rlds, tmp_path)
    parts = {p: p.stat().st_mtime_ns for p in work_directory(tmp_path).glob("*.array_record")}
    assert len(parts) >= 3
    first = []
    run(rlds, tmp_path, progress=lambda done, total: first.append(done))
    assert first[0] >= 6  # the bar begins with what was kept
    assert {tmp_path / "toy" / p.name: t for p, t in parts.items()}.items() <= {
        p: p.stat().st_mtime_ns for p in (tmp_path / "toy").iterdir()
    }.items()


def begin(rlds: Path, store: Path, **options) -> Path:
    """The work directory of a job that ended early."""
    with pytest.raises(RuntimeError, match="enough"):
        run(rlds, store, progress=stop_after(10), **options)
    return work_directory(store)


def locks_of(work: Path) -> Path:
    return work.with_name(f"{work.name}.claims")


def stop_after(episodes: int):
    def progress(done: int, total: int) -> None:
        if done >= episodes:
            raise RuntimeError("enough")

    return progress


@pytest.mark.parametrize(
    "damage", ["truncated", "missing", "statistics", "no statistics", "actions", "facts", "other facts"]
)
def test_damaged_part_is_made_again(rlds, undisturbed, tmp_path, damage):
    work = begin(rlds, tmp_path)
    record, facts = sorted(work.glob("train-*.array_record"))[1], sorted(work.glob("parts/*.json"))
    if damage == "statistics":
        beside(record, MOMENTS).write_bytes(beside(record, MOMENTS).read_bytes()[:-1])
    elif damage == "no statistics":
        beside(record, MOMENTS).unlink()
    elif damage == "actions":
        actions = sorted(work.glob("val-*.actions.npy"))[0]
        np.save(actions, np.load(actions)[1:])
    elif damage == "truncated":
        record.write_bytes(record.read_bytes()[:-1])
    elif damage == "missing":
        record.unlink()
    elif damage == "facts":
        facts[0].write_text(facts[0].read_text()[:-9])
    else:
        facts[0].write_text(facts[1].read_text())
    run(rlds, tmp_path)
    assert contents(tmp_path) == undisturbed


def test_publishing_is_cleaned_up_after(rlds, undisturbed, tmp_path):
    """As if the process had been killed between its last two steps."""
    work = begin(rlds, tmp_path)
    run(rlds, tmp_path)
    (work / "parts").mkdir(parents=True)
    rest = locks_of(work) / "00000.scratch.12345678"
    rest.mkdir(parents=True)
    (rest / "rest").touch()
    assert run(rlds, tmp_path) is not None
    assert contents(tmp_path) == undisturbed and list(tmp_path.iterdir()) == [tmp_path / "toy"]


# --- several processes -------------------------------------------------------------------------


@pytest.mark.parametrize("processes", [2, 4])
def test_processes_at_the_same_time_make_the_same_store(rlds, undisturbed, tmp_path, processes):
    started = [start(rlds, tmp_path) for _ in range(processes)]
    assert [(p.join(), p.exitcode)[1] for p in started] == [0] * processes
    assert contents(tmp_path) == undisturbed


def test_a_part_that_another_process_makes_is_left_to_it_and_waited_for(rlds, undisturbed, tmp_path):
    work = begin(rlds, tmp_path)
    (number, *_) = [i for i in range(len(undisturbed)) if not (work / f"parts/{i:05d}.json").exists()]
    with ThreadPoolExecutor(1) as pool:
        with lock_output(locks_of(work) / f"{number:05d}"):
            assert run(rlds, tmp_path, wait=False) is None
            parts = {p.name for p in (work / "parts").iterdir()}
            assert f"{number:05d}.json" not in parts and len(parts) >= 8
            waiting = pool.submit(run, rlds, tmp_path)
            time.sleep(0.5)
            assert not waiting.done()
        assert waiting.result(30) is not None  # as if the other process had died: its part is made here
    assert contents(tmp_path) == undisturbed


def test_the_part_of_a_dead_process_is_made_again_and_what_it_left_removed(rlds, undisturbed, tmp_path):
    process = start(rlds, tmp_path)
    while not list(tmp_path.glob(".toy.*.claims/*.scratch.*")):
        time.sleep(0.002)
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    run(rlds, tmp_path)
    assert contents(tmp_path) == undisturbed and list(tmp_path.iterdir()) == [tmp_path / "toy"]


def test_the_part_of_another_host_is_left_to_it_until_its_lease_expires(rlds, undisturbed, tmp_path):
    """Where the file system does not show the locks of other hosts."""
    work = begin(rlds, tmp_path)
    lock = locks_of(work) / "00007.lock"
    lock.parent.mkdir(exist_ok=True)
    other = {"process": 7, "host": "other", "since": "then", "machine": "other", "token": "x"}
    lock.write_text(json.dumps(other))
    assert run(rlds, tmp_path, wait=False) is None
    assert json.loads(lock.read_text()) == other and not (work / "parts/00007.json").exists()
    os.utime(lock, (0, 0))
    assert run(rlds, tmp_path, wait=False) is not None
    assert contents(tmp_path) == undisturbed


def test_a_process_whose_part_was_taken_over_goes_on(rlds, undisturbed, tmp_path):
    """It was stopped for longer than its lease; another host has removed its directory and locked the part."""
    taken = []

    def take_over(done: int, total: int) -> None:
        if done >= 5 and not taken:
            (scratch,) = tmp_path.glob(".toy.*.claims/*.scratch.*")
            shutil.rmtree(scratch)
            lock = scratch.with_name(f"{scratch.name.split('.')[0]}.lock")
            taken.append(lock.read_text())
            lock.unlink()

    run(rlds, tmp_path, progress=take_over)
    assert taken and contents(tmp_path) == undisturbed


def test_there_is_no_bound_on_the_number_of_parts():
    assert len(cut_parts([10] * 5000, part_size=10)) == 5000


def test_jobs_of_different_settings_do_not_mix(rlds, tmp_path):
    begin(rlds, tmp_path)
    with pytest.raises(RuntimeError, match="enough"):
        run(rlds, tmp_path, progress=stop_after(10), keep_frames="all")
    assert [p.name for p in tmp_path.iterdir() if not p.name.startswith(".")] == []
    run(rlds, tmp_path)
    with pytest.raises(ConfigError, match="already tokenised with other settings.*keep_frames"):
        run(rlds, tmp_path, keep_frames="all")


def test_a_dataset_that_is_being_made_with_other_settings_is_refused_before_anything_is_made(rlds, tmp_path):
    """It took hours until the one that finished second was refused."""
    work = begin(rlds, tmp_path, keep_frames="all")
    with lock_output(locks_of(work) / "00007"):  # by a process that is alive
        with pytest.raises(ConfigError, match="toy: process .* is making this dataset with other settings"):
            run(rlds, tmp_path)
    assert set(tmp_path.glob(".toy.*")) == {work, locks_of(work)}


def test_a_finished_dataset_is_given_although_another_is_being_made_with_other_settings(rlds, tmp_path):
    work = begin(rlds, tmp_path, keep_frames="all")
    made = run(rlds, tmp_path)
    with lock_output(locks_of(work) / "00007"):  # by a process that is alive
        assert run(rlds, tmp_path) == made


def test_work_of_another_user_that_may_not_be_seen_is_in_nobody_s_way(rlds, tmp_path, monkeypatch):
    work = begin(rlds, tmp_path, keep_frames="all")
    opened = os.open

    def refuse(path, *how, **options):
        if str(path).startswith(str(locks_of(work))):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return opened(path, *how, **options)

    with lock_output(locks_of(work) / "00007"):
        monkeypatch.setattr(os, "open", refuse)
        assert run(rlds, tmp_path)


def test_overwriting_removes_what_was_made_otherwise(rlds, undisturbed, tmp_path):
    work = begin(rlds, tmp_path, keep_frames="none")
    run(rlds, tmp_path, keep_frames="all")
    with lock_output(locks_of(work) / "00007"):  # by a process that is alive
        with pytest.raises(ConfigError, match="toy: process .* is making this dataset with other settings"):
            run(rlds, tmp_path, overwrite=True)
        assert work.is_dir()
    run(rlds, tmp_path, overwrite=True)
    assert contents(tmp_path) == undisturbed
    (tmp_path / "toy/manifest.json").write_text('{"format": 1}')
    run(rlds, tmp_path, overwrite=True)
    assert contents(tmp_path) == undisturbed


# --- losses ------------------------------------------------------------------------------------


def test_failing_episode_is_left_out_whole_and_its_part_is_complete(rlds, undisturbed, tmp_path):
    def spoil(episode, features):
        if episode in (3, 4, 20):  # after frames that are good
            features["steps/observation/image"][4] = b"no image"

    bad = write_rlds(tmp_path / "rlds", SPEC, LENGTHS, shards=3, change=spoil)
    with pytest.raises(EpisodeError, match="step 4 of"):
        run(bad, tmp_path / "store")
    manifest = run(bad, tmp_path / "store", corrupt="skip")
    assert sorted((*manifest.train.episodes, *manifest.val.episodes)) == sorted(set(range(24)) - {3, 4, 20})
    assert [(loss.file[-14:], loss.offset > 0) for loss in manifest.skipped] == [
        ("00000-of-00003", True), ("00000-of-00003", True), ("00002-of-00003", True)
    ]  # fmt: skip
    store = TokenStore(tmp_path / "store")
    for i, episode in enumerate(manifest.train.episodes):
        item = store.episode("toy", "train", i)
        assert (item.tokens == episode * 256 + np.arange(0, LENGTHS[episode], 2)[:, None]).all()


@pytest.fixture
def lossy(tmp_path):
    def spoil(episode, features):
        if episode % 6 == 0:
            features["steps/action"][0] = np.nan

    return write_rlds(tmp_path / "rlds", SPEC, LENGTHS, change=spoil)  # 4 of 24


def test_losses_of_all_processes_count_against_the_bound(lossy, tmp_path):
    shared = dict(corrupt="skip", max_skipped=2)
    with pytest.raises(RuntimeError, match="enough"):  # two episodes are lost by then
        run(lossy, tmp_path / "a", progress=stop_after(11), **shared)
    with pytest.raises(DataError, match="3 episodes cannot be used, more than max_skipped=2.*episode 12 "):
        run(lossy, tmp_path / "a", **shared)
    assert len(kept_parts(tmp_path / "a")) <= 7, "it went on to the end before it said so"
    with pytest.raises(EpisodeError, match="not finite"):  # parts with losses are no longer good enough
        run(lossy, tmp_path / "a")
    assert run(lossy, tmp_path / "a", corrupt="skip", max_skipped=4).skipped_count == 4


def test_losses_of_a_process_at_the_same_time_are_seen_before_the_end(lossy, tmp_path):
    """Another process loses two episodes in parts that this one has passed, then this one a third."""
    shared, others = dict(corrupt="skip", max_skipped=2), []

    def other(done: int, total: int) -> None:
        if done >= 1 and not others:
            others.append(True)
            with pytest.raises(RuntimeError, match="enough"):
                run(lossy, tmp_path / "a", progress=stop_after(11), **shared)

    with pytest.raises(DataError, match="3 episodes cannot be used"):
        run(lossy, tmp_path / "a", progress=other, **shared)
    assert len(kept_parts(tmp_path / "a")) <= 7


def test_episodes_lost_by_several_processes_are_listed_once(lossy, tmp_path):
    run(lossy, tmp_path / "alone", corrupt="skip", max_skipped=4)
    started = [start(lossy, tmp_path / "many", corrupt="skip", max_skipped=4) for _ in range(3)]
    assert [(p.join(), p.exitcode)[1] for p in started] == [0, 0, 0]
    assert contents(tmp_path / "many") == contents(tmp_path / "alone")


# --- pieces ------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [[5], [1] * 100, [50, 1, 1, 1, 50], [0, 0, 7]])
def test_parts_cover_the_source_in_order(sizes):
    parts = cut_parts(sizes, part_size=10)
    assert [i for p in parts for i in p.episodes] == list(range(len(sizes)))
    assert all(p.count == len(parts) and len(p.episodes) for p in parts)


def test_moments_of_pieces_are_those_of_the_whole():
    rows = np.random.default_rng(0).normal(3, 5, (100, 4)).astype(np.float32)
    merged = merge_all(map(Moments.of, np.split(rows, [1, 7, 60])), 4)
    np.testing.assert_allclose(merged.mean, rows.astype(float).mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(merged.std, rows.astype(float).std(axis=0), rtol=1e-12)
    assert merged.low == tuple(rows.min(axis=0).tolist()) and merged.high == tuple(rows.max(axis=0).tolist())
    assert merge_all([], 2) == Moments.none(2)


def test_moments_of_an_episode_of_one_action_and_of_as_many_episodes_as_asked_for(tmp_path):
    np.testing.assert_array_equal(Moments.of(np.array([[3.0, 4.0]])).row, [1, 3, 4, 0, 0])
    np.save(beside(tmp_path / "part.array_record", MOMENTS), np.zeros((3, 5)))
    for episodes in (2, 4):
        with pytest.raises(DataError, match=f"of {episodes} episodes"):
            read_moments(tmp_path / "part.array_record", episodes)
