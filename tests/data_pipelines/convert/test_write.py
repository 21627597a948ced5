"""The writer: restartable, atomic, and exact about what it refuses."""

from __future__ import annotations

import errno
import json
import re
import runpy
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.convert.write import convert
from data_pipelines.errors import DataError
from data_pipelines.inspection.inspect import inspect_dataset
from data_pipelines.publishing.files import publish
from data_pipelines.sources import robomimic, video
from data_pipelines.sources.convertible import Episode, Layout, Skipped, UnitError, require_module
from data_pipelines.sources.human import detections
from data_pipelines.sources.rlds.writer import encode_jpeg, image_field
from hma_jax.config import ConfigError
from tests.data_pipelines.convert.sources import number, picture, read_back
from tests.files import contents

PAGE = Path(__file__).parents[3] / "docs" / "own_data.md"


@dataclass
class Counting:
    """Unit u holds u % 3 episodes of u + 2 steps."""

    units: list[str] = field(default_factory=lambda: [f"u{u}" for u in range(8)])
    salt: int = 0
    stop_at: int | None = None
    damaged: tuple[int, ...] = ()
    change: object = None
    layout = Layout({"observation/image": image_field(8, 8)}, {"action": 2}, knows_success=True)
    hz = 5.0
    description = "counting"

    def identity(self):
        return {"salt": self.salt}

    def read(self, unit):
        if unit == self.stop_at:
            raise KeyboardInterrupt
        if unit in self.damaged:
            raise UnitError(f"{self.units[unit]} is damaged")
        for e in range(unit % 3):
            steps = unit + 2
            parts = dict(
                origin=f"{self.units[unit]}/{e}",
                images={"observation/image": [encode_jpeg(picture(unit, 8, 8))] * steps},
                vectors={"action": np.full((steps, 2), unit, np.float32)},
                instructions=["count"] * steps,
                rewards=np.arange(steps),
                success=unit % 2 == 0,
            )
            if self.change is not None:
                self.change(parts)
            yield Episode(**parts)
        if unit % 3 == 0:
            yield Skipped("nothing in it")


def test_every_episode_is_written_once_in_order_with_its_facts(tmp_path):
    seen = []
    done = convert(Counting(), tmp_path, "toy", progress=lambda *a: seen.append(a))
    assert (done.episodes, done.shards, done.skipped) == (7, 1, {"nothing in it": 3})
    assert done.directory == tmp_path / "toy" / "1.0.0"
    assert done.spec.action_keys == ("action",) and done.spec.action_dims == (2,) and done.spec.hz == 5
    assert seen[-1] == (8, 8, "u7") and len(seen) == 8
    dataset, episodes = read_back(done.directory, "observation/image")
    assert [number(e.images[0]) for e in episodes] == [1, 2, 2, 4, 5, 5, 7]
    assert [e.steps for e in episodes] == [3, 4, 4, 6, 7, 7, 9]
    assert [e.success for e in episodes] == [False, True, True, True, False, False, False]
    record = dataset.record(0)
    assert record["episode_metadata/file_path"] == [b"u1/0"]
    assert record["steps/reward"].tolist() == [0, 1, 2]
    metadata = json.loads((done.directory / "metadata.json").read_text())
    assert metadata["hz"] == dataset.hz == 5 and metadata["left_out"] == {"nothing in it": 3}
    assert sorted(p.name for p in (tmp_path / "toy").iterdir()) == ["1.0.0"]


@pytest.mark.parametrize("stop", range(1, 8))
def test_interrupted_anywhere_it_goes_on_and_ends_with_the_same_bytes(tmp_path, stop):
    whole = convert(Counting(), tmp_path / "a", "toy", shard_bytes=1)
    assert whole.shards == 5  # a shard for each unit that holds anything
    with pytest.raises(KeyboardInterrupt):
        convert(Counting(stop_at=stop), tmp_path / "b", "toy", shard_bytes=1)
    assert not (tmp_path / "b/toy/1.0.0").exists()
    (partial,) = (tmp_path / "b/toy").iterdir()
    with open(partial / "journal.jsonl", "a") as journal:
        journal.write('{"units": 7, "rec')  # cut off by a crash
    read = []

    class Watched(Counting):
        def read(self, unit):
            read.append(unit)
            return super().read(unit)

    again = convert(Watched(), tmp_path / "b", "toy", shard_bytes=1)
    assert again.episodes == 7 and read[0] >= stop - 1 - (stop % 3 == 1)
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_stopped_between_the_last_shard_and_the_end(tmp_path, monkeypatch):
    whole = convert(Counting(), tmp_path / "a", "toy", shard_bytes=1)
    with monkeypatch.context() as patched:

        def die(*args, **kwargs):
            raise KeyboardInterrupt

        patched.setattr("data_pipelines.convert.write.write_info", die)
        with pytest.raises(KeyboardInterrupt):
            convert(Counting(), tmp_path / "b", "toy", shard_bytes=1)
    assert convert(Counting(), tmp_path / "b", "toy", shard_bytes=1).episodes == whole.episodes
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_a_disk_that_is_full_at_the_end_is_named(tmp_path, monkeypatch):
    """The error of tfds says no path."""

    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("tensorflow_datasets.core.DatasetInfo.write_to_directory", full)
    with pytest.raises(OSError, match=r"No space left on device: '\S+/toy/\.1\.0\.0\.\w+\.partial'"):
        convert(Counting(), tmp_path, "toy", shard_bytes=1)


@pytest.mark.parametrize("name", ["sync_tree", "remove"])
def test_killed_while_it_publishes_it_keeps_its_shards(tmp_path, monkeypatch, name):
    """Forcing a large dataset to the disk takes minutes."""
    whole = convert(Counting(), tmp_path / "a", "toy", shard_bytes=1)
    with monkeypatch.context() as patched:

        def die(directory):
            raise KeyboardInterrupt

        patched.setattr(f"data_pipelines.publishing.files.{name}", die)
        with pytest.raises(KeyboardInterrupt):
            convert(Counting(), tmp_path / "b", "toy", shard_bytes=1)
    unreadable = Counting(damaged=tuple(range(8)))  # nothing is read again
    again = convert(unreadable, tmp_path / "b", "toy", shard_bytes=1)
    assert again.episodes == whole.episodes and contents(tmp_path / "a") == contents(tmp_path / "b")


def test_killed_after_it_published_it_leaves_nothing_more(tmp_path, monkeypatch):
    whole = convert(Counting(), tmp_path / "a", "toy")

    def die(made, final):
        publish(made, final)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("data_pipelines.convert.write.publish", die)
        with pytest.raises(KeyboardInterrupt):
            convert(Counting(), tmp_path / "b", "toy")
    assert convert(Counting(), tmp_path / "b", "toy").episodes == whole.episodes
    assert contents(tmp_path / "a") == contents(tmp_path / "b")


def test_a_second_run_does_nothing_and_another_source_is_refused(tmp_path):
    first = convert(Counting(), tmp_path, "toy")
    assert convert(Counting(stop_at=0), tmp_path, "toy") == first
    with pytest.raises(ConfigError, match="exists already and was made from another source, with other settings"):
        convert(Counting(salt=1), tmp_path, "toy")


def test_damage_stops_or_is_left_out_and_counted(tmp_path):
    with pytest.raises(UnitError, match="u4 is damaged"):
        convert(Counting(damaged=(4,)), tmp_path, "toy", shard_bytes=1)
    source = Counting(damaged=(4,), stop_at=1)  # what was done before is not read again
    done = convert(source, tmp_path, "toy", shard_bytes=1, skip_damaged=True)
    assert done.episodes == 6 and done.skipped == {"nothing in it": 3, "u4 is damaged": 1}


@pytest.mark.parametrize("advice", [detections.ADVICE, robomimic.ADVICE, video.ADVICE])
def test_who_leaves_damage_out_is_not_advised_to(tmp_path, monkeypatch, advice):
    def read(self, unit):
        if unit == 4:
            raise UnitError(f"u4.mp4: not a readable video. {advice}")
        yield from plain(self, unit)

    plain = Counting.read
    monkeypatch.setattr(Counting, "read", read)
    with pytest.raises(UnitError, match="--skip-damaged"):
        convert(Counting(), tmp_path, "toy")
    assert "u4.mp4: not a readable video." in convert(Counting(), tmp_path, "toy", skip_damaged=True).skipped


def spoil(part, key, value):
    def change(parts):
        parts[part] = {**parts[part], key: value} if key else value

    return change


@pytest.mark.parametrize(
    "change, message",
    [
        (spoil("vectors", "action", np.zeros((2, 2))), r"u1/0: 'action' has the shape \[2, 2\], but 3 steps"),
        (
            spoil("vectors", "action", np.array([[0, 0], [0, np.nan], [0, 0]])),
            "u1/0: 'action' is not finite at step 1",
        ),
        (spoil("images", "observation/image", [b""]), "u1/0: 1 frames in 'observation/image' for 3 steps"),
        (spoil("rewards", None, np.zeros(9)), r"u1/0: \(9,\) rewards for 3 steps"),
    ],
)
def test_an_episode_that_contradicts_the_layout_is_named(tmp_path, change, message):
    with pytest.raises(UnitError, match=message):
        convert(Counting(change=change), tmp_path, "toy")
    assert not (tmp_path / "toy/1.0.0").exists()


def test_nothing_left_is_an_error_that_says_why(tmp_path):
    with pytest.raises(DataError, match="no episode can be made from it: 1 x nothing in it"):
        convert(Counting(units=["u0"]), tmp_path / "new", "toy")
    assert not any(tmp_path.iterdir()), "a directory that was made for it is left"
    (tmp_path / "toy").mkdir()
    with pytest.raises(DataError, match="no episode can be made from it"):
        convert(Counting(units=["u0"]), tmp_path, "toy")
    assert not any((tmp_path / "toy").iterdir()), "one that was there stays"


def test_names_and_missing_libraries_are_refused_in_words(tmp_path):
    with pytest.raises(ConfigError, match="'My Robot' cannot be a dataset's name"):
        convert(Counting(), tmp_path, "My Robot")
    with pytest.raises(ConfigError, match=r"no_such_library.*pip install 'hma-jax\[convert\]'"):
        require_module("no_such_library")


def test_two_conversions_do_not_write_the_same_place(tmp_path):
    class Nested(Counting):
        def read(self, unit):
            if unit == 1:
                convert(Counting(), tmp_path, "toy")
            return super().read(unit)

    with pytest.raises(ConfigError, match="another process is writing .*toy"):
        convert(Nested(), tmp_path, "toy")


def test_the_documented_script_writes_a_dataset_that_is_read(tmp_path, monkeypatch, capsys):
    _, section = PAGE.read_text().split("\n## Writing RLDS\n")
    (text,) = re.findall(r"^```python\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    (tmp_path / "my_robot.py").write_text(text)
    monkeypatch.setattr(sys, "argv", ["my_robot.py", str(tmp_path)])
    for _ in range(2):  # the second finds it done
        runpy.run_path(str(tmp_path / "my_robot.py"))
    facts = inspect_dataset(str(tmp_path / "my_robot"), episodes=2).facts
    assert (facts.episodes, facts.lengths.longest) == (20, 30)
    assert [(camera.key, camera.sizes) for camera in facts.cameras] == [("observation/image", ((64, 64),))]
    assert [(action.key, len(action.dimensions)) for action in facts.actions] == [("action", 7)]
