"""A store made in parts: by killed processes, by several, by two that do the same."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import time
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.tokens.dataset_writer import cut_parts
from data_pipelines.tokens.moments import Moments, merge_all, moments_path
from data_pipelines.tokens.scratch import scratch
from data_pipelines.tokens.share import Share
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import write_rlds
from tests.data_pipelines.tokens.job_process import SPEC, contents, run, start

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
    (work,) = [p for p in store.iterdir() if p.name.startswith(".toy.") and not p.name.endswith(".aside")]
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
    with pytest.raises(RuntimeError, match="enough"):
        run(rlds, tmp_path, progress=stop_after(10))
    parts = {p: p.stat().st_mtime_ns for p in work_directory(tmp_path).glob("*.array_record")}
    assert len(parts) >= 3
    first = []
    run(rlds, tmp_path, progress=lambda done, total: first.append(done))
    assert first[0] >= 6  # the bar begins with what was kept
    assert {tmp_path / "toy" / p.name: t for p, t in parts.items()}.items() <= {
        p: p.stat().st_mtime_ns for p in (tmp_path / "toy").iterdir()
    }.items()


def stop_after(episodes: int):
    def progress(done: int, total: int) -> None:
        if done >= episodes:
            raise RuntimeError("enough")

    return progress


@pytest.mark.parametrize("damage", ["truncated", "missing", "statistics", "no statistics", "facts", "other facts"])
def test_damaged_part_is_made_again(rlds, undisturbed, tmp_path, damage):
    with pytest.raises(RuntimeError, match="enough"):
        run(rlds, tmp_path, progress=stop_after(10))
    work = work_directory(tmp_path)
    record, facts = sorted(work.glob("train-*.array_record"))[1], sorted(work.glob("parts/*.json"))
    if damage == "statistics":
        moments_path(record).write_bytes(moments_path(record).read_bytes()[:-1])
    elif damage == "no statistics":
        moments_path(record).unlink()
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


def test_what_a_dead_process_left_aside_is_removed_and_a_living_one_keeps_it(tmp_path):
    process = multiprocessing.get_context("forkserver").Process(target=hold, args=(tmp_path,))
    process.start()
    while not list(tmp_path.glob("*/held")):
        time.sleep(0.01)
    with scratch(tmp_path):
        assert len(list(tmp_path.glob("*/held"))) == 1
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    with scratch(tmp_path) as mine:
        assert [p for p in tmp_path.iterdir() if p.is_dir()] == [mine]
    assert list(tmp_path.iterdir()) == []


def hold(root: Path) -> None:
    with scratch(root) as mine:
        (mine / "held").touch()
        time.sleep(60)


def test_publishing_is_cleaned_up_after(rlds, undisturbed, tmp_path):
    """As if the process had been killed between its last two steps."""
    run(rlds, tmp_path)
    assert run(rlds, tmp_path / "other", share=Share(0, 2)) is None
    aside = tmp_path / f"{work_directory(tmp_path / 'other').name}.aside"
    aside.mkdir()
    (aside / "rest").touch()
    assert run(rlds, tmp_path) is not None
    assert {k: v for k, v in contents(tmp_path).items() if not k.startswith("other")} == undisturbed


# --- several processes -------------------------------------------------------------------------


@pytest.mark.parametrize("processes", [2, 3, 40])
def test_any_number_of_processes_makes_the_same_store(rlds, undisturbed, tmp_path, processes):
    results = [run(rlds, tmp_path, share=Share(i, processes)) for i in range(processes)]
    manifests = [m for m in results if m is not None]
    assert manifests and results[0] is None  # some process is the last to have had anything to do
    assert contents(tmp_path) == undisturbed


def test_processes_at_the_same_time_make_the_same_store(rlds, undisturbed, tmp_path):
    started = [start(rlds, tmp_path, share=Share(i, 2)) for i in range(2)]
    assert [(p.join(), p.exitcode)[1] for p in started] == [0, 0]
    assert contents(tmp_path) == undisturbed


def test_two_that_do_the_same_by_accident_do_no_harm(rlds, undisturbed, tmp_path):
    started = [start(rlds, tmp_path) for _ in range(3)]
    assert [(p.join(), p.exitcode)[1] for p in started] == [0, 0, 0]
    assert contents(tmp_path) == undisturbed


def test_jobs_of_different_settings_do_not_mix(rlds, tmp_path):
    run(rlds, tmp_path, share=Share(0, 2))
    run(rlds, tmp_path, share=Share(1, 2), keep_frames="all")
    assert [p.name for p in tmp_path.iterdir() if not p.name.startswith(".")] == []
    run(rlds, tmp_path)
    with pytest.raises(ConfigError, match="already tokenised in another way.*keep_frames"):
        run(rlds, tmp_path, keep_frames="all")


def test_overwriting_removes_what_was_made_otherwise(rlds, undisturbed, tmp_path):
    run(rlds, tmp_path, share=Share(0, 2), keep_frames="none")
    run(rlds, tmp_path, keep_frames="all")
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
    assert sorted(manifest.train.episodes + manifest.val.episodes) == sorted(set(range(24)) - {3, 4, 20})
    assert [(loss.file[-14:], loss.offset > 0) for loss in manifest.skipped] == [
        ("00000-of-00003", True), ("00000-of-00003", True), ("00002-of-00003", True)
    ]  # fmt: skip
    store = TokenStore(tmp_path / "store")
    for i, episode in enumerate(manifest.train.episodes):
        item = store.episode("toy", "train", i)
        assert (item.tokens == episode * 256 + np.arange(0, LENGTHS[episode], 2)[:, None]).all()


def test_losses_of_all_parts_count_against_the_bound(tmp_path):
    def spoil(episode, features):
        if episode % 6 == 0:
            features["steps/action"][0] = np.nan

    bad = write_rlds(tmp_path / "rlds", SPEC, LENGTHS, change=spoil)
    shared = dict(corrupt="skip", max_skipped=3)
    run(bad, tmp_path / "a", share=Share(0, 2), **shared)
    with pytest.raises(DataError, match="4 episodes are unusable, more than max_skipped=3"):
        run(bad, tmp_path / "a", share=Share(1, 2), **shared)
    with pytest.raises(EpisodeError, match="not finite"):  # parts with losses are no longer good enough
        run(bad, tmp_path / "a")


# --- pieces ------------------------------------------------------------------------------------


@pytest.mark.parametrize("sizes", [[5], [1] * 100, [50, 1, 1, 1, 50], [0, 0, 7]])
def test_parts_cover_the_source_in_order(sizes):
    parts = cut_parts(sizes, part_size=10, most=8)
    assert [i for p in parts for i in p.episodes] == list(range(len(sizes)))
    assert len(parts) <= 9 and all(p.count == len(parts) and len(p.episodes) for p in parts)


def test_moments_of_pieces_are_those_of_the_whole():
    rows = np.random.default_rng(0).normal(3, 5, (100, 4)).astype(np.float32)
    merged = merge_all(map(Moments.of, np.split(rows, [1, 7, 60])), 4)
    np.testing.assert_allclose(merged.mean, rows.astype(float).mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(merged.std, rows.astype(float).std(axis=0), rtol=1e-12)
    assert merged.low == tuple(rows.min(axis=0).tolist()) and merged.high == tuple(rows.max(axis=0).tolist())
    assert merge_all([], 2) == Moments.none(2)
