"""The written LeRobot datasets: read back, by statistics computed anew, resumed, refused."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.export.fields import choose_fields
from data_pipelines.export.lerobot import FRAME_BYTES, ORIGIN, Exported, export_lerobot
from data_pipelines.sources.lerobot_dataset import LeRobotDataset
from data_pipelines.sources.open import open_source
from data_pipelines.sources.rlds.features import FlatFeature
from data_pipelines.sources.source import action_fields
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import (
    FPS,
    HEIGHT,
    WIDTH,
    lerobot_actions,
    number,
    write_lerobot,
    write_robomimic,
)
from tests.data_pipelines.fakes import make_spec, png, write_rlds


def export(source, out, **options) -> Exported:
    return export_lerobot(source, choose_fields(source), out, source.hz or FPS, **options)


def one_per_file(source, out, **options) -> Exported:
    return export(source, out, file_bytes=1, **options)


@pytest.mark.parametrize("file_bytes", [1, 2**30])
def test_what_was_recorded_is_read_back(tmp_path, file_bytes):
    source = open_source(write_lerobot(tmp_path / "toy", "v2.1"))
    assert export(source, tmp_path / "new", file_bytes=file_bytes) == Exported(2, 21, 0)
    new = LeRobotDataset(tmp_path / "new")
    assert (new.version, new.hz, new.files) == ("v3.0", FPS, 4 if file_bytes == 1 else 2)
    keys = ["steps/observation/state", "steps/language_instruction", "steps/reward"]
    for e, steps in enumerate((12, 9)):
        episode = new.episode(e, "observation/top", ("action",))
        assert [number(image) for image in episode.images] == [24 * e + t for t in range(steps)]
        np.testing.assert_array_equal(episode.actions, lerobot_actions(e, steps))
        assert episode.success is (e == 0)
        for key, value in source.record(e, keys).items():
            np.testing.assert_array_equal(np.asarray(value), np.asarray(new.record(e, [key])[key]))


def test_statistics_are_those_of_the_rows_and_frames(tmp_path):
    source = open_source(write_lerobot(tmp_path / "toy", "v2.1"))
    one_per_file(source, tmp_path / "new")
    actions = np.concatenate([lerobot_actions(e, steps) for e, steps in enumerate((12, 9))]).astype(np.float64)
    images = np.concatenate([source.episode(e, "observation/top", ()).images for e in range(2)]) / 255
    found = json.loads((tmp_path / "new" / "meta" / "stats.json").read_text())
    for rows, of in ((actions, found["action"]), (images.reshape(-1, 3), found["observation.images.top"])):
        for name in ("min", "max", "mean", "std"):
            np.testing.assert_allclose(np.ravel(of[name]), getattr(rows, name)(axis=0), rtol=1e-6)
    assert np.shape(found["observation.images.top"]["mean"]) == (3, 1, 1)
    assert found["action"]["count"] == found["observation.images.top"]["count"] == [21]
    np.testing.assert_allclose(found["action"]["q90"], np.quantile(actions, 0.9, axis=0))
    table = pq.read_table(tmp_path / "new" / "meta" / "episodes" / "chunk-000" / "file-001.parquet").to_pylist()
    (row,) = table
    np.testing.assert_allclose(row["stats/action/mean"], lerobot_actions(1, 9).mean(0))
    assert (row["dataset_from_index"], row["dataset_to_index"], row["length"]) == (12, 21, 9)


def test_an_interrupted_export_continues_and_gives_the_same_tables(tmp_path):
    source = open_source(write_lerobot(tmp_path / "toy", "v2.1", lengths=(5, 4, 3)))
    one_per_file(source, tmp_path / "whole")

    def stop(done: int, total: int, note: str) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        one_per_file(source, tmp_path / "new", progress=stop)
    assert not (tmp_path / "new").exists()
    (partial,) = tmp_path.glob(".new.*.partial")
    (partial / "meta" / "episodes" / ".file-002.parquet.0123abcd.tmp").touch()  # as a killed process leaves one
    read = []
    assert one_per_file(source, tmp_path / "new", progress=lambda done, *_: read.append(done)) == Exported(3, 12, 0)
    assert read == [3]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["new", "toy", "whole"]
    assert not list((tmp_path / "new").rglob(".*"))
    for path in sorted((tmp_path / "whole").rglob("*.*")):
        if path.is_file() and path.suffix != ".mp4":
            assert path.read_bytes() == (tmp_path / "new" / path.relative_to(tmp_path / "whole")).read_bytes()


def test_what_was_begun_with_other_settings_goes_once_the_dataset_is_there(tmp_path):
    source = open_source(write_rlds(tmp_path, make_spec(), [3, 3]))

    def stop(done: int, total: int, note: str) -> None:
        raise KeyboardInterrupt

    for name, options in (("new", {}), ("new.b", {}), ("new", {"file_bytes": 1})):
        with pytest.raises(KeyboardInterrupt):
            export(source, tmp_path / name, progress=stop, **options)
    assert len(list(tmp_path.glob(".new.*.partial"))) == 3
    export(source, tmp_path / "new")
    (other,) = tmp_path.glob(".new.*.partial")
    assert other.name.startswith(".new.b.")


@pytest.mark.parametrize("hz", [0, -2, float("nan"), float("inf")])
def test_what_is_no_rate_is_refused(tmp_path, hz):
    source = open_source(write_rlds(tmp_path, make_spec(), [3]))
    with pytest.raises(ConfigError, match="frames per second must be positive and finite"):
        export_lerobot(source, choose_fields(source), tmp_path / "new", hz)


def test_that_pyav_is_lacking_is_said_before_anything_is_read_or_written(tmp_path, monkeypatch):
    source = open_source(write_rlds(tmp_path, make_spec(), [3]))
    monkeypatch.setitem(sys.modules, "av", None)
    monkeypatch.setattr(type(source), "record", lambda *_: pytest.fail("an episode was read"))
    with pytest.raises(ConfigError, match="writing videos needs the package 'av'"):
        export(source, tmp_path / "new")
    assert [p.name for p in tmp_path.iterdir()] == ["toy"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"steps/reward": np.array([0, np.nan, 1], np.float32)}, "no finite reward for each of its 3 steps"),
        ({"steps/observation/image": []}, "episode 1: it has no frames"),
    ],
    ids=["reward", "frames"],
)
def test_an_episode_that_policies_cannot_be_trained_on_is_damaged(tmp_path, change, message):
    """LeRobot cannot load statistics that are not numbers."""
    place = write_rlds(
        tmp_path, make_spec(), [3, 3], change=lambda e, features: features.update(change) if e else None,
        rewards=lambda e: [0, 0, 1],
    )  # fmt: skip
    with pytest.raises(EpisodeError, match=message):
        export(open_source(place), tmp_path / "new")
    assert export(open_source(place, corrupt="skip"), tmp_path / "new") == Exported(1, 3, 1)


def test_a_file_of_small_frames_has_not_more_of_them_than_one_of_larger_ones(tmp_path):
    """A killed export would lose hours of work on them."""
    source = open_source(write_rlds(tmp_path, make_spec(), [3, 3]))
    export(source, tmp_path / "new", file_bytes=3 * FRAME_BYTES)
    assert len(list((tmp_path / "new" / "data").rglob("*.parquet"))) == 2


def test_integers_are_written_exactly(tmp_path):
    """Clocks, for example: as float32 all steps were equal. An action stays float32, which policies need."""
    clock = 10**15 + np.arange(5)

    def change(file):
        demo = file["data/demo_9"]
        del demo["actions"]
        demo["obs/clock"], demo["obs/ticks"], demo["actions"] = (
            clock,
            np.stack([clock, -clock], 1),
            np.ones((5, 2), int),
        )

    source = open_source(write_robomimic(tmp_path / "image.hdf5", lengths=(5,), change=change))
    export(source, tmp_path / "new")
    table = pq.read_table(tmp_path / "new" / "data" / "chunk-000" / "file-000.parquet")
    assert table["observation.clock"].to_pylist() == clock.tolist()
    assert table["observation.ticks"].to_pylist() == [[t, -t] for t in clock.tolist()]
    features = json.loads((tmp_path / "new" / "meta" / "info.json").read_text())["features"]
    names = ("observation.clock", "action", "observation.robot0_eef_pos")
    assert [features[name]["dtype"] for name in names] == ["int64", "float32", "float32"]
    assert LeRobotDataset(tmp_path / "new").features["steps/observation/ticks"].size == 2


def test_texts_that_change_within_an_episode_are_tasks(tmp_path):
    def change(e: int, features: dict) -> None:
        features["steps/language_instruction"] = [b"push", b"push", b"lift"] if e else [b"lift"] * 3

    source = open_source(write_rlds(tmp_path, make_spec(), [3, 3], change=change))
    export(source, tmp_path / "new")
    new = LeRobotDataset(tmp_path / "new")
    assert new.record(0, ["steps/language_instruction"])["steps/language_instruction"] == [b"lift"] * 3
    assert new.record(1, ["steps/language_instruction"])["steps/language_instruction"] == [b"push", b"push", b"lift"]
    tasks = pq.read_table(tmp_path / "new" / "meta" / "tasks.parquet")
    assert tasks.to_pydict() == {"task_index": [0, 1], "task": ["lift", "push"]}
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_a_damaged_episode_stops_the_export_or_is_left_out(tmp_path):
    def change(e: int, features: dict) -> None:
        if e == 1:
            features["steps/observation/image"][2] = b"no image"

    place = write_rlds(tmp_path, make_spec(), [4, 4, 4], change=change)
    with pytest.raises(EpisodeError, match="toy, episode 1: step 2 of 'observation.images.image'"):
        export(open_source(place), tmp_path / "new")
    assert export(open_source(place, corrupt="skip"), tmp_path / "new") == Exported(2, 8, 1)
    assert [LeRobotDataset(tmp_path / "new").record(e, ["steps/action"])["steps/action"][0] for e in (0, 1)] == [0, 2]
    assert json.loads((tmp_path / "new" / ORIGIN).read_text())["left_out"] == 1


def test_episodes_that_were_left_out_before_an_interruption_count(tmp_path):
    """With the limit reached, the same command again got further."""

    def change(e: int, features: dict) -> None:
        if e in (1, 3, 5):
            features["steps/action"][0] = np.nan

    place = write_rlds(tmp_path, make_spec(), [2] * 7, change=change)
    for _ in range(3):
        with pytest.raises(DataError, match="3 episodes cannot be used, more than max_skipped=2"):
            one_per_file(open_source(place, corrupt="skip", max_skipped=2), tmp_path / "new")
    with pytest.raises(EpisodeError, match="toy, episode 1: it was left out before"):
        one_per_file(open_source(place), tmp_path / "new")
    assert one_per_file(open_source(place, corrupt="skip"), tmp_path / "new") == Exported(4, 8, 3)


def test_frames_of_two_sizes_are_refused(tmp_path):
    def change(e: int, features: dict) -> None:
        if e == 1:
            features["steps/observation/image"] = [png(np.zeros((4, 8, 3), np.uint8))] * 3

    source = open_source(write_rlds(tmp_path, make_spec(), [3, 3], change=change))
    with pytest.raises(EpisodeError, match=r"two sizes \(8 x 8 and 4 x 8\), but a LeRobot video has one"):
        export(source, tmp_path / "new")


def test_frames_of_odd_sizes_are_written(tmp_path):
    def change(e: int, features: dict) -> None:
        features["steps/observation/image"] = [png(np.full((7, 9, 3), 100, np.uint8))] * 3

    export(open_source(write_rlds(tmp_path, make_spec(), [3], change=change)), tmp_path / "new")
    (first, *_) = LeRobotDataset(tmp_path / "new").episode(0, "observation/image", ()).images
    assert first.shape == (7, 9, 3) and abs(int(first.mean()) - 100) < 3


def test_an_existing_directory_is_returned_or_refused(tmp_path):
    source = open_source(write_rlds(tmp_path, make_spec(), [3, 3]))
    done = export(source, tmp_path / "new")
    assert export(source, tmp_path / "new") == done
    with pytest.raises(ConfigError, match="was made from another dataset or with other settings"):
        one_per_file(source, tmp_path / "new")
    with pytest.raises(ConfigError, match="was not made by this command"):
        export(source, tmp_path / "toy")


def test_a_dataset_of_other_fields_of_another_rate_or_of_other_recordings_is_refused(tmp_path):
    source, longer = (open_source(write_rlds(tmp_path / str(last), make_spec(), [3, last])) for last in (3, 4))
    fields, new = choose_fields(source), tmp_path / "new"
    export_lerobot(source, fields, new, 2.0)
    renamed = replace(fields, cameras={f"{camera}_2": key for camera, key in fields.cameras.items()})
    fewer = choose_fields(source, ["action[:1]"])
    for other in ((source, fewer, new, 2.0), (source, renamed, new, 2.0), (source, fields, new, 3.0),
                  (longer, fields, new, 2.0)):  # fmt: skip
        with pytest.raises(ConfigError, match="was made from another dataset or with other settings"):
            export_lerobot(*other)


def test_a_source_without_a_readable_episode_is_refused(tmp_path):
    def change(e: int, features: dict) -> None:
        features["steps/observation/image"] = [b"no image"] * 3

    source = open_source(write_rlds(tmp_path, make_spec(), [3], change=change), corrupt="skip")
    with pytest.raises(DataError, match="no episode can be written"):
        export(source, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_fields_are_chosen_by_name_or_as_asked_for(tmp_path):
    plain = choose_fields(open_source(write_lerobot(tmp_path / "toy", "v2.1")))
    assert plain.cameras == {"observation.images.top": "steps/observation/top"}
    assert plain.vectors == {"action": ("steps/action",), "observation.state": ("steps/observation/state",)}
    assert plain.names["action"] == ("action_0", "action_1", "action_2")
    parts = open_source(write_rlds(tmp_path, make_spec(dims=(2, 1)), [3]))
    assert choose_fields(parts).vectors == {"action": ("steps/action/part_0", "steps/action/part_1")}
    assert choose_fields(parts).names == {"action": ("part_0_0", "part_0_1", "part_1")}
    asked = choose_fields(parts, ["action/part_0[1:]"], ["action/part_1"])
    assert asked.vectors == {"action": ("steps/action/part_0[1:]",), "observation.state": ("steps/action/part_1",)}
    assert asked.names == {"action": ("part_0_1",), "observation.state": ("part_1",)}
    with pytest.raises(ConfigError, match="no numeric field 'steps/action/part_2'"):
        choose_fields(parts, ["action/part_2"])


def test_what_players_need_to_know_is_in_info(tmp_path):
    export(open_source(write_lerobot(tmp_path / "toy", "v2.1")), tmp_path / "new")
    info = json.loads((tmp_path / "new" / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"], info["fps"]) == (2, 21, 2, FPS)
    camera = info["features"]["observation.images.top"]
    assert camera["shape"] == [HEIGHT, WIDTH, 3] and camera["info"]["video.pix_fmt"] == "yuv420p"
    assert {name: f["dtype"] for name, f in info["features"].items() if f["dtype"] not in ("float32", "int64")} == {
        "next.done": "bool",
        "next.success": "bool",
        "observation.images.top": "video",
    }


def test_two_cameras_that_would_have_one_name_are_refused(tmp_path):
    image, place = FlatFeature(image=True, size=0, dtype="uint8"), tmp_path / "toy"
    features = {"steps/observation/left/rgb": image, "steps/observation/left_rgb": image}
    with pytest.raises(ConfigError, match="would both be called 'observation.images.left_rgb'"):
        choose_fields(SimpleNamespace(features=features, location=place))


def test_flags_of_an_end_are_fields_of_their_own_beside_the_action(tmp_path):
    number = {name: FlatFeature(image=False, size=size) for name, size in (("arm", 2), ("terminate_episode", 3))}
    features = {"steps/observation/image": FlatFeature(image=True, size=0, dtype="uint8")}
    features |= {f"steps/action/{name}": feature for name, feature in number.items()}
    source = SimpleNamespace(features=features, location=tmp_path, check_keys=lambda *keys: None)
    flag = "terminate_episode"
    assert choose_fields(source).vectors == {
        "action": ("steps/action/arm",),
        f"action.{flag}": (f"steps/action/{flag}",),
    }
    assert choose_fields(source).names["action"] == ("arm_0", "arm_1")


@pytest.mark.parametrize(
    "keys, chosen",
    [
        (["action/arm", "actions", "action"], ["action"]),
        (["action/arm", "actions"], ["actions"]),
        (["action_dict/arm", "action/hand", "action/arm", "action/is_last"], ["action/hand", "action/arm"]),
        (["action_dict/arm", "observation/action/arm"], []),
    ],
)
def test_an_action_is_known_by_its_name(keys, chosen):
    assert action_fields(keys) == chosen
