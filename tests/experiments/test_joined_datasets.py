"""One robot in several directories: the entry that docs/own_data.md shows, from tokenising to a model."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.convert.write import convert
from data_pipelines.registry import get_spec
from data_pipelines.registry import table as registry_table
from data_pipelines.sampling.splits import HeldOut, held_out
from data_pipelines.sources.convertible import Episode, Layout
from data_pipelines.sources.open import open_source
from data_pipelines.sources.rlds.writer import encode_jpeg, image_field
from data_pipelines.tokens.store import TokenStore
from experiments.applications.generating.trajectories import open_trajectories
from experiments.cli.main import main
from experiments.study_setup import find_directories
from hma_jax.simulator.robots import Robot
from hma_jax.training.runs import load_run
from tests.data_pipelines.convert import sources
from tests.experiments.idle import SMOKE, idle_training  # noqa: F401

pytest.importorskip("av")

PAGE = Path(__file__).parents[2] / "docs" / "own_data.md"
STEPS = 92  # of an episode: at stride 15 seven frames, of which a window of the smoke study takes four


class Cups:
    """Recordings in another format, with actions far from those of the folder."""

    layout = Layout({"observation/front": image_field(36, 64)}, {"action": 6}, knows_success=False)
    hz, description, units = 30, "It places cups.", [f"take_{k}" for k in range(6)]

    def identity(self):
        return {"units": self.units}

    def read(self, unit):
        images = [encode_jpeg(sources.picture(t % 24)) for t in range(STEPS)]
        actions = np.full((STEPS, 6), 100.0 + unit, np.float32)
        yield Episode(self.units[unit], {"observation/front": images}, {"action": actions}, ["place"] * STEPS)


def write_folder(root: Path) -> Path:
    """A LeRobot folder with the camera, the action and the rate of the page's entry."""
    import pyarrow as pa

    def six(episode, rows):
        rows["action"] = pa.array(np.full((STEPS, 6), float(episode)).tolist(), pa.list_(pa.float32()))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sources, "FPS", 30)
        patch.setattr(sources, "CAMERA", "observation.images.front")
        sources.write_lerobot(root, "v3.0", (STEPS,) * 8, camera="image", change=six)
    info = json.loads((root / "meta" / "info.json").read_text())
    info["features"]["action"]["shape"] = [6]
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


@pytest.fixture(scope="module")
def entry(tmp_path_factory) -> Path:
    (text,) = re.findall(r"```toml\n(\[so101\]\n.*?)```", PAGE.read_text(), re.DOTALL)
    path = tmp_path_factory.mktemp("entry") / "my.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[Path, Path]:
    root = tmp_path_factory.mktemp("data")
    convert(Cups(), root, "place_cup")
    return write_folder(root / "pick-cube"), root / "place_cup"


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(registry_table, "_registered", {})


@pytest.fixture
def hma(entry, capsys):
    """Runs a command on directories; returns (exit code, all that it said in one line)."""

    def run(command: str, *words: object, data=(), registry: Path = entry) -> tuple[int, str]:
        capsys.readouterr()
        given = ["--data", *map(str, data)] if data else []
        code = main([*command.split(), *map(str, words), "--registry", str(registry), *given])
        said = capsys.readouterr()
        return code, " ".join((said.out + said.err).split())

    return run


def held_out_of(root: Path, place: Path) -> set[int]:
    """Numbers of the held-out episodes of one part, in that part."""
    source = open_source(place)
    manifest = TokenStore(root / "tokens").manifest("so101")
    before = 0
    for run in manifest.runs:
        if run.file.startswith(f"{source.name}/"):
            return {i - before for i in manifest.val.episodes if before <= i < before + len(source)}
        before += run.count
    raise AssertionError(f"{source.name} is not in the store")


def test_directories_of_one_robot_become_one_robot(hma, data, tmp_path):
    folder, cups = data
    first, both = tmp_path / "first", tmp_path / "both"
    code, said = hma("train", *SMOKE, "--out", first, data=[folder])
    assert code == 0
    assert (
        "note: so101 is made of pick_cube alone: no --data directory for place_cup, pour, which its entry joins" in said
    )
    code, said = hma("train", *SMOKE, "--out", both, "--tokenizer", first / "tokenizer", data=[cups, folder])
    assert code == 0 and "no --data directory for pour, which" in said and "1 robot" in said
    for root, given in ((first, ["pick_cube"]), (both, ["pick_cube", "place_cup"])):
        table, manifest = load_run(root / "model").table, TokenStore(root / "tokens").manifest("so101")
        assert TokenStore(root / "tokens").names == table.names == ("so101",)
        assert (
            list(manifest.spec.joins) == list(dict.fromkeys(run.file.split("/")[0] for run in manifest.runs)) == given
        )
        alone = open_source(folder)
        assert held_out_of(root, folder) == set(np.flatnonzero(held_out("pick_cube", alone.ids, HeldOut())))
    (robot,) = table.entries
    train = [
        *(float(i) for i in manifest.train.episodes if i < 8),
        *(92.0 + i for i in manifest.train.episodes if i >= 8),
    ]
    assert min(train) < 8 and max(train) > 99
    np.testing.assert_allclose(robot.mean, np.full(6, np.mean(train)), rtol=1e-5)
    np.testing.assert_allclose(robot.std, np.full(6, np.std(train)), rtol=1e-4)

    # The first model goes on with what was added, as the robot that it knows.
    more = ("--from", first / "model", "--run", tmp_path / "more")
    assert hma("train", *SMOKE, "--out", both, *more, data=[cups, folder])[0] == 0
    assert load_run(tmp_path / "more").table.names == ("so101",)
    assert hma("evaluate", both / "model", *SMOKE, "--out", both, data=[folder, cups])[0] == 0

    # One part less is other data, which is said by name; in the same way again, nothing is done.
    code, said = hma("tokenize", *SMOKE, "--out", both, "--tokenizer", first / "tokenizer", data=[cups])
    assert code == 2 and "spec.joins: ['pick_cube', 'place_cup'] -> ['place_cup'] (so101)" in said
    before = (both / "tokens" / "so101" / "manifest.json").read_bytes()
    assert hma("tokenize", *SMOKE, "--out", both, "--tokenizer", first / "tokenizer", data=[folder, cups])[0] == 0
    assert (both / "tokens" / "so101" / "manifest.json").read_bytes() == before


def test_a_part_by_itself_is_looked_at_by_the_entry_that_joins_it(hma, data, entry, tmp_path):
    code, said = hma("data inspect", data[0], "--out", tmp_path, "--frames", "4")
    assert code == 0 and "in the registry: as a part of so101, observation/front, action (6), 30 Hz" in said
    assert hma("data view", *data, "--out", tmp_path / "page.html", "--frames", "4")[0] == 0
    code, said = hma("data list", "so101")
    assert code == 0 and "joins pick_cube, place_cup, pour" in said
    zeros = (0.0,) * 6
    known = {"so101": Robot("so101", 15, zeros, zeros, zeros)}

    class Tokenizer:
        image_size = 8

    recorded, robot = open_trajectories(str(data[0]), "train", None, known, Tokenizer(), tmp_path)
    assert (recorded.name, recorded.drawn_as, robot.name, len(recorded)) == ("so101", "pick_cube", "so101", 8)


def test_what_cannot_be_joined_is_refused(hma, data, entry, tmp_path):
    folder, cups = data
    copy = tmp_path / "b" / "pick_cube"
    copy.parent.mkdir()
    copy.symlink_to(folder)
    code, said = hma("tokenize", *SMOKE, "--out", tmp_path / "out", data=[folder, copy])
    assert code == 2 and f"{folder} and {copy} are both the dataset 'pick_cube'" in said and "rename it" in said
    called = tmp_path / "so101"
    called.symlink_to(folder)
    code, said = hma("tokenize", *SMOKE, "--out", tmp_path / "out", data=[called, cups])
    assert code == 2 and "Add so101 to `joins` of that entry, or call the entry something else" in said
    twice = tmp_path / "twice.toml"
    twice.write_text(entry.read_text() + entry.read_text().replace("[so101]", "[other]"))
    code, said = hma("tokenize", *SMOKE, "--out", tmp_path / "out", data=[folder], registry=twice)
    assert code == 2 and "pick_cube is in `joins` of so101 and other; a dataset can be part of one other" in said
    assert not (tmp_path / "out" / "tokens").exists()


def test_a_mixture_finds_the_parts_of_what_an_entry_joins(tmp_path):
    """The released conversions of one benchmark are a dataset per task."""
    registry_table.register([replace(get_spec("robomimic"), joins=("robomimic_lift", "robomimic_can"))])
    for name in ("toto", "robomimic_can", "robomimic_lift"):
        (tmp_path / name).mkdir()
    found = find_directories(("toto", "robomimic"), [str(tmp_path)])
    assert [Path(place).name for place in found] == ["toto", "robomimic_lift", "robomimic_can"]
