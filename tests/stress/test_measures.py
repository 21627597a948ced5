"""The programs that measure at scale, at the smallest."""

from __future__ import annotations

import pytest

from data_pipelines.registry import get_spec
from experiments.applications.generating.trajectories import RldsTrajectories
from experiments.applications.judging.outcomes import HEAD, LEARNED, STATE, TRUE, Outcome, write_outcomes
from experiments.applications.judging.real import read_real
from experiments.applications.policies.tasks import find_task
from hma_jax.simulator.robots import Robot
from tests.stress import openx_scale, recordings


def test_sizes_of_the_made_up_openx():
    episodes, shards = openx_scale.sizes(1.0)
    assert len(episodes) == 40 and abs(episodes.sum() - 3_000_000) < 30 and abs(shards.sum() - 10_000) < 40
    assert episodes.max() / episodes.min() == pytest.approx(10_000, rel=0.05) and (shards <= episodes).all()


def test_recordings_of_a_known_truth_are_read_as_a_robot_s_without_a_simulator(tmp_path):
    demos = recordings.make(find_task("pusher_sand", "reach", frames=8), 6, to_success=True)
    recordings.write(demos, "pusher_sand", tmp_path, rest=3)
    zeros = (0.0, 0.0)
    place = str(tmp_path / "pusher_sand")
    read = RldsTrajectories(place, "train", get_spec("pusher_sand"), Robot("pusher_sand", 1, zeros, zeros, zeros), 64)
    for i, length in enumerate(demos.lengths.tolist()):
        assert (read.rewards(i)[3:] == demos.reached[i, :length]).all() and len(read[i]) == length + 3
        assert not read[i].chunks[:3].any() and (read[i].chunks[3:, 0] == demos.actions[i, :length]).all()
        assert read.outline(i).success == demos.successes[i]
    said = [("cloned-9", TRUE, STATE, True), ("cloned-9", TRUE, STATE, False), ("random", TRUE, STATE, False)]
    others = [("diffusion-3", TRUE, STATE, True), ("cloned-9", TRUE, HEAD, True), ("cloned-9", LEARNED, HEAD, True)]
    said += [("cloned-20", TRUE, STATE, True)]
    write_outcomes(
        [Outcome(p, i, 0, 0, w, j, s) for i, (p, w, j, s) in enumerate(said + others)], tmp_path / "outcomes.csv"
    )
    recordings.write_truth(tmp_path, tmp_path)
    assert read_real(tmp_path / "real.csv") == {"own-9": (1, 2), "random": (0, 1), "own-20": (1, 1)}


@pytest.mark.slow
def test_made_up_openx_is_made_once_and_measured(tmp_path):
    figures = openx_scale.run(0.0001, tmp_path, windows=2000)
    assert figures["episodes"] == openx_scale.sizes(0.0001)[0].sum() > 500 and figures["shards"] == 40
    assert figures["second_start_s"] < figures["first_index_s"]
    assert figures["rss_last_mb"] < figures["rss_first_mb"] + 30 and figures["open_files"] < 600
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "rlds").rglob("*")}
    openx_scale.make_datasets(tmp_path / "rlds", 0.0001)
    assert before == {p: p.stat().st_mtime_ns for p in (tmp_path / "rlds").rglob("*")}


@pytest.mark.slow
def test_index_in_a_slow_and_failing_store_is_the_local_one():
    for module in ("moto", "s3fs", "upath"):
        pytest.importorskip(module)
    from tests.stress.remote_index import run

    figures = run(shards=4, latency=0.01, failing=0.05)
    assert figures["equal"] and figures["records"] == 400
