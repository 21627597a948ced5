"""What is found, what is close and what follows, on films that are made up."""

import dataclasses
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from experiments.applications.endurance.__main__ import main, print_rows, true_starts_of
from experiments.applications.endurance.films import Film, colour_histogram, load_films, save_films
from experiments.applications.endurance.hidden import HORIZON, MIN_HIDDEN, find_events
from experiments.applications.endurance.tables import MEASURES, measure, motion, over_robots, read_rows, rows_of
from experiments.tables import write_rows
from hma_jax.config import ConfigError
from hma_jax.simulator.robots import Robot
from hma_jax.simulator.starts import Start

N = 200


def film(**changes) -> Film:
    """A tool and two objects, of which one is never there, all found where they are."""
    rng = np.random.default_rng(0)
    true = rng.uniform(5, 60, (N, 3, 2)).astype(np.float32)
    share = np.tile(np.float32([1, 1, 0]), (N, 1))
    sure = share * 0.9
    made = dict(
        psnr=np.full(N, 20.0), still=np.full(N, 15.0), true_position=true, true_share=share, position=true.copy(),
        confidence=sure, seen_position=true.copy(), seen_confidence=sure.copy(), level=np.zeros(N), variance=np.ones(N),
        histogram=np.zeros(N), shown=np.zeros((2, 1, 4, 4, 3), np.uint8),
    )  # fmt: skip
    return Film(**(made | changes))


def test_found_is_not_close_and_what_is_not_there_does_not_count():
    whole, right = slice(0, N), film()
    found = measure(right, whole, tools=1)
    assert found["tool_close"] == found["object_close"] == found["object_found"] == found["true_object_close"] == 1
    off = right.position.copy()
    off[::2, 1] += 3.0  # by 4.2 pixels
    off[:, 2] += 30.0  # of what is not there
    moved = measure(film(position=off), whole, tools=1)
    assert moved["object_found"] == 1 and moved["object_close"] == 0.5 and moved["tool_close"] == 1
    unsure = right.confidence.copy()
    unsure[: N // 4, 1] = 0.1
    lost = measure(film(confidence=unsure), whole, tools=1)
    assert lost["object_found"] == lost["object_close"] == lost["object_sure"] == 0.75
    unsure[: N // 2, 1] = 0.4
    found = measure(film(confidence=unsure), whole, tools=1)
    assert (found["object_found"], found["object_sure"], found["tool_sure"]) == (1, 0.5, 1)


def test_motion_follows_or_does_not():
    def seen(position: np.ndarray) -> tuple[float, float]:
        found = measure(film(position=position.astype(np.float32)), slice(0, N), 1)
        return found["follows"], found["moves"]

    true = film().true_position
    assert min(seen(true + 20.0)) > 0.999  # elsewhere, but moving as told
    other = np.random.default_rng(1).uniform(5, 60, true.shape)
    assert max(map(abs, seen(other))) < 0.25
    follows, moves = seen(64 - true)
    assert follows < -0.999 and moves > 0.999
    assert seen(np.full_like(true, 30.0)) == (0.0, 0.0)


def test_a_robot_that_is_turned_otherwise_still_steers():
    """Its heading drifts by two turns, and it does what it is told; mirrored it turns the other way."""
    rng = np.random.default_rng(0)
    steps = rng.uniform(1, 6, N) * np.exp(1j * np.cumsum(rng.normal(0, 0.4, N)))

    def seen(path: np.ndarray) -> dict[str, float]:
        position = np.stack([path.real, path.imag], -1)[:, None].astype(np.float32)
        return motion(np.stack([true.real, true.imag], -1)[:, None], position, np.ones((N, 1), bool), "")

    true = np.cumsum(steps)
    drifting = seen(np.cumsum(steps * np.exp(4j * np.pi * np.arange(N) / N)))
    assert abs(drifting["follows"]) < 0.3 and drifting["moves"] > 0.999 and drifting["steers"] > 0.99
    assert seen(true.conj())["steers"] == pytest.approx(0.0, abs=1e-5)  # 1 along, -1 aside
    other = np.cumsum(rng.uniform(1, 6, N) * np.exp(1j * np.cumsum(rng.normal(0, 0.4, N))))
    assert abs(seen(other)["steers"]) < 0.2
    assert seen(np.zeros(N))["steers"] == 0.0


def test_rows_are_of_whole_parts_and_are_read_again(tmp_path):
    films = {"a": film(), "b": film(psnr=np.full(N, 24.0)), "c": film()}
    save_films(films, tmp_path / "x" / "films.npz")
    again = load_films(tmp_path / "x" / "films.npz")
    for f in dataclasses.fields(Film):
        np.testing.assert_allclose(getattr(again["b"], f.name), getattr(films["b"], f.name), rtol=1e-6)
    rows = rows_of("v", "behaviour", 0, again, {"a": 4.0, "b": 6.0, "c": 7.0}, dict.fromkeys("abc", 1), seconds=10.0)
    assert [r["part"] for r in rows if r["robot"] == "a"] == [1, 2, 3, 4, 5]
    assert [r["part"] for r in rows if r["robot"] == "b"] == [1, 2, 3]  # 20 frames of 60 are left: too few
    assert [r["part"] for r in rows if r["robot"] == "c"] == [1, 2, 3]  # 60 of 70 are not
    write_rows(tmp_path / "rows.csv", [r for r in rows if r["robot"] != "c"])
    mean, half, n = over_robots([r for r in read_rows(tmp_path / "rows.csv") if r["part"] == 1], "psnr")
    assert (mean, n) == (22.0, 2) and half == pytest.approx(12.7062 * 2, rel=1e-5)  # of two robots little is known


def test_a_drive_too_short_for_a_row_is_refused_before_it_is_made(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["endurance", "nowhere", "--minutes", "0.4"])
    with pytest.raises(ConfigError, match="--every 60: .* --minutes 0.4 are 24; give a smaller --every"):
        main()
    monkeypatch.setattr(sys, "argv", ["endurance", "nowhere", "--starts", "0"])
    with pytest.raises(ConfigError, match="--starts must be at least 1, got 0"):
        main()


def test_starts_that_there_are_not_are_missed_before_anything_is_filmed():
    starts = [Start("a", np.zeros((1, 8, 8, 3), np.uint8), np.zeros((0, 2)), seed) for seed in (3, None, 5)]
    simulator, robots = SimpleNamespace(starts=starts), {"a": Robot("a", 1, (0.0,) * 2, (1.0,) * 2, (0.0,) * 2)}
    assert [s.seed for s in true_starts_of(simulator, robots, 2)["a"]] == [3, 5]
    with pytest.raises(ConfigError, match="--starts 3: a has only 2 starts"):
        true_starts_of(simulator, robots, 3)


def test_a_measure_that_no_robot_has_is_not_a_number_of_none(recwarn, capsys):
    row = {"variant": "v", "drive": "d", "robot": "a", "start": 0, "part": 1} | dict.fromkeys(MEASURES, 0.5)
    assert over_robots([row | {"steers": float("nan")}], "steers")[2] == 0
    print_rows([row | {"steers": float("nan")}])
    assert "steers –" in capsys.readouterr().out and not recwarn


def test_histograms_are_of_colours():
    red, blue = (np.broadcast_to(np.uint8(c), (2, 4, 4, 3)) for c in ([255, 0, 0], [0, 0, 255]))
    assert colour_histogram(red).sum() == 1 and 0.5 * np.abs(colour_histogram(red) - colour_histogram(blue)).sum() == 1


def test_events_are_of_what_vanishes_and_comes_back():
    share = np.ones((4, 20, 2), np.float32)
    share[0, 6:11, 1] = 0.0  # gone for five frames
    share[1, 6:, 1] = 0.0  # never back
    share[2, 6 : 6 + MIN_HIDDEN - 1, 1] = 0.0  # too short
    events = find_events(share, np.array([20, 20, 20, 20]), 1, np.random.default_rng(0))
    hidden = [e for e in events if e.kind == "hidden"]
    assert [(e.episode, e.start, e.gone, e.lag) for e in hidden] == [(0, 5, 5, 6)]
    (control,) = [e for e in events if e.kind == "control"]
    assert (control.episode, control.start, control.lag) == (3, 5, 6), "the model has seen as many frames of it"
    share[3, 11, 1] = 0.0  # when it is judged
    assert [e.kind for e in find_events(share, np.full(4, 20), 1, np.random.default_rng(0))] == ["hidden"]
    share[3, 11, 1] = 1.0
    ended = np.array([20, 20, 20, 11])  # the frame before
    assert [e.kind for e in find_events(share, ended, 1, np.random.default_rng(0))] == ["hidden"]


def test_what_comes_back_after_too_long_is_no_event():
    share = np.ones((2, HORIZON + 20, 2), np.float32)
    share[0, 6 : 6 + HORIZON, 1] = 0.0  # back one frame too late
    share[1, 6 : 5 + HORIZON, 1] = 0.0
    events = find_events(share, np.full(2, HORIZON + 20), 1, np.random.default_rng(0))
    assert [(e.episode, e.lag) for e in events if e.kind == "hidden"] == [(1, HORIZON)]
