"""LeRobot directories of three versions, with videos and with images: alignment, texts, refusals."""

from __future__ import annotations

import json

import numpy as np
import pytest

from data_pipelines.convert.write import convert
from data_pipelines.errors import DataError
from data_pipelines.sources.lerobot import LeRobotSource
from data_pipelines.sources.settings import LeRobotSettings
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import (
    CAMERA,
    FPS,
    lerobot_actions,
    number,
    read_back,
    write_lerobot,
    write_video,
)


@pytest.mark.parametrize("camera", ["video", "image"])
@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_rows_frames_and_texts_stay_together(tmp_path, version, camera):
    source = LeRobotSource(write_lerobot(tmp_path / "toy", version, camera=camera))
    done = convert(source, tmp_path, "arm")
    assert done.spec.hz == FPS and done.spec.image_key == "observation/top" and done.spec.action_dims == (3,)
    dataset, episodes = read_back(done.directory, "observation/top")
    assert [e.success for e in episodes] == [True, False]
    for e, (steps, episode) in enumerate(zip((12, 9), episodes, strict=True)):
        assert [number(image) for image in episode.images] == [24 * e + t for t in range(steps)]
        np.testing.assert_array_equal(episode.actions, lerobot_actions(e, steps))
        record = dataset.record(e)
        assert record["steps/language_instruction"] == [[b"push", b"stack"][e]] * steps
        assert record["steps/observation/state"].reshape(steps, 2).tolist() == [[e, t] for t in range(steps)]
        assert record["steps/reward"].tolist() == [0] * (steps - 1) + [1]


def test_a_camera_and_a_size_can_be_chosen(tmp_path):
    root = write_lerobot(tmp_path / "toy", "v3.0")
    for camera in ("top", CAMERA):
        source = LeRobotSource(root, LeRobotSettings((camera,), short_side=18))
        assert list(source.layout.images) == ["observation/top"]
    assert next(source.read(1)).images["observation/top"] and source.units == ["episode 0", "episode 1"]
    _, episodes = read_back(convert(source, tmp_path, "arm").directory, "observation/top")
    assert episodes[0].images[0].shape == (18, 32, 3)
    with pytest.raises(ConfigError, match="no camera 'wrist'; it has top"):
        LeRobotSource(root, LeRobotSettings(("wrist",)))


@pytest.mark.parametrize("change", [("tasks.jsonl", "push", "pull"), ("episodes.jsonl", "stack", "pack")])
def test_a_dataset_whose_meta_folder_was_changed_is_another_source(tmp_path, change):
    root, (name, old, new) = write_lerobot(tmp_path / "toy", "v2.1"), change
    convert(LeRobotSource(root), tmp_path, "arm")
    path = root / "meta" / name
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(ConfigError, match="was made from another source"):
        convert(LeRobotSource(root), tmp_path, "arm")


def late(e, rows):
    import pyarrow as pa

    if e == 1:
        rows["timestamp"] = pa.array((np.arange(9) / FPS + (np.arange(9) > 4) * 0.3).astype(np.float32))


def unknown_task(e, rows):
    import pyarrow as pa

    rows["task_index"] = pa.array([7] * len(rows["task_index"]))


def listed_task(e, rows):
    import pyarrow as pa

    rows["task_index"] = pa.array([[0]] * len(rows["task_index"]))


def worded_time(e, rows):
    import pyarrow as pa

    rows["timestamp"] = pa.array(["noon"] * len(rows["timestamp"]))


def not_numbers(e, rows):
    import pyarrow as pa

    rows["action"] = pa.array([None] * len(rows["task_index"]), pa.list_(pa.float32()))


def no_bytes(e, rows):
    import pyarrow as pa

    rows[CAMERA] = pa.array([{"bytes": b"", "path": None}] * len(rows["task_index"]))


@pytest.mark.parametrize(
    "change, camera, message",
    [
        (late, "video", r"episode 1: timestamp 0.8000 s at row 5, but at 10 frames per second it should be 0.5000 s"),
        (unknown_task, "video", "episode 0: task_index 7 at row 0 is not among the tasks"),
        (listed_task, "image", "episode 0: task_index a list of 1 at row 0 is not among the tasks"),
        (worded_time, "image", "episode 0: 'timestamp' is not one array of numbers per row .*noon"),
        (
            not_numbers,
            "video",
            "episode 0: 'action' is not one array of numbers per row|'action' has the shape",
        ),
        (no_bytes, "image", f"episode 0: '{CAMERA}' at row 0 contains neither bytes nor a path"),
        (lambda e, rows: rows.pop("action"), "video", "no column 'action'"),
    ],
)
@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_malformed_tables_are_named_to_row_and_field(tmp_path, version, change, camera, message):
    source = LeRobotSource(write_lerobot(tmp_path / "toy", version, camera=camera, change=change))
    with pytest.raises(DataError, match=message):
        convert(source, tmp_path, "arm")


def test_a_name_of_thousands_of_letters_does_not_fill_the_message(tmp_path):
    root = write_lerobot(tmp_path / "toy", "v3.0")
    info = json.loads((root / "meta" / "info.json").read_text())
    info["features"]["x" * 5000] = {"dtype": "video", "shape": [8, 8, 3], "names": None}
    (root / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match="no column 'videos/xxx") as raised:
        LeRobotSource(root)
    assert len(str(raised.value)) < 1000


def test_a_video_that_ends_too_early_or_is_none_is_named(tmp_path):
    root = write_lerobot(tmp_path / "toy", "v3.0")
    path = next(root.rglob("*.mp4"))
    write_video(path, list(range(12)), FPS)
    with pytest.raises(DataError, match=r"file-000.mp4: no frame at 1.2000 s within 0.0501 s: the nearest is at 1.1"):
        convert(LeRobotSource(root), tmp_path, "arm")
    path.write_bytes(b"no video")
    with pytest.raises(DataError, match="file-000.mp4: not a readable video"):
        convert(LeRobotSource(root), tmp_path, "arm")
    done = pytest.raises(DataError, convert, LeRobotSource(root), tmp_path, "arm", skip_damaged=True)
    assert "no episode can be made from it: 2 x" in str(done.value)


def test_length_and_rows_must_agree(tmp_path):
    root = write_lerobot(tmp_path / "toy", "v2.1")
    lines = (root / "meta/episodes.jsonl").read_text().replace('"length": 9', '"length": 8')
    (root / "meta/episodes.jsonl").write_text(lines)
    with pytest.raises(DataError, match="episode 1 has 9 rows, but the meta folder says 8"):
        convert(LeRobotSource(root), tmp_path, "arm")


@pytest.mark.parametrize(
    "change, message",
    [
        ({"codebase_version": "v1.6"}, "codebase_version is 'v1.6'; only v2.0, v2.1, v3.0 can be read"),
        ({"fps": None}, "no 'fps'"),
        ({"splits": {"train": "0:1"}}, "splits has '0:1' as 'train', not all episodes from 0 to 1, but .* on all"),
        ({"splits": {"train": "1:2"}}, "splits has '1:2' as 'train'"),
        ({"splits": {"train": [0, 1]}}, "splits has a list of 2 as 'train'"),
        ({"splits": {"train": "0:1", "test": "1:2"}}, "splits is 'train', 'test', but .* to train on all"),
        ({"total_episodes": 3}, "it lists 2 episodes, without episode 2"),
        ({"video_path": None}, "'video_path' is missing"),
        (
            {"features": {"action": {"dtype": "float32", "shape": [2]}}},
            "no feature is a video or an image of 3 channels.$",
        ),
        (
            {"features": {"top": {"dtype": "video", "shape": [8, 8, 1]}}},
            "3 channels .it has 'top': 8x8x1; write grey images",
        ),
    ],
)
def test_info_of_another_kind_is_named(tmp_path, change, message):
    root = write_lerobot(tmp_path / "toy", "v2.1")
    info = json.loads((root / "meta/info.json").read_text()) | change
    (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match=message):
        LeRobotSource(root)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
@pytest.mark.parametrize("field", ["data_path", "video_path"])
@pytest.mark.parametrize(
    "path", ["../{episode_index}", "/etc/{file_index}", "data/../../x", "{video_key.__class__}", "{0}",
             "{chunk_index:>9999999999}", "{episode_index!r}", "a\\b", "x" * 2000],
)  # fmt: skip
def test_files_stay_below_the_root(tmp_path, version, field, path):
    root = write_lerobot(tmp_path / "toy", version)
    info = json.loads((root / "meta/info.json").read_text()) | {field: path}
    (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match=rf"meta/info.json: {field} .* cannot be filled in"):
        LeRobotSource(root)


def test_image_stays_below_the_root(tmp_path):
    import pyarrow as pa

    (tmp_path / "secret.png").write_bytes(b"secret")

    def outside(e, rows):
        rows[CAMERA] = pa.array([{"bytes": None, "path": "../secret.png"}] * len(rows["task_index"]))

    source = LeRobotSource(write_lerobot(tmp_path / "toy", "v2.1", camera="image", change=outside))
    with pytest.raises(DataError, match="at row 0: '../secret.png' leaves the dataset's directory"):
        convert(source, tmp_path, "arm")


@pytest.mark.parametrize(
    "change",
    [
        {"fps": "fast"}, {"fps": float("inf")}, {"features": [1]}, {"features": {"action": 7}},
        {"features": {"action": {"dtype": "float32"}}}, {"features": {"a": {"dtype": "x", "shape": [2**40, 2**40]}}},
        {"data_path": 7}, {"chunks_size": -1}, {"chunks_size": "x"}, {"total_episodes": "2"},
    ],
)  # fmt: skip
def test_info_of_the_wrong_kind_is_named(tmp_path, change):
    root = write_lerobot(tmp_path / "toy", "v2.1")
    info = json.loads((root / "meta/info.json").read_text()) | change
    (root / "meta/info.json").write_text(json.dumps(info))
    with pytest.raises(DataError, match="meta/info.json.* Download the dataset again"):
        LeRobotSource(root)


@pytest.mark.parametrize("line", ["[1]", "7", "{}", '{"episode_index": "1e999", "length": 3}', '{"episode_index": -1}'])
def test_line_that_describes_no_episode_is_named(tmp_path, line):
    root = write_lerobot(tmp_path / "toy", "v2.1")
    with open(root / "meta/episodes.jsonl", "a") as file:
        file.write(f"\n{line}\n")
    with pytest.raises(DataError, match="episodes.jsonl: line 4"):
        LeRobotSource(root)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_an_episode_that_is_listed_twice_is_named(tmp_path, version):
    """As after a recording that was taken up again: "list each file once" was the advice."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    root = write_lerobot(tmp_path / "toy", version)
    lines, table = root / "meta/episodes.jsonl", root / "meta/episodes/chunk-000/file-000.parquet"
    if version == "v2.1":
        lines.write_text(lines.read_text() * 2)
    else:
        pq.write_table(pa.concat_tables([pq.read_table(table)] * 2), table)
    with pytest.raises(DataError, match="toy/meta: episode 0 is listed twice.* Remove one"):
        LeRobotSource(root)


@pytest.mark.parametrize("other", ["observation.images.left.wrist", "observation.left_wrist"])
def test_two_features_of_one_name_are_refused(tmp_path, other):
    """A camera beside a camera, and beside numbers: one would hide the other."""
    root = write_lerobot(tmp_path / "toy", "v2.1", camera="image")
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    image = info["features"]["observation.images.top"]
    numbers = info["features"]["observation.state"]
    info["features"]["observation.images.left_wrist"] = image
    info["features"][other] = image if "images" in other else numbers
    path.write_text(json.dumps(info))
    with pytest.raises(DataError, match=f"left_wrist' and '{other}' would both be called 'observation/left_wrist'"):
        LeRobotSource(root)


def test_a_directory_that_is_none_is_refused(tmp_path):
    with pytest.raises(DataError, match="info.json is missing: give the root of a LeRobot dataset"):
        LeRobotSource(tmp_path)
