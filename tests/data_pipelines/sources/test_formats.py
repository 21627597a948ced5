"""Every format is read where it lies: the same episodes, frames and actions, by the same interface."""

from __future__ import annotations

import errno
import itertools
import json
import os
import pickle
import re
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.convert.write import convert, suggest_spec
from data_pipelines.errors import CorruptRecordError, DataError, EpisodeError, NoDatasetError, UnreachableError
from data_pipelines.inspection.inspect import inspect_dataset
from data_pipelines.inspection.suggest import suggest_entry
from data_pipelines.loading.frames import make_frame_loader
from data_pipelines.names import MANIFEST
from data_pipelines.registry import DatasetSpec
from data_pipelines.sampling.splits import HeldOut
from data_pipelines.sources import lerobot_dataset, lerobot_meta
from data_pipelines.sources.joined import JoinedSource
from data_pipelines.sources.lerobot import LeRobotSource
from data_pipelines.sources.open import FORMATS, SourceSize, find_format, open_source, read_rate, read_size, source_name
from data_pipelines.sources.rlds import location
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.sources.robomimic import RobomimicSource
from data_pipelines.sources.video import open_video
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import (
    CAMERA,
    demo_actions,
    lerobot_actions,
    number,
    write_lerobot,
    write_robomimic,
    write_video,
)
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

TOP = DatasetSpec("toy_arm", "observation/top", ("action",), (3,), 10)
VIEW = DatasetSpec("robomimic_lift", "observation/agentview", ("action",), (7,), 20)


def check_lerobot(source, lengths=(12, 9)):
    assert (source.name, source.hz, len(source)) == ("toy_arm", 10, len(lengths))
    source.check_keys(TOP.image_key, TOP.action_keys, TOP.action_dims)
    assert source.steps().tolist() == list(lengths) and (source.sizes() > 0).all()
    for e, steps in enumerate(lengths):
        episode = source.episode(e, TOP.image_key, TOP.action_keys)
        assert [number(image) for image in episode.images] == [24 * e + t for t in range(steps)]
        np.testing.assert_array_equal(episode.actions, lerobot_actions(e, steps))
        assert episode.success is (e == 0)
        chosen = source.frames(e, TOP.image_key, lambda n: [n - 1, 0, 3, 3])
        assert [number(image) for image in chosen] == [24 * e + t for t in (steps - 1, 0, 3, 3)]


@pytest.mark.parametrize("camera", ["video", "image"])
@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_lerobot_is_read_where_it_lies(tmp_path, version, camera):
    root = write_lerobot(tmp_path / "toy-arm", version, camera=camera)
    assert find_format(root) == "lerobot" and source_name(str(root)) == "toy_arm"
    source = open_source(root)
    check_lerobot(source)
    check_lerobot(pickle.loads(pickle.dumps(source)))
    assert open_source(root).fingerprint() == source.fingerprint()
    shutil.copytree(root, tmp_path / "elsewhere" / "toy-arm")
    assert open_source(tmp_path / "elsewhere" / "toy-arm").fingerprint() == source.fingerprint()
    (tmp_path / "机器人").symlink_to(root)
    for read in (open_source, source_name):
        with pytest.raises(
            DataError,
            match="机器人: a LeRobot dataset gets the name of its folder, but this name contains none of a to z",
        ):
            read(tmp_path / "机器人")


def test_features_have_their_own_names(tmp_path):
    """Not every program that writes LeRobot datasets writes `observation.` and `action`."""
    names = {CAMERA: "image", "action": "actions", "observation.state": "state"}

    def rename(e, rows):
        for old, new in names.items():
            rows[new] = rows.pop(old)

    root = write_lerobot(tmp_path / "toy-arm", "v2.1", camera="image", change=rename)
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    features = {names.get(name, name): feature for name, feature in info["features"].items()}
    path.write_text(json.dumps(info | {"features": features}))
    source = open_source(root)
    assert list(source.features) == ["steps/observation/image", "steps/state", "steps/actions"]
    entry = suggest_entry(inspect_dataset(root).facts, 10)
    assert (entry.image_key, entry.action_keys, entry.action_dims) == ("observation/image", ("actions",), (3,))
    episode = source.episode(1, entry.image_key, ["actions", "state"])
    np.testing.assert_array_equal(episode.actions[:, :3], lerobot_actions(1, 9))
    np.testing.assert_array_equal(episode.actions[:, 3:], [[1, t] for t in range(9)])
    assert convert(LeRobotSource(root), tmp_path / "rlds", "toy").spec.action_keys == ("actions",)
    path.write_text(json.dumps(info | {"features": features | {"action": features["actions"]}}))
    assert suggest_spec(LeRobotSource(root), "toy").action_keys == ("action",), "not one after the other"
    del features["actions"]
    path.write_text(json.dumps(info | {"features": features}))
    assert open_source(root).episode(1, "observation/image", []).actions.shape == (9, 0), "video without actions"


def test_in_the_cache_of_the_hub_a_dataset_has_the_name_of_its_repository(tmp_path):
    """By the revision, every one would be another robot with other held-out episodes."""
    repository = tmp_path / "datasets--lerobot--Toy-Arm"
    for time, revision in enumerate(("f" * 40, "a" * 40), 1):
        root = write_lerobot(repository / "snapshots" / revision, "v2.1", camera="image")
        os.utime(root, (time, time))
        (repository / "blobs").mkdir(exist_ok=True)
        assert source_name(root) == open_source(root).name == "toy_arm"
    with pytest.raises(DataError, match=f"Datasets in it: {root}$"):
        open_source(repository)


def test_frames_of_a_record_are_decoded_from_a_video_that_is_opened_once(tmp_path, monkeypatch):
    opened, closed = [], []

    @contextmanager
    def counted(path, hz):
        opened.append(path)
        with open_video(path, hz) as video:
            yield video
        closed.append(path)

    monkeypatch.setattr(lerobot_dataset, "open_video", counted)
    dataset = open_source(write_lerobot(tmp_path / "toy", "v3.0"))
    frames = dataset.record(1, ["steps/observation/top"])["steps/observation/top"]
    assert [number(frames[t]) for t in (0, 3, 8, 2)] == [24, 27, 32, 26] and len(opened) == 1
    del frames
    assert len(closed) == 1


def test_lerobot_actions_alone_can_be_sliced_and_be_none(tmp_path):
    source = open_source(write_lerobot(tmp_path / "toy-arm", "v2.1"))
    assert source.episode(1, TOP.image_key, ("action[:2]", "observation/state")).actions[3].tolist() == [
        *lerobot_actions(1, 9)[3, :2], 1, 3
    ]  # fmt: skip
    assert source.episode(1, TOP.image_key, ()).actions.shape == (9, 0)
    assert [source.episode(i, TOP.image_key, ()).success for i in (0, 1)] == [True, False]
    with pytest.raises(ConfigError, match="toy_arm: no image 'observation/tip' in .*info.json; images there: "):
        source.check_keys("observation/tip", ())


def test_an_episode_of_lerobot_keeps_its_name_when_others_are_gone(tmp_path):
    root = write_lerobot(tmp_path / "toy-arm", "v2.1", lengths=(12, 9, 7))
    ids = open_source(root).ids
    path = root / "meta" / "episodes.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text(lines[0] + lines[2])
    with pytest.raises(
        DataError, match="meta: it lists 2 episodes, without episode 1, but total_episodes .* is 3.*write 2"
    ):
        open_source(root)
    source = open_source(root, corrupt="skip")
    assert list(source.skipped.values()) == [1]
    assert source.ids.tolist() == ids.tolist() and source.numbers.tolist() == [0, 2]
    assert source.episode(1, TOP.image_key, ()).steps == 7
    info = root / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"total_episodes": 2}))
    assert open_source(root).ids.tolist() == [ids[0], ids[2]]


def test_hidden_files_of_the_meta_folder_are_no_part_of_the_dataset(tmp_path, monkeypatch):
    """A file manager's made finished tokens those of other recordings. The others are hashed once per opened source,
    in bounded memory."""
    root = write_lerobot(tmp_path / "toy-arm", "v2.1")
    before, identity = open_source(root).fingerprint(), LeRobotSource(root).identity()
    (root / "meta" / ".cache").mkdir()
    for name in (".DS_Store", ".cache/lock"):
        (root / "meta" / name).write_text("here")
    monkeypatch.setattr(Path, "read_bytes", None)
    source = open_source(root)
    assert source.fingerprint() == before and LeRobotSource(root).identity() == identity
    (root / "meta" / "episodes_stats.jsonl").write_text("{}")
    assert source.fingerprint() == before != open_source(root).fingerprint()


def test_the_meta_folder_is_read_again_only_where_it_changed(tmp_path, monkeypatch):
    """A command opens a dataset several times: to check it, to train a tokenizer and to tokenise."""
    root, read = write_lerobot(tmp_path / "toy-arm", "v2.1"), []
    monkeypatch.setattr(lerobot_meta, "_tasks", lambda *given: read.append(given) or {})
    assert read_rate(root) == 10 and not read, "the rate is known without the episodes"
    fingerprint = open_source(root).fingerprint()
    assert open_source(root).fingerprint() == fingerprint and len(read) == 1
    path = root / "meta" / "episodes.jsonl"
    path.write_text(path.read_text().replace('"length": 12', '"length": 11'))
    assert open_source(root).steps().tolist() == [11, 9] and len(read) == 2


def test_the_name_and_the_rate_of_a_robomimic_file_need_no_demonstration(tmp_path):
    path = write_robomimic(tmp_path / "image.hdf5", images=False)
    assert (source_name(path), read_rate(path)) == ("robomimic_lift", 20)


@pytest.mark.parametrize("layout", ["v2.1", "v3.0", "rlds", "robomimic"])
def test_how_many_episodes_there_are_needs_none_of_them(tmp_path, layout, monkeypatch):
    """Plans are made before anything is read; how long they are, not every format says."""
    if layout == "rlds":
        place = write_rlds(tmp_path, make_spec(), [5, 7, 4], shards=2)
    elif layout == "robomimic":
        place = write_robomimic(tmp_path / "image.hdf5", lengths=(5, 7, 4), images=False)
        assert read_size(place, "train+valid").episodes == 3 and read_size(place, "valid").episodes == 1
    else:
        place = write_lerobot(tmp_path / "toy-arm", layout, lengths=(5, 7, 4), camera="image")
        info = json.loads((place / "meta" / "info.json").read_text())
        (place / "meta" / "info.json").write_text(json.dumps(info | {"total_frames": 16}))
    monkeypatch.setattr("data_pipelines.sources.rlds.dataset.load_index", lambda *_: pytest.fail("shards were read"))
    expected = SourceSize(3) if layout == "rlds" else SourceSize(3, 16 / 3)
    assert read_size(place, "train") == expected


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_statistics_and_texts_of_a_dataset_are_no_part_of_its_recordings(tmp_path, version):
    root = write_lerobot(tmp_path / "toy-arm", version)
    pq = pytest.importorskip("pyarrow.parquet")

    def add_statistics(value: float) -> None:
        if version == "v2.1":
            (root / "meta" / "episodes_stats.jsonl").write_text(json.dumps({"stats": {"action": {"mean": [value]}}}))
            return
        (path,) = (root / "meta" / "episodes").rglob("*.parquet")
        table = pq.read_table(path)
        known = [c for c in table.column_names if not c.startswith("stats/")]
        pq.write_table(table.select(known).append_column("stats/action/mean", [[[0.0] * 3, [value] * 3]]), path)

    add_statistics(0.0)
    before = open_source(root).fingerprint()
    (root / "meta" / "stats.json").write_text('{"action": {"q01": [0]}}')
    (root / "meta" / "README.md").write_text("Task texts were corrected.")
    for path in (root / "meta").glob("tasks.*"):
        path.unlink()
    assert open_source(root).fingerprint() == before
    if version == "v2.1":
        path = root / "meta" / "episodes.jsonl"
        path.write_text(path.read_text().replace('"length": 9', '"length": 8'))
        assert open_source(root).fingerprint() != before
        path.write_text(path.read_text().replace('"length": 8', '"length": 9'))
    assert open_source(root).fingerprint() == before
    add_statistics(1.0)
    assert open_source(root).fingerprint() != before


@pytest.mark.parametrize("version", ["v2.0", "v3.0"])
def test_statistics_of_a_dataset_stand_for_those_that_its_episodes_lack(tmp_path, version):
    """Files of other actions can be of equal sizes."""
    root = write_lerobot(tmp_path / "toy-arm", version)
    before = open_source(root).fingerprint()
    (root / "meta" / "stats.json").write_text('{"action": {"mean": [0]}}')
    assert open_source(root).fingerprint() != before


def test_the_statistics_are_hashed_once_while_no_file_changes(tmp_path, monkeypatch):
    """A command opens a dataset several times, and a million episodes took minutes each time."""
    root, hashed, own = write_lerobot(tmp_path / "toy-arm", "v3.0"), [], lerobot_meta.hash_file
    monkeypatch.setattr(lerobot_meta, "hash_file", lambda path: hashed.append(path) or own(path))
    found = set()
    for text in ("{}", "{} "):
        (root / "meta" / "stats.json").write_text(text)
        found |= {open_source(root).fingerprint() for _ in range(2)}
    assert len(found) == len(hashed) == 2


def test_what_was_made_of_a_dataset_by_its_former_fingerprint_stays_in_use(tmp_path):
    root = write_lerobot(tmp_path / "toy-arm", "v2.1")
    made = tokenize_dataset(TOP, root, FakeTokenizer(), tmp_path / "store")
    source, path = open_source(root), tmp_path / "store" / "toy_arm" / "manifest.json"
    former = source.former_fingerprint()
    assert former not in (made.source, "")
    path.write_text(path.read_text().replace(made.source, former))
    assert tokenize_dataset(TOP, root, FakeTokenizer(), tmp_path / "store").source == former
    joined = JoinedSource("both", [source, source], "raise", 0)
    assert joined.fingerprint_as(joined.former_fingerprint()) == joined.former_fingerprint() != joined.fingerprint()
    assert joined.fingerprint_as("other") == joined.fingerprint()


def test_more_lost_episodes_than_can_be_named_are_damage_whatever_is_allowed(tmp_path):
    """Each is named, in 8 bytes: `hma data inspect` allows any number, and ended for want of memory."""
    info = write_lerobot(tmp_path / "toy-arm", "v2.1") / "meta" / "info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"total_episodes": 10**9}))
    with pytest.raises(DataError, match="total_episodes in info.json is 1000000000. .*write 2 there"):
        open_source(tmp_path / "toy-arm", corrupt="skip", max_skipped=10**10)


def test_a_draw_of_images_reads_its_own_rows_alone(tmp_path):
    """What is damaged elsewhere in the file, other columns and other episodes, is not met."""
    root = write_lerobot(tmp_path / "toy-arm", "v3.0", camera="image")
    (path,) = (root / "data").rglob("*.parquet")
    pq = pytest.importorskip("pyarrow.parquet")
    pq.write_table(pq.read_table(path), path, row_group_size=3, compression="none")
    data, meta = bytearray(path.read_bytes()), pq.read_metadata(path)
    for g in range(meta.num_row_groups):
        for column in map(meta.row_group(g).column, range(meta.num_columns)):
            name = column.path_in_schema.partition(".list")[0]
            if name == "action" or g >= 4 and name.startswith("observation.images"):
                data[column.dictionary_page_offset or column.data_page_offset] = 0x1D
    path.write_bytes(data)
    source = open_source(root, corrupt="skip")
    assert [number(image) for image in source.frames(0, TOP.image_key, lambda n: [n - 1, 0])] == [11, 0]
    with pytest.raises(EpisodeError, match="file-000.parquet: the table cannot be read"):
        source.frames(1, TOP.image_key, lambda n: [0])
    with pytest.raises(EpisodeError, match="file-000.parquet: the table cannot be read"):
        source.episode(0, TOP.image_key, TOP.action_keys)


def test_robomimic_is_read_where_it_lies(tmp_path):
    path = write_robomimic(tmp_path / "image.hdf5", lengths=(5, 23, 4))
    assert find_format(path) == "robomimic" and source_name(str(path)) == "robomimic_lift"
    for source in (open_source(path), pickle.loads(pickle.dumps(open_source(path)))):
        assert (source.name, source.hz, source.steps().tolist()) == ("robomimic_lift", 20, [5, 23, 4])
        source.check_keys(VIEW.image_key, VIEW.action_keys, VIEW.action_dims)
        for k, steps in enumerate((5, 23, 4)):
            episode = source.episode(k, VIEW.image_key, VIEW.action_keys)
            assert [number(image) for image in episode.images] == [24 * k + t for t in range(steps)]
            np.testing.assert_array_equal(episode.actions, demo_actions(k, steps).astype(np.float32))
            assert episode.success is (k != 1)
            assert all(image.base is None for image in episode.images)  # none keeps those read with it in memory
        backward = source.frames(1, "observation/robot0_eye_in_hand", lambda n: [0, 22, 1])
        assert [number(image) for image in backward] == [46, 24, 45]
    some = open_source(path, "valid")
    assert some.episode(0, VIEW.image_key, ()).steps == 23 and some.ids.tolist() == [open_source(path).ids[1]]


def test_the_frames_of_a_robomimic_record_are_read_block_by_block(tmp_path):
    """Files that were compressed have chunks of a hundred frames: one frame after the other took a hundred times as
    long. A camera that is no camera in one demonstration says so when its frames are asked for."""

    def compress(file):
        for camera in ("agentview", "robot0_eye_in_hand"):
            obs = file["data/demo_10/obs"]
            frames = obs[f"{camera}_image"][()]
            del obs[f"{camera}_image"]
            obs.create_dataset(f"{camera}_image", data=frames, chunks=(20, 32, 32, 3), compression="gzip")
        del obs["robot0_eye_in_hand_image"]
        obs["robot0_eye_in_hand_image"] = frames.astype(np.uint16)
        del file["data/demo_11/obs/robot0_eye_in_hand_image"]

    source = open_source(write_robomimic(tmp_path / "image.hdf5", lengths=(5, 70, 4), change=compress))
    record = source.record(1, keys := ["steps/observation/agentview", "steps/observation/robot0_eye_in_hand"])
    shown, spoilt = (record[key] for key in keys)
    assert [number(frame) for frame in shown] == [24 + t for t in range(70)]
    assert shown.nbytes == 70 * 32 * 32 * 3 and len(spoilt) == 70
    with pytest.raises(EpisodeError, match=r"demo_10/obs/robot0_eye_in_hand_image is uint16 \[70, 32, 32, 3\]"):
        spoilt[0]
    assert source.record(2, keys).keys() == {keys[0]}, "absent, like any other field that it lacks"


def test_the_masks_of_a_robomimic_file_can_say_what_is_held_out(tmp_path):
    def share(file):
        file["mask/half"] = np.array([b"demo_9", b"demo_10"])

    path = write_robomimic(tmp_path / "image.hdf5", lengths=(5, 7, 4), change=share)
    spec = replace(VIEW, split="train+valid", val_split="valid")
    manifest = tokenize_dataset(spec, path, FakeTokenizer(), tmp_path / "store", frame_step=1)
    assert (manifest.train.steps, manifest.val.steps) == ((5, 4), (7,))
    assert open_source(path, "train+valid").ids.tolist() == open_source(path).ids.tolist()
    with pytest.raises(DataError, match="mask/train and mask/half both name 'demo_9'"):
        open_source(path, "train+half")
    with pytest.raises(ConfigError, match="no mask 'test'; it has half, train, valid"):
        open_source(path, "train+test")


def test_what_is_lost_of_a_robomimic_file_does_not_say_where_it_lies(tmp_path):
    """The hash of a token store covers it."""

    def spoil(file):
        del file["data/demo_10/obs"]

    made = []
    for place in ("here", "there"):
        (tmp_path / place).mkdir()
        path = write_robomimic(tmp_path / place / "image.hdf5", lengths=(5, 7, 4, 6), change=spoil)
        made.append(tokenize_dataset(VIEW, path, FakeTokenizer(), tmp_path / place / "store", corrupt="skip"))
    assert made[0].skipped[0].reason.startswith("image.hdf5: data/demo_10/obs/agentview_image is not there")
    assert made[0].hash() == made[1].hash()


def test_pictures_of_a_robomimic_file_that_are_drawn_anew_are_another_source(tmp_path):
    """Of the same states and as many bytes: tokens and conversions of those before were taken for theirs."""

    def redraw(file):
        for demo in file["data"].values():
            demo["obs/agentview_image"][...] = 255 - demo["obs/agentview_image"][...]

    before = write_robomimic(tmp_path / "image.hdf5")
    (tmp_path / "new").mkdir()
    after = write_robomimic(tmp_path / "new" / "image.hdf5", change=redraw)
    assert before.stat().st_size == after.stat().st_size
    assert open_source(before).fingerprint() != open_source(after).fingerprint()
    assert RobomimicSource(before).identity() != RobomimicSource(after).identity()


def test_damage_inside_of_a_robomimic_file_is_named(tmp_path):
    """Of each of its lists of names, whatever h5py then raises; the other demonstrations are still there."""
    path = write_robomimic(tmp_path / "image.hdf5", lengths=(5, 7, 4, 6))
    sound, told, kept = path.read_bytes(), 0, []
    for place in re.finditer(b"HEAP|SNOD", sound):
        path.write_bytes(sound[: place.start()] + b"gone" + sound[place.end() :])
        try:
            source, lost = open_source(path, corrupt="skip"), 0
            assert source.fingerprint()
        except DataError as error:
            told += "image.hdf5 is damaged" in str(error)
            continue
        for i in range(4):
            try:
                source.episode(i, VIEW.image_key, VIEW.action_keys)
            except EpisodeError as error:
                assert "image.hdf5: data/demo_" in str(error)
                lost += 1
        kept.append(lost)
    assert told >= 2 and kept.count(1) >= 4 and max(kept) == 1


def test_actions_that_are_texts_are_damage(tmp_path):
    def spoil(file):
        del file["data/demo_10/actions"]
        file["data/demo_10/actions"] = np.full((7, 7), b"left")

    source = open_source(write_robomimic(tmp_path / "image.hdf5", change=spoil))
    with pytest.raises(EpisodeError, match="demo_10: 'steps/action' contains no numbers, but [|]S4"):
        source.episode(1, VIEW.image_key, VIEW.action_keys)


def test_a_success_that_is_not_said_is_unknown(tmp_path):
    import pyarrow as pa

    def forget(episode, rows):
        rows["next.success"] = pa.array([None] * len(rows["timestamp"]), pa.bool_())

    root = write_lerobot(tmp_path / "toy-arm", "v2.1", change=forget)
    assert open_source(root).episode(0, TOP.image_key, TOP.action_keys).success is None
    texts = {"episode_metadata/success": [b"False"]}
    spec = make_spec("said")
    rlds = write_rlds(tmp_path, spec, [9] * 2, change=lambda _, features: features.update(texts))
    assert open_source(rlds).episode(0, spec.image_key, ()).success is None
    assert [example.success for source in (root, rlds) for example in inspect_dataset(source).examples] == [None] * 4


def as_array_records(directory):
    """The same RLDS directory with ArrayRecord shards, as tfds writes them."""
    from array_record.python.array_record_module import ArrayRecordWriter

    source = RldsDataset(directory)
    out = directory.parent.parent / "records" / "1.0.0"
    shutil.copytree(directory, out, ignore=shutil.ignore_patterns("*tfrecord*"))
    info = json.loads((directory / "dataset_info.json").read_text()) | {"fileFormat": "array_record"}
    (out / "dataset_info.json").write_text(json.dumps(info))
    from data_pipelines.sources.rlds.tfrecord import read_record

    counts, i = [int(n) for n in info["splits"][0]["shardLengths"]], 0
    for k, count in enumerate(counts):
        name = f"{source.name}-train.array_record-{k:05d}-of-{len(counts):05d}"
        writer = ArrayRecordWriter(str(out / name), "group_size:1")
        for _ in range(count):
            writer.write(read_record(*source._locate(i)))
            i += 1
        writer.close()
    return out


@pytest.fixture
def records(tmp_path):
    return as_array_records(write_rlds(tmp_path, make_spec(), [5, 6, 7, 8, 9, 10], shards=2))


def test_array_records_are_read_as_tfrecords_are(tmp_path, records):
    spec = make_spec()
    one, other = RldsDataset(tmp_path / "toy"), open_source(records)
    assert len(other) == 6 and other.runs[1].file == "toy-train.array_record-00001-of-00002"
    for i in (5, 0, 3):
        a, b = (s.episode(i, spec.image_key, spec.action_keys) for s in (one, other))
        assert np.array_equal(a.images, b.images) and np.array_equal(a.actions, b.actions)
        assert np.array_equal(other.frames(i, spec.image_key, lambda n: [n - 1]), [a.images[-1]])
    assert pickle.loads(pickle.dumps(other)).fingerprint() == open_source(records).fingerprint()


def test_damage_in_array_records_is_named(records):
    spec, shard = make_spec(), records / "toy-train.array_record-00001-of-00002"
    data = bytearray(shard.read_bytes())
    open_source(records)
    for at in range(100, len(data) // 2):  # the middle of a record, whichever
        data[at] ^= 0xFF
    shard.write_bytes(data)
    with pytest.raises(DataError, match="00001-of-00002"):
        source = open_source(records)
        for i in range(3, 6):
            source.episode(i, spec.image_key, spec.action_keys)
    shard.unlink()
    with pytest.raises(DataError, match="00001-of-00002: the shard is missing"):
        open_source(records)


def test_a_format_that_is_not_known_is_one_clear_message(records):
    info = json.loads((records / "dataset_info.json").read_text()) | {"fileFormat": "riegeli"}
    (records / "dataset_info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match="only tfrecord and array_record can be read"):
        open_source(records)


@pytest.fixture
def places(tmp_path, records):
    """A dataset of each format, with its entry."""
    made = {
        "lerobot": (TOP, write_lerobot(tmp_path / "toy-arm", "v3.0", lengths=(12, 9, 10, 11))),
        "robomimic": (VIEW, write_robomimic(tmp_path / "image.hdf5", lengths=(5, 7, 4, 6))),
        "rlds": (make_spec(), records),
    }
    assert set(made) == set(FORMATS), "add a dataset of yours here"
    assert [find_format(place) for _, place in made.values()] == list(made)
    return list(made.values())


def test_every_format_is_tokenised_directly(tmp_path, places):
    for spec, place in places:
        tokenize_dataset(spec, place, FakeTokenizer(), tmp_path / "store", frame_step=1)
        tokenize_dataset(spec, str(place), FakeTokenizer(), tmp_path / "again", frame_step=1, threads=1, batch=3)
    store = TokenStore(tmp_path / "store")
    assert store.hash() == TokenStore(tmp_path / "again").hash()
    for spec, place in places:
        source, manifest = open_source(place), store.manifest(spec.name)
        assert (source_name(place), read_rate(place)) == (source.name, source.hz)
        assert sorted((*manifest.train.episodes, *manifest.val.episodes)) == list(range(len(source)))
        for at, i in enumerate(manifest.train.episodes):
            stored, raw = store.episode(spec.name, "train", at), source.episode(i, spec.image_key, spec.action_keys)
            assert stored.episode == i and len(stored.tokens) == raw.steps
            np.testing.assert_array_equal(stored.actions, raw.actions)
    assert not list(tmp_path.rglob("*.jpg"))


def test_every_format_gives_frames_to_a_tokenizer(places):
    frames = [next(make_frame_loader([place], 8, 8, seed=0, tau=3.0, held_out=HeldOut())) for place in places]
    assert all(f.shape == (8, 8, 8, 3) for f in frames) and frames[0].std() > 1
    mixed = list(itertools.islice(make_frame_loader(places, 8, 8, seed=0, threads=3, tau=3.0, held_out=HeldOut()), 4))
    assert np.array_equal(
        mixed,
        list(itertools.islice(make_frame_loader(places, 8, 8, seed=0, threads=0, tau=3.0, held_out=HeldOut()), 4)),
    )


def test_every_format_is_inspected(places):
    for spec, place in places[:2]:
        sample = inspect_dataset(place)
        facts, shown = sample.facts, sample.examples
        assert (facts.name, facts.hz, facts.episodes, facts.sampled) == (spec.name, spec.hz, 4, 4)
        assert spec.image_key in [c.key for c in facts.cameras] and shown[0].instruction
        assert spec.image_key in shown[0].frames and not facts.damaged
        entry = suggest_entry(facts, facts.hz)
        assert (entry.image_key, entry.action_keys, entry.action_dims) == (
            spec.image_key,
            spec.action_keys,
            spec.action_dims,
        )


# --- damage and failure ----------------------------------------------------------------------------


def test_a_damaged_video_loses_its_episode_alone(tmp_path):
    root = write_lerobot(tmp_path / "toy-arm", "v2.1", lengths=(12, 9, 10, 11))
    clip = sorted(root.rglob("*.mp4"))[2]
    clip.write_bytes(clip.read_bytes()[:200])
    with pytest.raises(EpisodeError, match=clip.name):
        tokenize_dataset(TOP, root, FakeTokenizer(), tmp_path / "a", frame_step=1)
    manifest = tokenize_dataset(TOP, root, FakeTokenizer(), tmp_path / "b", frame_step=1, corrupt="skip")
    assert manifest.skipped_count == 1 and 2 not in (*manifest.train.episodes, *manifest.val.episodes)
    clip.unlink()
    write_video(clip, [48 + t for t in range(6)], 10)  # shorter than the table says
    with pytest.raises(EpisodeError, match="no frame at"):
        tokenize_dataset(TOP, root, FakeTokenizer(), tmp_path / "c", frame_step=1)


@pytest.mark.parametrize(
    "box, message",
    [(b"stts", "cannot be decoded"), (b"stsd", "the encoding of its video is not known"), (b"Lavf", None)],
)
def test_a_video_with_a_damaged_index_is_damage_whatever_ffmpeg_calls_it(tmp_path, box, message):
    """It says that an operation is not permitted. A note that is no text does no harm."""
    root = write_lerobot(tmp_path / "toy-arm", "v2.1")
    clip = sorted(root.rglob("*.mp4"))[0]
    clip.write_bytes(b"\xffxyz".join(clip.read_bytes().rsplit(box, 1)))
    source = open_source(root)
    if message is None:
        assert number(source.episode(0, TOP.image_key, ()).images[5]) == 5
    else:
        with pytest.raises(EpisodeError, match=f"{clip.name}: .*{message}"):
            source.episode(0, TOP.image_key, ())


def test_a_video_slower_than_its_rows_is_refused(tmp_path):
    """Row 1, of 0.1 s, was given the frame of 0.2 s, which shows what its action did."""
    root = write_lerobot(tmp_path / "toy-arm", "v2.1")
    clip = sorted(root.rglob("*.mp4"))[0]
    write_video(clip, range(0, 12, 2), 5)
    source = open_source(root)
    for read in (
        lambda: source.episode(0, TOP.image_key, TOP.action_keys),
        lambda: list(LeRobotSource(root).read(0)),
    ):
        with pytest.raises(EpisodeError, match=f"{clip.name}: no frame at 0.1000 s within 0.0501 s"):
            read()
    write_video(clip, range(24), 20)
    assert [number(image) for image in source.episode(0, TOP.image_key, ()).images] == list(range(0, 24, 2))


def test_a_gap_in_a_video_where_no_row_is_does_no_harm(tmp_path):
    """It lowers the frames per second of the file, not those of the rows."""
    root = write_lerobot(tmp_path / "toy-arm", "v2.1")
    write_video(sorted(root.rglob("*.mp4"))[0], range(24), 10, times=[*range(12), *range(32, 44)])
    assert [number(image) for image in open_source(root).episode(0, TOP.image_key, ()).images] == list(range(12))


def test_a_disk_that_fails_is_no_damage_of_a_video(tmp_path, monkeypatch):
    source = open_source(write_lerobot(tmp_path / "toy-arm", "v2.1"), corrupt="skip")
    monkeypatch.setattr(location.time, "sleep", lambda seconds: None)
    av = pytest.importorskip("av")

    def failing(path, *args, **options):
        raise OSError(errno.ESTALE, "Stale file handle", path)

    monkeypatch.setattr(av, "open", failing)
    with pytest.raises(UnreachableError, match="Stale file handle"):
        source.episode(0, TOP.image_key, ())
    monkeypatch.undo()
    assert source.episode(0, TOP.image_key, ()).steps == 12


def test_what_is_no_dataset_is_told_with_what_to_give_instead(tmp_path):
    """It spoke of RLDS only, also to those who have LeRobot or robomimic data."""
    arm = write_lerobot(tmp_path / "toy-arm", "v2.1", lengths=(5,), camera="image")
    (tmp_path / "demos").mkdir()
    lift = write_robomimic(tmp_path / "demos" / "lift.hdf5")
    toy = write_rlds(tmp_path, make_spec(), [5]).parent
    with pytest.raises(DataError, match=f"^{tmp_path}/toy-arn: no such directory.*LeRobot.* Closest: {arm}$"):
        open_source(tmp_path / "toy-arn")
    with pytest.raises(DataError, match=f"^{tmp_path} is no dataset.* Datasets in it: {toy}, {arm}$"):
        open_source(tmp_path)
    with pytest.raises(DataError, match=f"/demos is no dataset.* Datasets in it: {lift}$"):
        open_source(tmp_path / "demos")
    (arm / "meta" / "info.json").unlink()
    with pytest.raises(NoDatasetError, match=f"/toy-arm is no dataset.* copy {arm}/meta/info.json too$"):
        open_source(arm)
    (tmp_path / "file").write_text("")
    with pytest.raises(DataError, match="it is a file, not a directory.*robomimic .hdf5 file.$"):  # not: Closest: file
        open_source(tmp_path / "file")


def test_what_is_no_dataset_is_named(tmp_path):
    with pytest.raises(NoDatasetError, match="no such directory"):
        open_source(tmp_path / "absent")
    (tmp_path / "x.hdf5").write_bytes(b"no file of this kind")
    with pytest.raises(DataError, match="x.hdf5: not a readable HDF5 file"):
        open_source(tmp_path / "x.hdf5")
    arm = write_lerobot(tmp_path / "toy-arm", "v2.1")
    with pytest.raises(ConfigError, match="no split 'test'.* or in the dataset's registry entry\\.$"):
        open_source(arm, "test")
    with pytest.raises(ConfigError, match=r"no split 'train\[:4\]'.* give 'train', .* --set store\.max_train=N\.$"):
        open_source(arm, "train[:4]")


def test_a_token_store_is_no_dataset_and_told_as_such(tmp_path):
    """It was called a directory of foreign files."""
    own = tmp_path / "tokens" / "toy"
    own.mkdir(parents=True)
    (own / MANIFEST).write_text("{}")
    for place in (own, own.parent):
        with pytest.raises(NoDatasetError, match=rf"^{place}: a token store, not recordings\. .* docs/own_data\.md"):
            open_source(place)
    arm = write_lerobot(tmp_path / "toy-arm", "v2.1")
    (tmp_path / "page").mkdir()
    (tmp_path / "page" / MANIFEST).write_text("{}")  # of some other program
    with pytest.raises(NoDatasetError, match=rf" Datasets in it: {arm}$"):
        open_source(tmp_path)


def test_corrupt_records_are_episode_errors():
    assert issubclass(CorruptRecordError, EpisodeError) and not issubclass(UnreachableError, EpisodeError)
