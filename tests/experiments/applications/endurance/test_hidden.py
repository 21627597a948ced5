"""Tables of objects that come back: of one model each, and only where there are any."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from data_pipelines.suite.rollout import episode_seeds, simulate
from data_pipelines.suite.simulator import SPECS, suite_robot
from experiments.applications.detector_network import Detections
from experiments.applications.endurance import hidden
from experiments.applications.scenes import point_names, points_of
from hma_jax.config import ConfigError, DecodeConfig

ROBOT = suite_robot("pusher_sand", (-8.0, -8.0), (8.0, 8.0), (0.0, 0.0), 1)
FOUND = {"gone": 2, "lag": 4, "found": 1.0, "close": 1.0, "true_found": 1.0, "true_close": 1.0}


@pytest.fixture
def watch(tmp_path, monkeypatch):
    """The program with a model that decodes at some temperature and whose objects all come back, or none."""
    monkeypatch.setattr(hidden, "EPISODES", 2)
    monkeypatch.setattr(hidden.Detector, "load", lambda path: None)
    monkeypatch.setattr(hidden, "native_robots", lambda robots: robots)
    rows = [{"robot": ROBOT.name, "kind": kind, **FOUND} for kind in ("hidden", "control")]
    monkeypatch.setattr(hidden, "judge", lambda *_: rows)
    (tmp_path / "detector.npz").touch()

    def watched(run: str, *options: str, temperature: float = 0.0, some: bool = True) -> None:
        decode = DecodeConfig(temperature=temperature)
        known = SimpleNamespace(
            model=SimpleNamespace(params={}),
            tokenizer=SimpleNamespace(channels=0),
            decode=decode,
            robots={ROBOT.name: ROBOT},
        )
        monkeypatch.setattr(hidden, "load_simulator", lambda *_, **__: known)
        monkeypatch.setattr(hidden, "find_events", lambda *_: rows if some else [])
        told = ["hidden", run, "--out", str(tmp_path), "--detector", str(tmp_path / "detector.npz"), *options]
        monkeypatch.setattr(sys, "argv", told)
        hidden.main()

    return watched


def test_models_of_one_directory_have_their_own_tables(watch, tmp_path):
    watch("first", "--name", "grown")
    watch("second", "--name", "weighed")
    tables = {path.name for path in tmp_path.glob("*.csv")}
    assert tables == {"grown_hidden.csv", "weighed_hidden.csv"}
    before = (tmp_path / "grown_hidden.csv").stat().st_mtime_ns
    with pytest.raises(ConfigError, match="run: 'first' -> 'second'"):
        watch("second", "--name", "grown")
    with pytest.raises(ConfigError, match="temperature: 0.0 -> 1.0"):
        watch("first", "--name", "grown", temperature=1.0)
    assert (tmp_path / "grown_hidden.csv").stat().st_mtime_ns == before


def test_where_nothing_is_hidden_that_is_said(watch):
    with pytest.raises(ConfigError, match="no object is hidden and comes back in held-out episodes of pusher_sand"):
        watch("first", some=False)


def test_a_row_says_how_far_its_object_moved_and_how_far_off_it_is_found():
    """Here it is found where it is in the model's frames, which are black, and where it was before in the true one."""
    spec, lag = SPECS[ROBOT.name], 20
    rollout = simulate(spec, episode_seeds(spec, 4, 0, "val"))
    positions = [
        points_of(spec, np.repeat(seed, len(q)), q, objects).position
        for seed, q, objects in zip(rollout.seeds, rollout.q, rollout.objects, strict=True)
    ]
    far = [np.linalg.norm(at[3 + lag] - at[3], axis=-1)[1:] for at in positions]  # without the tool
    episode = int(np.argmax([x.max() for x in far]))
    point = 1 + int(far[episode].argmax())
    black = np.zeros((1, 64, 64, 3), np.uint8)
    simulator = SimpleNamespace(
        robots={ROBOT.name: ROBOT}, tokenizer=SimpleNamespace(image_size=64), reset=lambda *_, **__: black,
        step=lambda _: black,
    )  # fmt: skip

    def detect(robot: str, images: np.ndarray) -> Detections:
        t = 3 if images.any() else 3 + lag
        return Detections(positions[episode][[t]], np.ones((1, len(point_names(spec)))))

    event = hidden.Event("control", episode, 3, point, 0, lag)
    (row,) = hidden.judge(simulator, SimpleNamespace(detect=detect), spec, rollout, [event])
    assert row["moved_px"] == row["true_px"] == pytest.approx(far[episode].max()) and row["moved_px"] > 4
    assert (row["px"], row["close"], row["true_close"]) == (0, 1, 0)


def test_the_model_is_judged_at_the_end_of_each_event_under_the_actions_recorded_until_then():
    """Events of different lengths are made in one batch."""
    spec, points = SPECS[ROBOT.name], len(point_names(SPECS[ROBOT.name]))
    rollout, given = simulate(spec, episode_seeds(spec, 2, 0, "val")), []

    def show(made: int) -> np.ndarray:
        return np.full((2, 64, 64, 3), made, np.uint8)

    def step(actions: list[np.ndarray]) -> np.ndarray:
        given.append(np.stack(actions))
        return show(len(given))

    def detect(robot: str, images: np.ndarray) -> Detections:
        return Detections(np.zeros((1, points, 2)), np.full((1, points), images[0, 0, 0, 0] / 255))

    starts = []
    simulator = SimpleNamespace(
        robots={ROBOT.name: ROBOT}, tokenizer=SimpleNamespace(image_size=64), step=step,
        reset=lambda these, **_: starts.extend(these) or show(0),
    )  # fmt: skip
    events = [hidden.Event("hidden", 0, 3, 1, 2, 4), hidden.Event("control", 1, 5, 1, 0, 7)]
    rows = hidden.judge(simulator, SimpleNamespace(detect=detect), spec, rollout, events)
    assert [row["confidence"] for row in rows] == [4 / 255, 7 / 255]
    assert [(len(start.images), len(start.actions)) for start in starts] == [(4, 3), (6, 5)]
    for b, event in enumerate(events):
        recorded = rollout.actions[event.episode, event.start : event.start + event.lag]
        executed = np.stack(given)[: event.lag, b]
        np.testing.assert_array_equal(executed, ROBOT.clip_to_range(recorded, "clip")[0])
