"""The host's record of an episode: what is stored, taken back and branched off of it."""

import numpy as np

from hma_jax.simulator.episode import as_arrays, from_arrays
from tests.hma_jax.simulator.small import chunks_of, simulator, start


def test_a_snapshot_from_a_file_is_gone_on_from_and_taken_back(tmp_path):
    """By a simulator whose same episodes have begun anew."""
    sim, other = simulator(episodes=2), simulator(episodes=2)
    for one in (sim, other):
        one.reset([start(0, 1), start(1, 2)], seeds=[3, 4])
    plan = chunks_of(0, 9)
    for chunk in plan[:6]:
        sim.step([chunk, None])
    np.savez(tmp_path / "kept.npz", **as_arrays(sim.snapshot()))
    with np.load(tmp_path / "kept.npz") as file:
        other.restore(from_arrays(file, other.snapshot()))
    np.testing.assert_array_equal(other.images, sim.images)
    assert other.counts == sim.counts == (7, 2)
    for one in (sim, other):
        one.rewind(2, [0])
    for chunk in plan[4:]:
        np.testing.assert_array_equal(other.step([chunk, None]), sim.step([chunk, None]))


def test_a_frame_that_was_begun_at_the_native_rate_is_stored_and_forgotten_by_going_back():
    actions = chunks_of(2, 2).reshape(6, 3)  # three of a frame
    sim, other = simulator(rate="native"), simulator(rate="native")
    for one in (sim, other):
        one.reset(start(2, 2))
    first = [sim.step([action]) for action in actions[:3]][-1]
    sim.step([actions[3]])
    kept = {name: x.copy() for name, x in as_arrays(sim.snapshot()).items()}
    second = [sim.step([action]) for action in actions[4:]][-1]
    other.restore(from_arrays(kept, other.snapshot()))
    np.testing.assert_array_equal([other.step([action]) for action in actions[4:]][-1], second)
    sim.step([actions[0]])
    before = sim.rewind(2)
    again = [sim.step([action]) for action in actions[:3]]
    np.testing.assert_array_equal(again, [before, before, first])


def test_what_goes_on_from_a_copy_of_an_episode_leaves_its_record_alone():
    """Else what was kept, or branched off, is taken back to frames of another episode."""
    sim, plan = simulator(episodes=2), chunks_of(1, 3)
    first = sim.reset(start(1, 1))
    sim.branch([0, 0])
    sim.step([plan[0], None])
    assert sim.counts == (2, 1)
    kept = sim.snapshot()
    for _ in range(2):
        sim.step([plan[1], plan[2]])
        assert sim.counts == (3, 2)
        sim.restore(kept)
        assert sim.counts == (2, 1)
    sim.rewind(1, [0])
    np.testing.assert_array_equal(sim.images, first)
