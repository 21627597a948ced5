"""LeRobot datasets where they lie: names, fields, fingerprints, and videos and tables that are damaged."""

from __future__ import annotations

import errno
import json
import os
import pickle
import shutil
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.convert.write import convert, suggest_spec
from data_pipelines.errors import DataError, EpisodeError, UnreachableError
from data_pipelines.inspection.inspect import inspect_dataset
from data_pipelines.inspection.suggest import suggest_entry
from data_pipelines.registry import DatasetSpec
from data_pipelines.sources import lerobot_dataset, lerobot_meta
from data_pipelines.sources.joined import JoinedSource
from data_pipelines.sources.lerobot import LeRobotSource
from data_pipelines.sources.open import find_format, open_source, read_rate, source_name
from data_pipelines.sources.rlds import location
from data_pipelines.sources.video import open_video
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import CAMERA, lerobot_actions, number, write_lerobot, write_video
from tests.data_pipelines.fakes import FakeTokenizer
from tests.data_pipelines.tokenizing import tokenize_dataset

TOP = DatasetSpec("toy_arm", "observation/top", ("action",), (3,), 10)


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


def test_a_text_changes_one_fingerprint_alone(tmp_path):
    def prints(word: str) -> list[str]:
        root = write_lerobot(tmp_path / word / "toy-arm", "v2.1")
        tasks = root / "meta" / "tasks.jsonl"
        tasks.write_text(tasks.read_text().replace("push", word))
        source = open_source(root)
        joined = JoinedSource("both", [source, source], "raise", 0)
        return [s for one in (source, joined) for s in (one.fingerprint(), one.fingerprint_with_texts())]

    assert [a == b for a, b in zip(prints("push"), prints("pull"), strict=True)] == [True, False] * 2


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
