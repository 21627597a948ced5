"""The table of the fifty robots: what a scaling study and `hma adapt` rely on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.suite.embodiments import EMBODIMENTS, TRAINED, UNSEEN, siblings, strangers
from data_pipelines.suite.generate import MAX_EPISODES, MIN_EPISODES, episode_count
from data_pipelines.suite.rollout import episode_lengths, episode_seeds
from hma_jax.config import ConfigError

BY_NAME = {spec.name: spec for spec in EMBODIMENTS}


def test_ten_families_of_five_eight_of_them_trained_on():
    families = {s.family: [s, *siblings(s)] for s in EMBODIMENTS}
    assert len(EMBODIMENTS) == len(BY_NAME) == 50 and len(families) == 10
    assert {len(robots) for robots in families.values()} == {5}
    assert (len(TRAINED), len(UNSEEN)) == (40, 10)
    assert not {s.family for s in TRAINED} & {s.family for s in UNSEEN}


def test_siblings_share_what_makes_them_siblings_and_differ_in_the_rest():
    for spec in EMBODIMENTS:
        for other in siblings(spec):
            for shared in ("convention", "physics", "task", "action_dim", "dict_actions", "points"):
                assert getattr(spec, shared) == getattr(other, shared), (spec.name, other.name, shared)
            assert [type(c) for c in spec.controls] == [type(c) for c in other.controls]
            for own in ("body", "controls", "camera", "hz", "episodes", "palette"):
                assert getattr(spec, own) != getattr(other, own), (spec.name, other.name, own)


def test_every_robot_has_a_family_of_strangers_with_equally_many_action_values():
    assert {s.action_dim for s in EMBODIMENTS} == {2, 3, 4, 8, 28}
    assert all(len(strangers(s)) == 5 and len({t.family for t in strangers(s)}) == 1 for s in EMBODIMENTS)


def test_the_table_is_as_heterogeneous_as_promised():
    assert {s.convention for s in EMBODIMENTS} == {"absolute", "delta", "velocity"}
    assert {2, 4, 6, 8, 10, 12, 16, 20, 30} <= {s.hz for s in EMBODIMENTS}
    assert min(s.seconds[0] for s in EMBODIMENTS) == 1 and max(s.seconds[1] for s in EMBODIMENTS) == 60
    assert sum(s.video_only for s in TRAINED) == 4 and not any(s.video_only for s in UNSEEN)
    assert sum(s.delay > 0 for s in EMBODIMENTS) >= 8
    assert {s.family for s in EMBODIMENTS if s.dict_actions} == {"humanoid", "mobile"}
    assert all(s.episodes >= 64 for s in UNSEEN), "robots are adapted to with up to 64 trajectories"


def test_sizes_spread_over_decades_and_the_smallest_stay_small():
    for scale, largest in ((1.0, MAX_EPISODES), (8.0, 8 * MAX_EPISODES)):
        counts = [episode_count(s, scale) for s in EMBODIMENTS]
        assert (min(counts), max(counts)) == (MIN_EPISODES, largest)
        below = [sum(c < 10**k for c in counts) for k in (1, 2, 3)]
        assert below[0] >= 5 and below[1] - below[0] >= 10 and below[2] - below[1] >= 10
    assert {episode_count(s, 1e-3) for s in EMBODIMENTS} == {MIN_EPISODES}
    order = sorted(EMBODIMENTS, key=lambda s: s.episodes)
    assert [episode_count(s, 8.0) for s in order] == sorted(episode_count(s, 8.0) for s in order)


def test_the_suite_is_about_a_minute_s_work():
    """Frames at scale 1, which is what making it costs."""
    frames = sum(
        episode_lengths(s, episode_seeds(s, count, 0, split)).sum()
        for s in EMBODIMENTS
        for split, count in (("train", s.episodes), ("val", 24))
    )
    assert 150_000 < frames < 320_000


@pytest.mark.parametrize("count", [5, 10, 20, 40])
def test_every_prefix_of_the_order_is_diverse(count):
    prefix = TRAINED[:count]
    assert len({s.family for s in prefix}) == min(count, 8)
    assert len({s.convention for s in prefix}) >= (2 if count == 5 else 3)
    assert len({s.hz for s in prefix}) >= 3
    if count <= 20:
        assert not any(s.video_only for s in prefix)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"name": "Not-snake"}, "not snake_case"),
        ({"hz": 0}, "hz must lie in 1..60"),
        ({"seconds": (0.5, 3.0)}, "seconds must be"),
        ({"seconds": (4.0, 61.0)}, "seconds must be"),
        ({"controls": ()}, "controls must move every joint once"),
        ({"delay": -1}, "delay must not be negative"),
    ],
)
def test_an_entry_that_cannot_be_is_refused(change, message):
    with pytest.raises(ConfigError, match=message):
        replace(EMBODIMENTS[0], **change)


def test_what_moves_is_seen_at_32_pixels():
    """Objects and tools are at least three and a half pixels in radius or, fingers, beside something that is."""
    for spec in EMBODIMENTS:
        pixels = 16 * spec.camera.zoom * spec.camera.tilt
        assert spec.task.size * pixels > 3.2, spec.name
        assert max(link.radius + link.half_width for link in spec.body.links) * pixels > 2, spec.name


def test_lengths_lie_within_their_bounds():
    for spec in EMBODIMENTS:
        seconds = episode_lengths(spec, episode_seeds(spec, 64, 0)) / spec.hz
        low, high = spec.seconds
        assert seconds.min() >= low - 0.5 / spec.hz and seconds.max() <= high + 0.5 / spec.hz
        assert np.quantile(seconds, 0.9) >= 6.5, f"{spec.name}: hardly an episode gives a window of 12 frames"
