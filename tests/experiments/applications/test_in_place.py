"""Where things stand at the end of a window, and a detector for frames of any size."""

import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.suite.simulator import SPECS
from experiments import simulators
from experiments.applications import detector as detector_module
from experiments.applications import in_place as in_place_module
from experiments.applications.detector import (
    Detector,
    detection_errors,
    enlarged,
    make_detector,
    reconstruct,
    reconstructed,
    resized,
    select_robots,
    train_detector,
)  # fmt: skip
from experiments.applications.detector_network import Detections, init_detector
from experiments.applications.in_place import CLOSE_PX, EPISODES, VIEWS, in_place, measure_ends
from experiments.applications.scenes import Points, Scenes, draw_scenes, point_names
from experiments.simulators import load_simulator
from hma_jax.config import ConfigError, DecodeConfig
from tests.experiments.applications.runs import make_run
from tests.hma_jax.simulator.small import ROBOTS, parts

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def simulator(tmp_path_factory):
    return load_simulator(make_run(tmp_path_factory.mktemp("study")), episodes=EPISODES)


class Oracle(Detector):
    """Finds what it is told, in frames that it keeps."""

    def __init__(self, found: list[Detections]):
        self.found, self.films = found, []

    def detect(self, robot, film):
        self.films.append(film)
        return self.found[len(self.films) - 1]


@pytest.mark.slow
def test_places_at_the_end_are_those_of_the_true_simulator(simulator):
    robot = simulator.robots["pusher_sand"]
    points = len(point_names(SPECS[robot.name]))
    nowhere = Detections(np.zeros((EPISODES, points, 2), np.float32), np.ones((EPISODES, points), np.float32))
    oracle = Oracle([nowhere] * len(VIEWS))
    rows = measure_ends(simulator, oracle, robot)
    assert [film.shape for film in oracle.films] == [(EPISODES, 64, 64, 3)] * len(VIEWS)
    model, true, tokens, still = oracle.films
    assert (true != still).any(), "the true last frame, and the prompt's"
    larger = 64 // simulator.tokenizer.image_size
    np.testing.assert_array_equal(tokens, reconstruct(simulator.tokenizer, true[:, ::larger, ::larger]))
    assert {row["what"] for row in rows} <= set(point_names(SPECS[robot.name]))
    tools = [row for row in rows if row["what"] == "tool_0"]
    assert len(tools) == EPISODES and np.mean([row["moved_px"] > CLOSE_PX for row in tools]) > 0.3
    # From the corner it is as far as the tool is.
    assert all(len({row[f"{view}_px"] for view in VIEWS}) == 1 and row["true_px"] > 0 for row in tools)


def test_a_part_of_the_robots_is_watched_by_name():
    robots = {name: object() for name in ("arm_sand", "pusher_sand")}
    assert select_robots(robots, ()) == robots
    assert list(select_robots(robots, ["pusher_sand"])) == ["pusher_sand"]
    with pytest.raises(ConfigError, match="--robots: pusher_sad cannot be used; choose from arm_sand, pusher_sand"):
        select_robots(robots, ["pusher_sad"])


def test_the_share_is_of_what_moved_and_a_mean_over_robots():
    def row(robot: str, moved: float, off: float, sure: float = 1.0):
        return {"robot": robot, "moved_px": moved} | {
            f"{view}_{name}": value for view in VIEWS for name, value in (("px", off), ("confidence", sure))
        }

    rows = [row("a", 9, 1), row("a", 9, 9), row("a", 1, 1), row("b", 9, 1), row("b", np.nan, 9), row("b", 9, 1, 0.0)]
    assert in_place(rows, "model")[::2] == (0.5, 2)
    rows += [row("c", 9, 1)] * 4
    share, half, robots = in_place(rows, "model")
    assert (round(share, 4), robots) == (0.6667, 3) and half > 0.5
    assert in_place([], "true")[2] == 0


def test_false_detections_are_told_apart_by_why_nothing_is_seen():
    """A detector that reports the one object whenever it is out of sight, and no colour that is not there."""
    share = np.float32([[1, 1, 0, 0]] * 6 + [[1, 0, 0, 0]] * 3 + [[1, 0.1, 0, 0]])
    position = np.zeros((10, 4, 2), np.float32)
    position[:, :2] = 20
    scenes = Scenes(np.zeros((10, 64, 64, 3), np.uint8), Points(position, share))
    confidence = np.where((share < 1) & (position[..., 0] > 0), 0.9, 0.0)
    detector = SimpleNamespace(detect=lambda *_: Detections(position, confidence))
    _, objects = detection_errors(detector, "gripper_wood", scenes)
    kinds = {name: objects[name] for why in ("absent", "hidden", "partly") for name in (f"ghosts_{why}", why)}
    assert kinds == {
        "ghosts_absent": 0.0, "absent": 20, "ghosts_hidden": 1.0, "hidden": 3, "ghosts_partly": 1.0, "partly": 1,
    }  # fmt: skip
    # What is in sight it places exactly and does not report.
    assert [objects[name] for name in ("frames", "found", "within_2px", "median_px")] == [6, 0, 0, 0]


def test_a_detector_is_not_there_before_its_errors_are(simulator, tmp_path, monkeypatch):
    """`in_place` does not make it again, so that they would never be written."""

    def stopped(*_):
        raise KeyboardInterrupt

    def untrained(scenes, unfinished, **_):
        unfinished.touch()
        return Detector(jax.jit(init_detector, static_argnums=(1, 2))(jax.random.key(0), 1, 5), list(scenes))

    for name, value in (("EPISODES", 1), ("MIN_EPISODES", 1), ("HELD_OUT", (1, 1)), ("train_detector", untrained)):
        monkeypatch.setattr(detector_module, name, value)
    monkeypatch.setattr(detector_module, "detection_errors", stopped)
    with pytest.raises(KeyboardInterrupt):
        make_detector(["pusher_sand"], simulator.tokenizer, tmp_path)
    assert not (tmp_path / detector_module.WEIGHTS).exists()
    monkeypatch.setattr(detector_module, "detection_errors", lambda *_: [{"found": 1.0}])
    made = make_detector(["pusher_sand"], simulator.tokenizer, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == [detector_module.WEIGHTS, detector_module.ERRORS]
    assert Detector.load(tmp_path / detector_module.WEIGHTS).robots == made.robots == ("pusher_sand",)


def test_where_all_episodes_are_too_short_that_is_said(tmp_path, monkeypatch, capsys):
    known = SimpleNamespace(model=SimpleNamespace(params={}), decode=DecodeConfig(), robots={"r": ROBOTS[0]})
    monkeypatch.setattr(in_place_module, "load_simulator", lambda *_, **__: known)
    monkeypatch.setattr(in_place_module, "suite_robots", lambda robots: robots)
    monkeypatch.setattr(in_place_module.Detector, "load", lambda path: None)
    monkeypatch.setattr(in_place_module, "measure_ends", lambda *_: [])
    monkeypatch.setattr(sys, "argv", ["in_place", "RUN", "--out", str(tmp_path)])
    (tmp_path / "detector.npz").touch()
    with pytest.raises(ConfigError, match="no robot is left"):
        in_place_module.main()
    said = capsys.readouterr().out
    assert f"left out, since their episodes are too short or show no object at the end: {ROBOTS[0].name}" in said


@pytest.fixture
def ask(simulator, tmp_path, monkeypatch):
    """`python -m experiments.applications.detector`, in an empty directory, where training takes no time."""

    def make(robots, tokenizer, out):
        out.mkdir(parents=True, exist_ok=True)
        (out / detector_module.WEIGHTS).write_text(f"{robots}")
        (out / detector_module.ERRORS).write_text("errors")

    def ask(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["detector", *arguments])
        detector_module.main()

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(detector_module, "load_simulator", lambda run: simulator)
    monkeypatch.setattr(detector_module, "make_detector", make)
    return ask


def test_a_detector_of_one_s_own_leaves_the_committed_one(ask, tmp_path, capsys):
    ask("RUN")
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]
    said = " ".join(capsys.readouterr().out.split())
    assert "python -m experiments.applications.endurance RUN --detector runs/detector/detector.npz" in said


def test_a_detector_takes_no_other_one_s_place(ask, tmp_path, monkeypatch, capsys):
    """That of another run was written over, and the one of this run trained again."""
    ask("RUN")
    assert "wrote runs/detector/detector.npz" in capsys.readouterr().out
    monkeypatch.setattr(detector_module, "make_detector", lambda *_: pytest.fail("it is made again"))
    ask("RUN")
    said = capsys.readouterr().out
    assert "runs/detector/detector.npz of this run exists already; remove it to" in said and "wrote" not in said
    with pytest.raises(ConfigError, match="runs/detector holds .*.run: 'RUN' -> 'OTHER'.; choose another --out"):
        ask("OTHER")
    (tmp_path / "runs/detector/settings.json").unlink()
    with pytest.raises(
        ConfigError, match="detector.npz exists, but it is not known for which run it was trained; choose"
    ):
        ask("RUN")


def test_a_detector_whose_training_was_killed_comes_out_as_if_it_had_not_been(tmp_path, monkeypatch):
    monkeypatch.setattr(detector_module, "SAVE_EVERY", 2)
    scenes = {name: draw_scenes(SPECS[name], "train", 2, 2, 0) for name in ("pusher_sand", "gripper_wood")}
    made, unfinished = [], tmp_path / "unfinished"

    def train(stop_after: int = 9) -> Detector:
        def progress(done: int, total: int) -> None:
            made.append(done)
            if done == stop_after:
                raise KeyboardInterrupt

        return train_detector(scenes, unfinished, steps=6, size=2, progress=progress)

    whole = train().weights
    unfinished.unlink()
    for stop_after in (3, 4):
        with pytest.raises(KeyboardInterrupt):
            train(stop_after)
    resumed = train().weights
    assert made == [*range(1, 7), 1, 2, 3, 3, 4, 5, 6]
    assert all((np.asarray(resumed[name]) == np.asarray(whole[name])).all() for name in whole)
    unfinished.write_bytes(unfinished.read_bytes()[:1000])
    with pytest.raises(ConfigError, match="unfinished cannot be read .*; remove it"):
        train()


def test_what_a_stop_leaves_is_said_as_it_is(monkeypatch, capsys):
    """It was said to begin anew, detector and all."""

    def stopped(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setenv("HMA_DEBUG", "1")  # the test's process is not the program's own
    monkeypatch.setattr(simulators, "load_simulator", stopped)
    for program, words in (
        ("in_place", "starts again from the beginning, but keeps what there is of the detector"),
        ("detector", "continues from here"),
    ):
        monkeypatch.setattr(sys, "argv", [program, "RUN"])
        with pytest.raises(SystemExit) as end:
            runpy.run_path(f"{ROOT}/experiments/applications/{program}.py", run_name="__main__")
        assert end.value.code == 130
        assert capsys.readouterr().err == f"interrupted; the same command {words}\n"


@pytest.mark.slow
def test_a_detector_is_made_of_a_run_s_robots(simulator, tmp_path, monkeypatch):
    few = {"EPISODES": 4, "MIN_EPISODES": 2, "PER_EPISODE": 2, "HELD_OUT": (2, 2), "STEPS": 1, "STEPS_PER_ROBOT": 1}
    for name, value in few.items():
        monkeypatch.setattr(detector_module, name, value)
    made = make_detector(list(simulator.robots), simulator.tokenizer, tmp_path)
    assert made.robots == ("pusher_sand", "gripper_wood")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["detector.npz", "errors.csv"]


def test_a_detector_sees_frames_as_small_as_the_run_s():
    tokenizer, scenes = parts()[1], draw_scenes(SPECS["pusher_sand"], "train", 2, 2, 0)
    given, shown = (f(tokenizer, scenes) for f in (resized, reconstructed))
    size = tokenizer.image_size
    assert given.images.shape == scenes.images.shape
    np.testing.assert_array_equal(given.images[:, :: 64 // size, :: 64 // size], fit_images(scenes.images, size))
    assert (shown.images != given.images).any()
    half = reconstructed(tokenizer, scenes, every=2).images
    np.testing.assert_array_equal(half[::2], shown.images[::2])
    np.testing.assert_array_equal(half[1::2], given.images[1::2])
    with pytest.raises(ConfigError, match="cannot be enlarged"):
        enlarged(np.zeros((1, 48, 48, 3), np.uint8))
