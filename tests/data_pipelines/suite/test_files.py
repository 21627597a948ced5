"""The suite on disk: readable by tfds, the same from any number of workers, remade when stale."""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from data_pipelines.sources.rlds.tfrecord import index_shard, read_record
from data_pipelines.suite import generate
from data_pipelines.suite.appearance import draw_appearance
from data_pipelines.suite.embodiments import EMBODIMENTS
from data_pipelines.suite.generate import MIN_EPISODES, fingerprint, generate_suite
from data_pipelines.suite.render import frame_index, render_frames
from data_pipelines.suite.rollout import simulate
from hma_jax.config import ConfigError

NAMES = ("plate_pusher_pose_metres", "round_robot_twist", "two_arms_tool_delta")
"""Small ones: a single tensor of actions; two cameras; dict-valued actions, three cameras."""

TINY = 1e-3


@pytest.fixture(scope="module")
def suite(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("suite")
    generate_suite(root, scale=TINY, names=NAMES)
    return root


def contents(root: Path) -> dict[str, bytes]:
    return {str(p.relative_to(root)): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("name", NAMES)
def test_tfds_decodes_exactly_what_was_simulated(suite, name):
    import tensorflow_datasets as tfds

    spec = next(s for s in EMBODIMENTS if s.name == name)
    directory = suite / name / "1.0.0"
    builder = tfds.builder_from_directory(str(directory))
    assert builder.name == name
    assert builder.info.splits["train"].num_examples == MIN_EPISODES

    shards = [index_shard(directory / f) for f in builder.info.splits["train"].filenames]
    records = [
        read_record(s.path, o, n) for s in shards for o, n in zip(s.offsets, s.lengths, strict=True)
    ]
    assert sum(map(len, records)) == builder.info.splits["train"].num_bytes
    example = builder.info.features.deserialize_example_np(records[3])
    seed = int(example["episode_metadata"]["seed"])
    rollout, looks = simulate(spec, MIN_EPISODES, seed), draw_appearance(spec, MIN_EPISODES, seed)
    steps = list(example["steps"])
    assert len(steps) == rollout.lengths[3]
    assert bool(example["episode_metadata"]["success"]) == bool(rollout.success[3])
    assert sum(float(s["reward"]) for s in steps) == float(rollout.success[3])
    assert [bool(s["is_first"]) for s in steps] == [True] + [False] * (len(steps) - 1)
    assert [bool(s["is_last"]) for s in steps] == [False] * (len(steps) - 1) + [True]
    assert steps[0]["language_instruction"].decode() == spec.instruction

    frames = {c.key: render_frames(spec, rollout, looks, c, *frame_index(rollout, [3])) for c in spec.cameras}
    for t, step in enumerate(steps):
        action = step["action"]
        if spec.dict_actions:
            action = np.concatenate([action[key] for key, _ in spec.action_layout])
        np.testing.assert_array_equal(action, rollout.actions[3, t])
        np.testing.assert_array_equal(step["observation"]["state"], rollout.q[3, t].astype(np.float32))
        for key, images in frames.items():
            assert step["observation"][key].shape == images[t].shape
            error = step["observation"][key].astype(int) - images[t]
            assert np.abs(error).mean() < 2.5, "the JPEG is of another frame"


def test_images_are_jpegs_without_chroma_subsampling(suite):
    from data_pipelines.sources.rlds.example import parse_example

    shard = index_shard(next((suite / NAMES[0]).rglob("*.tfrecord-*")))
    record = parse_example(read_record(shard.path, shard.offsets[0], shard.lengths[0]))
    header = simplejpeg.decode_jpeg_header(record["steps/observation/image"][0])
    assert header == (64, 64, "YCbCr", "444")


def test_bytes_do_not_depend_on_the_number_of_workers(suite, tmp_path):
    seen = []
    paths = generate_suite(
        tmp_path, scale=TINY, names=NAMES, workers=2, progress=lambda name, k, n: seen.append((k, n))
    )
    assert [p.parent.name for p in paths] == list(NAMES)
    assert seen == [(1, 3), (2, 3), (3, 3)]
    assert contents(tmp_path) == contents(suite)


def test_another_seed_gives_other_episodes(suite, tmp_path):
    generate_suite(tmp_path, scale=TINY, names=NAMES[:1], seed=1)
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
        generate_suite(tmp_path, names=NAMES[:2], **{"scale": TINY, **kwargs})
        return sorted(made)

    assert run() == sorted(NAMES[:2])
    before = contents(tmp_path)
    assert run() == []
    next((tmp_path / NAMES[0]).rglob("*.tfrecord-*")).unlink()
    assert run() == [NAMES[0]]
    assert contents(tmp_path) == before
    assert run(seed=3) == sorted(NAMES[:2])
    monkeypatch.setattr(generate, "GENERATOR", generate.GENERATOR + 1)
    assert run(seed=3) == sorted(NAMES[:2])


def test_a_dataset_appears_only_when_it_is_complete(tmp_path, monkeypatch):
    def fail(spec, directory, **kwargs):
        (directory / "half").write_text("written")
        raise OSError("disk full")

    write = generate.write_dataset
    monkeypatch.setattr(generate, "write_dataset", fail)
    with pytest.raises(OSError, match="disk full"):
        generate_suite(tmp_path, scale=TINY, names=NAMES[:1])
    assert contents(tmp_path) == {}

    stale = tmp_path / NAMES[0] / ".1.0.0.scratch.12345678"  # as kill -9 leaves it
    stale.mkdir(parents=True)
    (tmp_path / NAMES[0] / ".1.0.0.lock").touch()
    monkeypatch.setattr(generate, "write_dataset", write)
    generate_suite(tmp_path, scale=TINY, names=NAMES[:1])
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
        first = pool.submit(generate_suite, tmp_path, scale=TINY, names=[name])
        assert began.wait(30)
        second = pool.submit(generate_suite, tmp_path, scale=TINY, names=[name])
        assert first.result() == second.result()
    assert len(made) == 1 and [p.name for p in (tmp_path / name).iterdir()] == ["1.0.0"]


def test_the_fingerprint_follows_everything_the_bytes_depend_on():
    first, second = EMBODIMENTS[:2]
    marks = [fingerprint(first, 1.0, 0), fingerprint(second, 1.0, 0), fingerprint(first, 0.5, 0)]
    marks.append(fingerprint(first, 1.0, 1))
    assert len(set(marks)) == 4


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({"names": ["no_such_robot"]}, "unknown embodiment.*no_such_robot.*two_link_arm_joint_targets"),
        ({"scale": 0.0}, "scale must be positive"),
        ({"workers": 0}, "workers must be at least 1"),
    ],
)
def test_bad_arguments_are_named(tmp_path, arguments, message):
    with pytest.raises(ConfigError, match=message):
        generate_suite(tmp_path, **arguments)


def test_a_root_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("not a directory")
    with pytest.raises(ConfigError, match="cannot make the suite's directory"):
        generate_suite(tmp_path / "file" / "suite", scale=TINY, names=NAMES[:1])
