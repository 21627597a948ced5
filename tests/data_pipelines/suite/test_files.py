"""The suite on disk: readable by tfds, the same from any number of workers, remade when stale."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from data_pipelines.registry import get_spec
from data_pipelines.sampling.splits import HeldOut, held_out_episodes
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.rlds.tfrecord import read_record
from data_pipelines.suite import generate
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.embodiments import EMBODIMENTS
from data_pipelines.suite.environment import Environment
from data_pipelines.suite.generate import MIN_EPISODES, episode_count, fingerprint, generate_suite
from data_pipelines.suite.render import positions_of, render_frames
from data_pipelines.suite.rollout import episode_seeds, simulate
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.windows import train_windows, val_windows
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import FakeTokenizer
from tests.data_pipelines.shards import index_shard
from tests.data_pipelines.tokenizing import tokenize_dataset
from tests.files import contents

NAMES = ("pusher_mint", "rover_slate", "mobile_sky")
"""Short ones: a single tensor of actions; video alone; dict-valued actions."""

TINY = {"scale": 1e-3, "validation": 3}


@pytest.fixture(scope="module")
def suite(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("suite")
    generate_suite(root, **TINY, names=NAMES)
    return root


@pytest.mark.parametrize("name", NAMES)
def test_tfds_decodes_exactly_what_was_simulated(suite, name):
    import tensorflow_datasets as tfds

    spec = next(s for s in EMBODIMENTS if s.name == name)
    directory = suite / name / "1.0.0"
    builder = tfds.builder_from_directory(str(directory))
    assert builder.name == name
    assert {k: v.num_examples for k, v in builder.info.splits.items()} == {"train": MIN_EPISODES, "val": 3}
    assert list(builder.info.metadata["positions"]) == list(spec.points)

    seeds = np.concatenate([episode_seeds(spec, MIN_EPISODES, 0), episode_seeds(spec, 3, 0, "val")])
    rollout = simulate(spec, seeds)
    for split, i in (("train", 3), ("val", 1)):
        shards = [index_shard(directory / f) for f in builder.info.splits[split].filenames]
        records = [read_record(s.path, o, n) for s in shards for o, n in zip(s.offsets, s.lengths, strict=True)]
        assert sum(map(len, records)) == builder.info.splits[split].num_bytes
        example = builder.info.features.deserialize_example_np(records[i])
        check_episode(spec, example, rollout, i if split == "train" else MIN_EPISODES + i)


def check_episode(spec, example, rollout, i):
    steps, length = list(example["steps"]), rollout.lengths[i]
    assert len(steps) == length
    assert int(example["episode_metadata"]["seed"]) == rollout.seeds[i]
    assert bool(example["episode_metadata"]["success"]) == bool(rollout.success[i])
    assert sum(float(s["reward"]) for s in steps) == float(rollout.success[i])
    assert [bool(s["is_first"]) for s in steps] == [True] + [False] * (len(steps) - 1)
    assert [bool(s["is_last"]) for s in steps] == [False] * (len(steps) - 1) + [True]
    assert steps[0]["language_instruction"].decode() == spec.instruction
    assert ("action" in steps[0]) != spec.video_only

    q, objects = rollout.q[i, :length], rollout.objects[i, :length]
    looks = draw_appearance(spec, rollout.seeds[i : i + 1])
    images = render_frames(spec, looks, rollout.goals[i : i + 1], q, objects, np.zeros(length, int))
    positions = positions_of(spec, q, objects)
    for t, step in enumerate(steps):
        if not spec.video_only:
            action = step["action"]
            if spec.dict_actions:
                action = np.concatenate([action[c.key] for c in spec.controls])
            np.testing.assert_array_equal(action, rollout.actions[i, t])
        np.testing.assert_array_equal(step["observation"]["state"], q[t].astype(np.float32))
        np.testing.assert_array_equal(step["observation"]["position"], positions[t])
        error = step["observation"]["image"].astype(int) - images[t]
        assert np.abs(error).mean() < 2.5, "the JPEG is of another frame"


def test_a_recorded_episode_replays_in_the_true_environment(suite):
    """From the file alone: its seed and its actions give its positions."""
    from data_pipelines.sources.rlds.dataset import RldsDataset

    name = "pusher_mint"
    record = RldsDataset(suite / name).record(2)
    env = Environment(name)
    env.reset(int(record["episode_metadata/seed"][0]))
    positions = np.asarray(record["steps/observation/position"]).reshape(-1, len(env.spec.points), 2)
    for t, action in enumerate(np.asarray(record["steps/action"]).reshape(-1, 2)):
        np.testing.assert_array_equal(env.positions(), positions[t])
        env.step(action)


def test_the_validation_split_is_what_is_held_out(suite):
    """Whatever fraction is asked for: the store and the frame loader both take it as it is."""
    spec = get_spec("pusher_mint")
    source = RldsDataset(suite / spec.name, spec.split)
    mask = held_out_episodes(spec, source.runs, HeldOut(0.5, 1, 1, 0.25))
    assert mask.tolist() == [False] * MIN_EPISODES + [True] * 3
    seeds = [int(source.record(i)["episode_metadata/seed"][0]) for i in range(len(source))]
    robot = next(s for s in EMBODIMENTS if s.name == spec.name)
    assert seeds[MIN_EPISODES:] == episode_seeds(robot, 3, 0, "val").tolist()
    with pytest.raises(ConfigError, match="no split 'test'.*; it has train, val"):
        RldsDataset(suite / spec.name, "train+test")


def test_the_token_store_and_the_frame_loader_hold_out_the_validation_split(suite, tmp_path):
    from data_pipelines.loading.frames import make_frame_loader
    from data_pipelines.registry import get_spec
    from data_pipelines.sources.rlds.dataset import RldsDataset
    from tests.data_pipelines.fakes import FakeTokenizer
    from tests.data_pipelines.tokenizing import tokenize_dataset

    spec = get_spec("pusher_mint")
    manifest = tokenize_dataset(spec, suite / spec.name, FakeTokenizer(), tmp_path, min_val=1, max_val=1)
    assert (len(manifest.train.episodes), len(manifest.val.episodes)) == (MIN_EPISODES, 3)

    source = RldsDataset(suite / spec.name, "val")
    recorded = np.concatenate([source.episode(i, spec.image_key, ()).images for i in range(3)])
    batches = make_frame_loader(
        [(spec, suite / spec.name)],
        64,
        8,
        0,
        held_out=HeldOut(min_val=1, max_val=1),
        split="val",
        tau=3.0,
    )
    for frame in next(batches):
        assert (frame == recorded).all((1, 2, 3)).any(), "a frame of no validation episode"


def test_images_are_jpegs_without_chroma_subsampling(suite):
    from data_pipelines.sources.rlds.example import parse_example

    shard = index_shard(next((suite / NAMES[0]).rglob("*.tfrecord-*")))
    record = parse_example(read_record(shard.path, shard.offsets[0], shard.lengths[0]))
    header = simplejpeg.decode_jpeg_header(record["steps/observation/image"][0])
    assert header == (64, 64, "YCbCr", "444")


def test_bytes_do_not_depend_on_the_number_of_workers(suite, tmp_path):
    seen = []
    paths = generate_suite(tmp_path, **TINY, names=NAMES, workers=2, progress=lambda name, k, n: seen.append((k, n)))
    assert [p.parent.name for p in paths] == list(NAMES)
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert contents(tmp_path) == contents(suite)


@pytest.mark.parametrize(
    "send, number",
    [
        (os.kill, signal.SIGINT),
        pytest.param(os.killpg, signal.SIGINT, marks=pytest.mark.slow),
        (os.kill, signal.SIGKILL),
    ],
    ids=["by kill", "by a terminal", "by kill -9"],
)
def test_processes_that_have_hours_to_do_end_with_their_command(tmp_path, send, number):
    """A terminal sends Ctrl-C to every process of the command, kill to one; SIGKILL no program can pass on."""
    call = f"generate_suite(Path({str(tmp_path)!r}), scale=1000.0, names={NAMES}, workers=2)"
    program = f"from pathlib import Path; from data_pipelines.suite.generate import generate_suite; {call}"
    with (
        open(tmp_path / "said", "w+") as said,  # no pipe: a process that stays would keep it open
        subprocess.Popen([sys.executable, "-c", program], start_new_session=True, stderr=said) as command,
    ):
        deadline = time.monotonic() + 60
        while len(list(tmp_path.glob("*/.*.scratch.*"))) < 2 and time.monotonic() < deadline:
            assert command.poll() is None, (tmp_path / "said").read_text()
            time.sleep(0.05)
        send(command.pid, number)
        command.wait(30)
    assert number == signal.SIGKILL or "KeyboardInterrupt" in (tmp_path / "said").read_text()
    with pytest.raises(ProcessLookupError):  # nobody is left of its session
        for _ in range(100):
            os.killpg(command.pid, 0)
            time.sleep(0.1)
        os.killpg(command.pid, signal.SIGKILL)


def test_another_seed_gives_other_episodes(suite, tmp_path):
    generate_suite(tmp_path, **TINY, names=NAMES[:1], seed=1)
    key = f"{NAMES[0]}/1.0.0/{NAMES[0]}-train.tfrecord-00000-of-00001"
    assert contents(tmp_path)[key] != contents(suite)[key]


def test_only_what_is_missing_stale_or_damaged_is_made(tmp_path, monkeypatch):
    made = []
    write = generate.write_dataset

    def spy(spec, directory, **kwargs):
        made.append(spec.name)
        return write(spec, directory, **kwargs)

    monkeypatch.setattr(generate, "write_dataset", spy)

    def run(**kwargs) -> list[str]:
        made.clear()
        generate_suite(tmp_path, names=NAMES[:2], **{**TINY, **kwargs})
        return sorted(made)

    assert run() == sorted(NAMES[:2])
    before = contents(tmp_path)
    assert run() == []
    next((tmp_path / NAMES[0]).rglob("*.tfrecord-*")).unlink()
    assert run() == [NAMES[0]]
    assert contents(tmp_path) == before
    assert run(seed=3) == sorted(NAMES[:2])
    monkeypatch.setattr(generate, "GENERATOR_VERSION", generate.GENERATOR_VERSION + 1)
    assert run(seed=3) == sorted(NAMES[:2])


def test_a_dataset_appears_only_when_it_is_complete(tmp_path, monkeypatch):
    def fail(spec, directory, **kwargs):
        (directory / "half").write_text("written")
        raise OSError("disk full")

    write = generate.write_dataset
    monkeypatch.setattr(generate, "write_dataset", fail)
    with pytest.raises(OSError, match="disk full"):
        generate_suite(tmp_path, **TINY, names=NAMES[:1])
    assert contents(tmp_path) == {}

    stale = tmp_path / NAMES[0] / ".1.0.0.scratch.12345678"  # as kill -9 leaves it
    stale.mkdir(parents=True)
    (tmp_path / NAMES[0] / ".1.0.0.lock").touch()
    monkeypatch.setattr(generate, "write_dataset", write)
    generate_suite(tmp_path, **TINY, names=NAMES[:1])
    assert [p.name for p in (tmp_path / NAMES[0]).iterdir()] == ["1.0.0"]


def test_what_another_process_is_making_is_waited_for_and_not_made_again(tmp_path, monkeypatch):
    began, name = threading.Event(), NAMES[0]
    write, made = generate.write_dataset, []

    def slowly(spec, directory, **kwargs):
        began.set()
        time.sleep(0.3)
        assert directory.is_dir(), "its directory was removed while it was at work"
        made.append(directory)
        return write(spec, directory, **kwargs)

    monkeypatch.setattr(generate, "write_dataset", slowly)
    with ThreadPoolExecutor(2) as pool:
        first = pool.submit(generate_suite, tmp_path, **TINY, names=[name])
        assert began.wait(30)
        second = pool.submit(generate_suite, tmp_path, **TINY, names=[name])
        assert first.result() == second.result()
    assert len(made) == 1 and [p.name for p in (tmp_path / name).iterdir()] == ["1.0.0"]


def test_subsets_are_of_the_training_split_alone(suite, tmp_path):
    spec = get_spec("pusher_mint")
    tokenize_dataset(spec, suite / spec.name, FakeTokenizer(), tmp_path)
    store = TokenStore(tmp_path)
    everything, held = train_windows(store, spec.name, 4, rate=2.0), val_windows(store, spec.name, 4, 3, rate=2.0)
    assert len(everything.episodes) == MIN_EPISODES and len(held.episodes) == 3
    few, more = (set(train_windows(store, spec.name, 4, n, rate=2.0).episodes.tolist()) for n in (3, MIN_EPISODES - 1))
    assert (len(few), len(more)) == (3, MIN_EPISODES - 1) and few < more


def test_the_fingerprint_follows_everything_the_bytes_depend_on():
    large, small = (next(s for s in EMBODIMENTS if s.episodes == n) for n in (500, MIN_EPISODES))
    marks = [fingerprint(large, 1.0, 0), fingerprint(small, 1.0, 0), fingerprint(large, 0.5, 0)]
    marks += [fingerprint(large, 1.0, 1), fingerprint(large, 1.0, 0, validation=5)]
    assert len(set(marks)) == 5
    assert fingerprint(small, 1.0, 0) == fingerprint(small, 8.0, 0)  # it keeps its size
    assert fingerprint(small, 1.0, 0) != fingerprint(small, 1.0, 0, fewest=9)


def test_sizes_go_evenly_in_the_logarithm_from_the_fewest_to_the_most():
    small, large = min(EMBODIMENTS, key=lambda e: e.episodes), max(EMBODIMENTS, key=lambda e: e.episodes)
    assert (episode_count(small, 4.0, 128), episode_count(large, 4.0, 128)) == (128, 2000)
    assert (episode_count(small, 1.0), episode_count(large, 1.0)) == (MIN_EPISODES, 500)
    middle = min(EMBODIMENTS, key=lambda e: abs(e.episodes - 63))  # half-way, in the logarithm
    assert episode_count(middle, 4.0, 128) == pytest.approx(math.sqrt(128 * 2000), rel=0.05)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"names": ["no_such_robot"]}, "unknown embodiment.*no_such_robot.*pusher_sand"),
        ({"scale": 0.0}, "scale must be positive"),
        ({"scale": math.inf}, "scale must be positive and finite, got inf"),
        ({"workers": 0}, "workers must be at least 1"),
        ({"validation": 0}, "validation must be at least 1"),
    ],
)
def test_bad_arguments_are_named(tmp_path, arguments, message):
    with pytest.raises(ConfigError, match=message):
        generate_suite(tmp_path, **arguments)


def test_a_root_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("not a directory")
    with pytest.raises(ConfigError, match="cannot write to .*suite: .*file is a file"):
        generate_suite(tmp_path / "file" / "suite", **TINY, names=NAMES[:1])
