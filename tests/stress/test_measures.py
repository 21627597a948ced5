"""The programs that measure at scale, at the smallest."""

from __future__ import annotations

import pytest

from tests.stress import openx_scale


def test_sizes_of_the_made_up_openx():
    episodes, shards = openx_scale.sizes(1.0)
    assert len(episodes) == 40 and abs(episodes.sum() - 3_000_000) < 30 and abs(shards.sum() - 10_000) < 40
    assert episodes.max() / episodes.min() == pytest.approx(10_000, rel=0.05) and (shards <= episodes).all()


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
