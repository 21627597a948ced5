"""Wrapping angles are found while actions are read for tokenising, whatever the entry says of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.registry.toml_file import load_entries, to_toml
from data_pipelines.tokens.turns import EARLY, TurnWatch
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec(dims=(2, 3))


def episode(seed: int, steps: int = 40) -> np.ndarray:
    """Values that are: a drifting position, noise, an angle that wraps, a switch between both ends, a slow angle."""
    random = np.random.default_rng(seed)
    turning = 0.5 * np.arange(steps) + random.uniform(0, 6)
    columns = (
        np.arange(steps) / 50,
        random.normal(size=steps),
        (turning + np.pi) % (2 * np.pi) - np.pi,
        np.where(random.random(steps) < 0.5, -np.pi, np.pi),
        np.linspace(-3, 3, steps),
    )
    return np.stack(columns, 1).astype(np.float32)


def watched(spec, episodes: int, change=lambda rows: rows) -> tuple[TurnWatch, list[str]]:
    said: list[str] = []
    watch = TurnWatch(spec, said.append)
    for i in range(episodes):
        watch.see(change(episode(i)))
    return watch, said


def test_an_angle_is_named_by_its_field_once_and_soon():
    watch, said = watched(SPEC, EARLY - 1)
    assert not said
    watch.see(episode(EARLY))
    (text,) = said
    assert text.startswith("toy: action/part_1: value 0 jumps by a whole turn")
    assert 'angles = [2] and angle_form = "sine_cosine"' in text and "--replace tokens" in text
    watch.see(episode(EARLY + 1))
    watch.look()
    assert len(said) == 1


def test_of_few_episodes_it_is_told_at_the_end():
    watch, said = watched(SPEC, 3)
    assert not said
    watch.look()
    assert len(said) == 1


def test_an_angle_that_jumps_late_is_told_too():
    watch, said = watched(SPEC, EARLY + 3, lambda rows: np.where(np.arange(5) == 2, rows / 10, rows))
    assert not said
    watch.see(episode(0))
    watch.look()
    assert len(said) == 1 and "value 0 jumps" in said[0]


@pytest.mark.parametrize("form", ["unwrapped", "sine_cosine"])
def test_angles_that_the_entry_lists_are_not_told(form):
    watch, said = watched(replace(SPEC, angles=(2,), angle_form=form), EARLY)
    watch.look()
    assert not said


def test_degrees_are_told_as_degrees():
    watch, said = watched(SPEC, 3, np.degrees)
    watch.look()
    assert (
        len(said) == 1
        and 'angles = [2] and angle_form = "sine_cosine" (or "unwrapped") and angle_unit = "degree"' in said[0]
    )


def test_video_without_actions_has_none():
    watch = TurnWatch(replace(SPEC, action_keys=(), action_dims=()), pytest.fail)
    watch.see(np.zeros((4, 0), np.float32))
    watch.look()


def test_tokenising_tells_and_stores_the_same(tmp_path):
    def turn(number, features):
        features["steps/action/part_1"] = episode(number, len(features["steps/action/part_1"]))[:, 2:]

    directory, said = write_rlds(tmp_path, SPEC, [20] * 8, change=turn), []
    told = tokenize_dataset(SPEC, directory, FakeTokenizer(), tmp_path / "told", warn=said.append)
    silent = tokenize_dataset(SPEC, directory, FakeTokenizer(), tmp_path / "silent")
    assert len(said) == 1 and "angles = [2]" in said[0]
    assert told == silent
    tokenize_dataset(SPEC, directory, FakeTokenizer(), tmp_path / "told", warn=said.append)
    assert len(said) == 1  # nothing was read


def test_a_job_that_ends_early_tells_what_it_saw(tmp_path):
    """It goes on after its finished parts, whose episodes are not read again."""

    def turn(number, features):
        features["steps/action/part_1"] = episode(number, len(features["steps/action/part_1"]))[:, 2:]

    def stop(done, total):
        if done:
            raise KeyboardInterrupt

    directory, said = write_rlds(tmp_path, SPEC, [40] * 8, change=turn), []
    with pytest.raises(KeyboardInterrupt):
        tokenize_dataset(SPEC, directory, FakeTokenizer(), tmp_path / "told", warn=said.append, progress=stop)
    assert len(said) == 1 and "angles = [2]" in said[0]


def test_what_is_advised_is_an_entry_that_is_not_told_again(tmp_path):
    watch, said = watched(SPEC, 3)
    watch.look()
    lines = said[0].partition("Write ")[2].partition(" (or")[0].replace(" and ", "\n")
    (tmp_path / "my.toml").write_text(f"{to_toml(SPEC)}{lines}\n")
    watch, said = watched(load_entries(tmp_path / "my.toml")[0], EARLY)
    watch.look()
    assert not said
