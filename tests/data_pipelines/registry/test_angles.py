"""Angles that wrap: what an entry says of them, and what becomes of the actions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.inspection.inspect import inspect_dataset
from data_pipelines.inspection.suggest import suggest_entry
from data_pipelines.registry import get_spec
from data_pipelines.registry.angles import convert_angles
from data_pipelines.registry.toml_file import load_entries, to_toml
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec("toy", (3,))


def roll(episode: int, steps: int) -> np.ndarray:
    """An angle that turns on, from -1.5 (one and a half) upwards, in radians."""
    return episode - 1.5 + 0.4 * np.arange(steps)


def wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi


@pytest.fixture
def rlds(tmp_path):
    def change(episode, features):
        actions = features["steps/action"]
        actions[:, 2] = wrapped(roll(episode, len(actions)))

    return write_rlds(tmp_path, SPEC, [20] * 6, change=change)


@pytest.mark.parametrize(("unit", "turn"), [("radian", 2 * np.pi), ("degree", 360.0), ("turn", 1.0)])
def test_unwrapped_angle_goes_on_from_its_first_value(unit, turn):
    true = np.linspace(0.1, 2.3, 40) * turn
    recorded = np.stack([(true + turn / 2) % turn - turn / 2, np.arange(40)], axis=1)
    given = convert_angles(recorded, (0,), "unwrapped", unit)
    assert given.dtype == np.float32 and np.array_equal(given[:, 1], np.arange(40))
    np.testing.assert_allclose(given[:, 0], true, rtol=1e-6)
    np.testing.assert_allclose(convert_angles(recorded[30:], (0,), "unwrapped", unit)[0, 0], recorded[30, 0], rtol=1e-6)


def test_sine_and_cosine_stand_in_the_angle_s_place():
    recorded = np.float32([[7, 90, 8], [7, -180, 8]])
    given = convert_angles(recorded, (1,), "sine_cosine", "degree")
    np.testing.assert_allclose(given, [[7, 1, 0, 8], [7, 0, -1, 8]], atol=1e-6)


def test_without_angles_not_a_bit_changes():
    recorded = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    assert np.array_equal(SPEC.convert(recorded), recorded)
    two = replace(SPEC, angles=(1,), angle_form="sine_cosine").convert(recorded)
    assert np.array_equal(two[:, [0, 3]], recorded[:, [0, 2]])


def test_stored_actions_are_as_the_entry_says_and_have_no_jump(tmp_path, rlds):
    for form, width in (("unwrapped", 3), ("sine_cosine", 4)):
        spec = replace(SPEC, angles=(2,), angle_form=form)
        manifest = tokenize_dataset(spec, rlds, FakeTokenizer(), tmp_path / form)
        embodiment = manifest.embodiment(rate=2.0)
        assert spec.action_dim == embodiment.action_dim == len(manifest.action_mean) == width
        episode = TokenStore(tmp_path / form).episode("toy", "train", 0)
        assert np.abs(np.diff(episode.actions[:, 2:], axis=0)).max() < 0.41
        angle = episode.actions[:, 2] if form == "unwrapped" else np.arctan2(*episode.actions[:, 2:].T)
        np.testing.assert_allclose(wrapped(angle), wrapped(roll(episode.episode, 20)), atol=1e-5)


def test_the_layout_is_part_of_what_identifies_the_data(tmp_path, rlds):
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    unwrapped = replace(SPEC, angles=(2,), angle_form="unwrapped")  # of the same width
    with pytest.raises(ConfigError, match="with other settings.*spec.angle_form: 'as_recorded' -> 'unwrapped'"):
        tokenize_dataset(unwrapped, rlds, FakeTokenizer(), tmp_path / "store")


@pytest.mark.parametrize("degrees", [False, True])
def test_inspection_suggests_an_entry_that_mends_it(tmp_path, degrees):
    def change(episode, features):
        actions = features["steps/action"]
        actions[:, 1] = wrapped(roll(episode, len(actions))) * (180 / np.pi if degrees else 1)
        actions[-1, 2] = 1

    directory = write_rlds(tmp_path, SPEC, [20] * 6, change=change)
    suggestion = suggest_entry(inspect_dataset(directory).facts, 4)
    spec = suggestion.spec()
    assert (spec.action_keys, spec.angles, spec.angle_form) == (("action[:2]",), (1,), "sine_cosine")
    assert spec.angle_unit == ("degree" if degrees else "radian") and spec.action_dim == 3
    (tmp_path / "my.toml").write_text(suggestion.table())
    assert load_entries(tmp_path / "my.toml") == (spec,)


def test_droid_s_roll_and_yaw_are_given_without_their_jumps():
    for name in ("droid", "droid_sample"):
        spec = get_spec(name)
        assert (spec.angles, spec.angle_form, spec.action_dim) == ((3, 5), "sine_cosine", 9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"angles": (3,)}, "angles must be increasing positions in its 3 action values"),
        ({"angles": (1, 1)}, "angles must be increasing"),
        ({"angles": (-1,)}, "angles must be increasing"),
        ({"angle_form": "unwrapped"}, "needs the list of values that are angles"),
    ],
)
def test_entry_whose_angles_cannot_be_right_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        replace(SPEC, **change)


def test_unknown_form_in_a_file_is_named(tmp_path):
    text = to_toml(replace(SPEC, angles=(2,), angle_form="unwrapped"))
    (tmp_path / "my.toml").write_text(text.replace('"unwrapped"', '"sincos"'))
    with pytest.raises(ConfigError, match="my.toml: toy.angle_form: 'sincos' is not allowed; .*sine_cosine"):
        load_entries(tmp_path / "my.toml")
