"""Learned and true simulators of a run's robots, and the model that is shipped."""

import json
import re
import shutil
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image

from experiments import simulators as simulators_module
from experiments.applications import DRIVEN
from experiments.applications import ship as ship_module
from experiments.applications.ship import ship
from experiments.bench.record import read_record
from experiments.cli.main import main
from experiments.running.workspace import Workspace
from experiments.simulators import load_simulator, make_simulator
from hma_jax import Simulator
from hma_jax.config import ConfigError, DecodeConfig
from hma_jax.config.base import later
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.simulator import folder
from hma_jax.simulator.folder import DEFAULT_DECODE, change_decode, find_decode, save_decode, save_robots
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start
from tests.experiments.applications.runs import TABLE, make_run

DOCS = Path(__file__).parents[3] / "docs"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("study"))


def test_robots_of_the_suite_are_described_and_begin_at_held_out_episodes(run):
    simulator = load_simulator(run)
    pusher, gripper = simulator.robots.values()
    assert (pusher.dimensions, pusher.unit, pusher.keeps, pusher.recorded) == (
        ("xy x", "xy y"),
        "per step",
        False,
        False,
    )
    assert gripper.keeps and gripper.hz == 4.0
    assert {s.robot for s in simulator.starts} == {"pusher_sand", "gripper_wood"}
    assert all(s.seed is not None and s.images.shape == (3, 8, 8, 3) for s in simulator.starts)


def test_of_one_s_own_data_targets_stay_where_they_were_moved_to_and_changes_end(tmp_path, monkeypatch):
    """Told from the recordings: there is nobody else to say it."""
    rng = np.random.default_rng(0)
    changes = rng.normal(size=(80, 3))
    recorded = {"arm": np.cumsum(changes, 0) / 10, "base": changes}
    store = SimpleNamespace(
        names=tuple(recorded),
        manifest=lambda name: SimpleNamespace(val=SimpleNamespace(episodes=[0])),
        episode=lambda name, split, i: SimpleNamespace(actions=recorded[name]),
    )
    monkeypatch.setattr(simulators_module, "TokenStore", lambda _: store)
    robots = {name: Robot(name, 2, (-1.0,) * 3, (1.0,) * 3, (0.0,) * 3) for name in recorded}
    described = []
    simulator = SimpleNamespace(robots=robots, update_robots=described.extend)
    workspace = Workspace(tmp_path)
    workspace.store.mkdir()
    simulators_module.mark_absolute_actions(simulator, tmp_path / "model")
    assert described == [replace(robots["arm"], keeps=True)]

    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "robots.json").touch()  # what lies beside the run says it
    monkeypatch.undo()  # the store is empty: it may just be made
    simulators_module.mark_absolute_actions(simulator, tmp_path / "model")
    assert len(described) == 1


def test_a_trial_of_a_study_has_the_study_s_tokenizer(run, tmp_path):
    study = tmp_path / "study"
    shutil.copytree(run.parent / "tokenizer", study / "tokenizer")
    trial = shutil.copytree(run, study / "trials" / "0a" / "run")
    assert Workspace.of_run(trial) == Workspace(study) and Workspace.of_run(study / "model") == Workspace(study)
    assert dict(load_simulator(trial).robots) == dict(load_simulator(run).robots)


def test_a_link_to_a_run_leads_to_its_study(run, tmp_path):
    """There was no tokenizer, or the ranges of actions were those of statistics."""
    study, other = tmp_path / "study", tmp_path / "other"
    shutil.copytree(run.parent / "tokenizer", study / "tokenizer")
    for place in (other / "tokenizer", tmp_path / "disk" / "model"):
        place.mkdir(parents=True)
    shutil.copytree(run, study / "model")
    for link, to in ((tmp_path / "best", study), (other / "best", study), (study / "big", tmp_path / "disk")):
        link.symlink_to(to / "model")
        assert Workspace.of_run(link) == Workspace(study)
    assert Simulator.load(other / "best").tokenizer.identity == Simulator.load(study / "model").tokenizer.identity


def test_one_robot_that_is_given_leaves_the_others_and_what_is_not_given_as_they_lie_beside_the_run(run, tmp_path):
    """All lost what robots.json says of them, and `decode=None` was another way to decode than decode.json's."""
    study = shutil.copytree(run.parent, tmp_path / "study")
    known = Simulator.load(study / "model").robots
    pusher, gripper = (replace(known[name], unit="as recorded") for name in ("pusher_sand", "gripper_wood"))
    save_robots([pusher, gripper], study / "model" / "robots.json")
    save_decode(DecodeConfig(3, temperature=0.5), study / "model" / "decode.json")
    own = replace(pusher, unit="my own")
    loaded = Simulator.load(study / "model", robots=[own], decode=None, starts=None)
    assert dict(loaded.robots) == {"pusher_sand": own, "gripper_wood": gripper}
    assert loaded.decode == DecodeConfig(3, temperature=0.5) and loaded.starts == ()


def test_a_decoding_that_is_written_by_hand_says_only_what_differs(tmp_path):
    """Latents were drawn in 100 steps of another sampler as soon as a file said anything else."""
    (written,) = re.findall(r"^```json\n(.*?)^```", (DOCS / "simulator.md").read_text(), re.MULTILINE | re.DOTALL)
    for text, meant in (
        (written, replace(DEFAULT_DECODE, unmask_steps=8, temperature=0.0)),
        ('{"unmask_steps": 8, "temperature": 0.7}', change_decode(DEFAULT_DECODE, 0.7, unmask_steps=8)),
        ('{"temperature": 0.7, "sampler": {"temperature": 0}}', replace(DEFAULT_DECODE, temperature=0.7)),
        ('{"sampler": {"eta": 0}}', replace(DEFAULT_DECODE, sampler=replace(DEFAULT_DECODE.sampler, eta=0.0))),
    ):
        (tmp_path / "decode.json").write_text(text)
        assert find_decode(tmp_path) == meant
    for text, message in (
        ("[8]", "expected named fields"),
        ('{"steps": 8}', "unknown field.* steps; known: unmask_st"),
    ):
        (tmp_path / "decode.json").write_text(text)
        with pytest.raises(ConfigError, match=rf"decode.json: {message}"):
            find_decode(tmp_path)


@dataclass(frozen=True)
class Cooled(DecodeConfig):
    cooling: float = later(0.5, before=1.0)


def test_a_setting_of_decoding_that_came_later_is_as_before_in_a_file_without_it(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "DecodeConfig", Cooled)
    monkeypatch.setattr(folder, "DEFAULT_DECODE", Cooled(sampler=DEFAULT_DECODE.sampler))
    assert find_decode(tmp_path).cooling == 0.5
    save_decode(DecodeConfig(8), tmp_path / "decode.json")
    assert find_decode(tmp_path) == Cooled(8, cooling=1.0)


def test_robots_and_starts_that_are_given_are_not_taken_from_the_study(run):
    pusher = load_simulator(run).robots["pusher_sand"]
    start = Start("pusher_sand", np.zeros((1, 8, 8, 3), np.uint8), np.zeros((0, 2)))
    own = replace(pusher, unit="my own")
    loaded = load_simulator(run, robots=[own], starts=[start])
    assert loaded.robots["pusher_sand"] == own and loaded.robots["gripper_wood"].keeps
    assert loaded.starts == (start,)


def test_neither_world_is_taken_for_one_that_there_is_not(run):
    with pytest.raises(ConfigError, match="world: 'learnt' is not allowed; choose one of learned, true"):
        make_simulator(run, "learnt")


def program(containing: str) -> str:
    """The Python program of docs/checkpoints.md that has this in it."""
    programs = re.findall(r"^```python\n(.*?)^```", (DOCS / "checkpoints.md").read_text(), re.MULTILINE | re.DOTALL)
    (found,) = (text for text in programs if containing in text)
    return found


def test_what_is_handed_on_is_a_simulator_elsewhere(run, tmp_path):
    """By the program of the page. A model of one's own could not be shipped, and nothing said what else to send."""
    out, expected = tmp_path / "made", load_simulator(run)
    text = program("save_simulator(").replace('"runs/mine/model"', repr(str(run)))
    exec(text.replace('"my_robot_simulator"', repr(str(out))), {})
    handed = Simulator.load(shutil.move(out, tmp_path / "elsewhere"))
    assert dict(handed.robots) == dict(expected.robots) and handed.decode == expected.decode
    assert handed.starts == expected.starts and handed.tokenizer.identity == expected.tokenizer.identity
    jax.tree.map(np.testing.assert_array_equal, handed.model.params, expected.model.params)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["elsewhere"]


def test_a_run_outside_a_study_starts_from_a_picture(run, tmp_path, monkeypatch):
    """By the program of the page, of a picture that is no square."""
    monkeypatch.chdir(tmp_path)
    copied = shutil.copytree(run, tmp_path / "rel")
    Image.fromarray(np.full((16, 24, 3), 200, np.uint8)).save("table.png")
    text = program("save_starts(").replace("runs/rel", str(copied))
    exec(text.replace("language_table", "pusher_sand").replace("256", "8"), {})
    (start,) = load_simulator(copied, tokenizer=run.parent / "tokenizer").starts
    assert start == Start("pusher_sand", np.full((1, 8, 8, 3), 200, np.uint8), np.zeros((0, 2)))


@pytest.mark.slow
def test_true_and_learned_are_exchanged_by_one_word(run):
    seen = {}
    for world in ("learned", "true"):
        simulator = make_simulator(str(run), world, episodes=2)
        starts = [s for s in simulator.starts if s.robot == "pusher_sand"][:2]
        first = simulator.reset(starts)
        images = simulator.step([np.array([1e9, 0.0]), None])
        assert simulator.clipped == [("xy x",), ()]
        np.testing.assert_array_equal(images[1], first[1])
        np.testing.assert_array_equal(simulator.rewind(1, [0]), first)
        seen[world] = simulator.robots, images.shape
    assert seen["learned"] == seen["true"]


def test_the_truth_does_not_take_native_actions_one_by_one_and_says_so(run):
    """Each was held for a whole frame, where the learned one made a frame of as many as its stride."""
    with pytest.raises(ConfigError, match="rate='native' is supported only by the learned simulator"):
        make_simulator(run, "true", rate="native")


@pytest.mark.slow
def test_a_simulator_is_timed_as_its_users_step_it(run, tmp_path, capsys):
    assert main(["bench", "simulate", str(run), "--batch", "2", "--repeats", "3", "--out", str(tmp_path)]) == 0
    (file,) = tmp_path.glob("simulate-*.json")
    (stage,) = read_record(file).stages
    assert (stage.name, stage.batch, stage.frames, stage.timing.repeats) == ("step", 2, 2, 3)
    assert main(["bench", "simulate", str(run), "--batch", "0"]) == 2
    assert "--repeats and --batch must be at least 1" in " ".join(capsys.readouterr().err.split())


@pytest.mark.slow
def test_what_is_shipped_stands_alone_and_does_the_same(run, tmp_path):
    out, decode = tmp_path / "simulator", DecodeConfig(3, temperature=0.5)
    ship(run, out, decode, add=lambda made: (made / "report.json").write_text("{}"))
    (tmp_path / "elsewhere").mkdir()
    moved = out.rename(tmp_path / "elsewhere" / "model")  # nothing of the study is near
    shipped, known = Simulator.load(moved), load_simulator(run, decode=decode)
    assert shipped.decode == decode and (moved / "report.json").exists()
    assert dict(shipped.robots) == dict(known.robots)
    assert len(shipped.starts) == len(known.starts)
    first = shipped.reset(shipped.starts[0])
    np.testing.assert_array_equal(first, known.reset(known.starts[0]))
    assert shipped.step([np.array([1.0, -1.0])]).shape == first.shape
    rounded = jax.tree.map(lambda x: x.astype(np.float16).astype(x.dtype), known.model.params)
    jax.tree.map(np.testing.assert_array_equal, shipped.model.params, rounded)
    assert not any(path.name.startswith(".simulator") for path in tmp_path.iterdir())
    assert not [path for path in moved.rglob("*") if path.is_file() and str(tmp_path).encode() in path.read_bytes()]


def test_what_is_too_large_is_not_shipped(run, tmp_path, monkeypatch):
    monkeypatch.setattr(ship_module, "LARGEST", 1000)
    with pytest.raises(ConfigError, match="more than the 1,000 bytes allowed for the repository"):
        ship(run, tmp_path / "simulator")
    assert not list(tmp_path.iterdir())


def test_what_is_there_stays_until_all_of_the_new_one_is(run, tmp_path):
    out = tmp_path / "simulator"
    out.mkdir()
    (out / "report.json").write_text("known")

    def stop(made: Path) -> None:
        (made / "report.json").write_text("half")
        assert (made / "robots.json").exists()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ship(run, out, add=stop, replace=True)
    assert (out / "report.json").read_text() == "known"
    assert [path.name for path in tmp_path.rglob("*")] == ["simulator", "report.json"]


def test_what_was_not_shipped_is_not_replaced(run):
    """The run itself, the study that it is in."""
    before = sorted(run.parent.rglob("*"))
    for out in (run, run.parent):
        with pytest.raises(ConfigError, match=r"has no report.json, so .* it would be overwritten"):
            ship(run, out, replace=True)
    assert sorted(run.parent.rglob("*")) == before


def test_a_shipped_model_is_replaced_only_on_request(run, tmp_path):
    """A documented command replaced a committed model by whatever the user had trained."""
    out = tmp_path / "simulator"
    out.mkdir()
    (out / "report.json").write_text("known")
    with pytest.raises(ConfigError, match="holds a shipped model; choose another --out, or add --replace"):
        ship(run, out)
    assert [path.name for path in out.iterdir()] == ["report.json"]
    ship(run, out, replace=True)
    assert not (out / "report.json").exists() and (out / "robots.json").exists()


def test_a_robot_without_a_truth_to_be_compared_with_is_not_shipped(tmp_path):
    table = EmbodimentTable((*TABLE.entries, Embodiment("stranger", 2, 1, (0.0, 0.0), (1.0, 1.0))))
    with pytest.raises(ConfigError, match=r"stranger: not robots of the suite, .* docs/checkpoints.md says"):
        ship(make_run(tmp_path / "study", table=table), tmp_path / "simulator")
    assert [path.name for path in tmp_path.iterdir()] == ["study"]


def test_nothing_is_replaced_that_was_not_named(run, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["ship", str(run)])
    with pytest.raises(SystemExit) as stopped:
        ship_module.main()
    assert stopped.value.code == 2 and "--out" in capsys.readouterr().err


def test_another_tokenizer_or_damaged_robots_are_refused(run, tmp_path):
    out = tmp_path / "simulator"
    ship(run, out)
    (out / "robots.json").write_text(json.dumps([{"name": "pusher_sand"}]))
    with pytest.raises(ConfigError, match="robots.json: robot 0: missing field"):
        Simulator.load(out)
    (out / "starts.npz").write_bytes(b"PK")
    (out / "robots.json").unlink()
    with pytest.raises(ConfigError, match="starts.npz cannot be read"):
        Simulator.load(out)
    (out / "starts.npz").unlink()
    with pytest.raises(ConfigError, match="no tokenizer at.*--tokenizer"):
        Simulator.load(out, tmp_path / "nowhere")


def test_the_model_of_this_repository_is_whole():
    shipped = Path(ship_module.__file__).parents[2] / DRIVEN
    simulator = Simulator.load(shipped)
    assert len(simulator.robots) == 8 == len({start.robot for start in simulator.starts})
    assert simulator.decode == find_decode(shipped) != DEFAULT_DECODE
    assert sum(path.stat().st_size for path in shipped.rglob("*") if path.is_file()) < ship_module.LARGEST
