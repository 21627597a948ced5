"""Films of a tiny simulator beside a truth that is made up, killed and gone on with."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from data_pipelines.sources.rlds.images import fit_images
from data_pipelines.suite.rollout import episode_seeds, simulate
from experiments.applications.detector_network import Detections
from experiments.applications.endurance import films
from experiments.applications.endurance.drives import make_drive
from experiments.applications.endurance.films import Film, make_films
from experiments.applications.endurance.hidden import Event, judge
from experiments.simulators import load_simulator
from hma_jax.config import ConfigError, DecodeConfig
from hma_jax.evaluation.metrics import psnr
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from tests.experiments.applications.runs import make_run
from tests.hma_jax.simulator.small import ROBOTS, actions, simulator, start


class Driven:
    """In place of a `Drive`, of a robot that no suite has."""

    def __init__(self, robot: int, frames: int):
        rng = np.random.default_rng(robot)
        self.robot, self.start = ROBOTS[robot], start(robot, 2)
        self.actions = actions(robot, frames, rng)
        self._true = rng.integers(0, 256, (frames + 1, 8, 8, 3), np.uint8)

    def __len__(self) -> int:
        return len(self.actions)

    def frames(self, first: int, stop: int) -> np.ndarray:
        return self._true[first:stop]

    def points(self) -> SimpleNamespace:
        spread = np.arange(len(self) + 1.0)
        return SimpleNamespace(position=spread[:, None, None] + [[[1, 2]]], share=spread[:, None] > 2)


def watch(name: str, frames: np.ndarray) -> SimpleNamespace:
    grey = frames.mean((1, 2, 3))
    return SimpleNamespace(position=grey[:, None, None] * [[[1, 2]]], confidence=grey[:, None] / 255)


def test_each_frame_of_a_film_is_measured_beside_the_true_one_of_the_same_time():
    rng, times = np.random.default_rng(0), np.arange(11.0)
    film, true = rng.integers(0, 256, (2, 4, 8, 8, 3), np.uint8)
    first = rng.integers(0, 256, (8, 8, 3), np.uint8)
    points = SimpleNamespace(position=np.repeat(times[:, None, None], 2, 2), share=times[:, None] / 10)
    drive = SimpleNamespace(robot=SimpleNamespace(name="a"))
    found = films._measure_block(SimpleNamespace(detect=watch), drive, points, 5, film, true, first)
    film, true = film[1:], true[1:]
    seen, seen_true = watch("a", film), watch("a", true)
    grey, true_grey = (images.astype(float).reshape(3, -1) for images in (film, true))
    expected = {
        "psnr": psnr(film, true), "still": psnr(np.stack([first] * 3), true),
        "true_position": [[[6, 6]], [[7, 7]], [[8, 8]]], "true_share": [[0.6], [0.7], [0.8]],
        "position": seen.position, "confidence": seen.confidence,
        "seen_position": seen_true.position, "seen_confidence": seen_true.confidence,
        "level": grey.mean(1) - true_grey.mean(1), "variance": grey.var(1) / true_grey.var(1),
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_allclose(found[name], values, rtol=1e-5, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("slide", ["exact", "streaming"])
def test_films_that_a_kill_cut_short_go_on_and_come_out_the_same(slide, tmp_path, monkeypatch):
    monkeypatch.setattr(films, "BLOCK", 4)
    decode = DecodeConfig(2, temperature=1.0, slide=slide)

    def make(path, progress=lambda done, total: None) -> dict[str, Film]:
        one = simulator(episodes=2, decode=decode, history=1)
        return make_films(one, SimpleNamespace(detect=watch), [Driven(0, 10), Driven(1, 6)], path, progress)

    killed, whole = tmp_path / "films" / "a.npz.unfinished", make(tmp_path / "b.npz.unfinished")
    with pytest.raises(InterruptedError):
        make(killed, lambda done, total: _kill() if done == 7 else None)
    made: list[int] = []
    again = make(killed, lambda done, total: made.append(done))
    assert made == [5, 6, 7, 8, 9, 10]
    for name, film in whole.items():
        for f in dataclasses.fields(Film):
            np.testing.assert_array_equal(getattr(again[name], f.name), getattr(film, f.name), err_msg=f.name)
    killed.write_bytes(killed.read_bytes()[:-100])
    with pytest.raises(
        ConfigError, match="a.npz.unfinished cannot be read .* remove it; the same command then films from"
    ):
        make(killed)


def _kill() -> None:
    raise InterruptedError


@pytest.mark.slow
def test_frames_smaller_than_a_detector_s_are_enlarged_for_it(tmp_path):
    """A run that has fewer pixels than the suite's frames: refused after a block had been simulated."""
    table = EmbodimentTable((Embodiment("pusher_sand", 2, 1, (0.0, 0.0), (2.0, 2.0)),))
    simulator, seen = load_simulator(make_run(tmp_path, table=table)), []

    def see(robot: str, frames: np.ndarray) -> Detections:
        seen.append(frames)
        return Detections(np.zeros((len(frames), 4, 2)), np.ones((len(frames), 4)))

    detector, robot, size = SimpleNamespace(detect=see), simulator.robots["pusher_sand"], simulator.tokenizer.image_size
    drive = make_drive(robot, simulator.starts[0], 2, "behaviour", seed=0)
    film = make_films(simulator, detector, [drive], tmp_path / "a.npz.unfinished")["pusher_sand"]
    np.testing.assert_array_equal(film.shown[0, 0], fit_images(drive.frames(1, 2), size)[0])
    rollout = simulate(drive.spec, episode_seeds(drive.spec, 1, 0, "val"))
    [row] = judge(simulator, detector, drive.spec, rollout, [Event("hidden", 0, 2, 0, 1, 2)])
    assert row["robot"] == "pusher_sand" and {frames.shape[1:] for frames in seen} == {(64, 64, 3)} and len(seen) == 4
