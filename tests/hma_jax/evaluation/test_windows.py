"""Tables of windows, on disk and summed up, and two models on the same windows."""

import math
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hma_jax.config import ConfigError
from hma_jax.evaluation.statistics import mean_and_sem
from hma_jax.evaluation.summary import Summary, paired_difference, summarise
from hma_jax.evaluation.windows import FILE, WindowTable, join


def as_float32(x: np.ndarray) -> np.ndarray:
    return x.astype(np.float32).astype(np.float64)


def make_table(name: str = "arm", seed: int = 0, episodes: int = 8, each: int = 3) -> WindowTable:
    """Two metrics, as devices compute them; windows of an episode resemble each other; the last one is short."""
    rng = np.random.default_rng(seed)
    n = episodes * each
    psnr = 20 + np.repeat(rng.normal(size=episodes), each) + 0.1 * rng.normal(size=n)
    return WindowTable(
        np.full(n, name),
        np.repeat(np.arange(episodes) * 7, each),
        np.tile(np.arange(each) * 12, episodes),
        np.where(np.arange(n) == n - 1, 5, 12),
        {"psnr": as_float32(psnr), "cross_entropy": as_float32(np.abs(rng.normal(size=n)))},
    )


def test_a_table_survives_the_disk_to_the_last_bit(tmp_path):
    table = join([make_table("arm", 0), make_table("base", 1)])
    table.metrics["psnr"][:3] = [math.nan, math.inf, np.float32(0.1)]
    table.save(tmp_path / FILE, "t0")
    again = WindowTable.load(tmp_path / FILE)
    assert again.names == table.names and again.datasets == ("arm", "base")
    np.testing.assert_array_equal(again.frames, table.frames)
    for metric, column in table.metrics.items():
        np.testing.assert_array_equal(again.metrics[metric], column)
    (tmp_path / "more").mkdir()
    again.save(tmp_path / "more" / FILE, "t0")
    assert (tmp_path / "more" / FILE).read_bytes() == (tmp_path / FILE).read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["more", FILE]


def test_a_table_shows_itself_in_a_line():
    """Not the numbers of every window."""
    table = join([make_table("arm", 0), make_table("base", 1)])
    assert repr(table) == "<48 windows of arm, base: psnr, cross_entropy>"


def test_any_program_reads_it_as_a_long_table(tmp_path):
    make_table(episodes=1, each=2).save(tmp_path / FILE, "t0")
    table = pq.read_table(tmp_path / FILE)
    assert table.column_names == ["trial", "robot", "episode", "window", "frames", "metric", "value"]
    assert table.schema.field("value").type == pa.float32()
    assert all(pa.types.is_dictionary(table.schema.field(name).type) for name in ("trial", "robot", "metric"))
    rows = table.to_pylist()
    assert [(r["trial"], r["robot"], r["window"], r["frames"], r["metric"]) for r in rows] == [
        ("t0", "arm", 0, 12, "psnr"), ("t0", "arm", 12, 5, "psnr"),
        ("t0", "arm", 0, 12, "cross_entropy"), ("t0", "arm", 12, 5, "cross_entropy"),
    ]  # fmt: skip


def test_a_damaged_table_is_named(tmp_path):
    make_table().save(tmp_path / FILE, "t0")
    whole = (tmp_path / FILE).read_bytes()
    for content in (b"", b"csv", whole[:-20], flipped(whole, 100)):
        (tmp_path / FILE).write_bytes(content)
        with pytest.raises(ConfigError, match=f"{FILE}: the table of windows cannot be read"):
            WindowTable.load(tmp_path / FILE)
    (tmp_path / FILE).unlink()
    with pytest.raises(ConfigError, match="the table of windows cannot be read"):
        WindowTable.load(tmp_path / FILE)


def flipped(content: bytes, at: int) -> bytes:
    return content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]


def test_no_flipped_bit_gives_other_numbers(tmp_path):
    table = make_table()
    table.save(tmp_path / FILE, "t0")
    whole, refused = (tmp_path / FILE).read_bytes(), 0
    places = range(0, len(whole), 17)
    for at in places:
        (tmp_path / FILE).write_bytes(flipped(whole, at))
        try:
            again = WindowTable.load(tmp_path / FILE)
        except ConfigError:
            refused += 1
            continue
        assert again.names == table.names and list(again.metrics) == list(table.metrics)
        for metric, column in table.metrics.items():
            np.testing.assert_array_equal(again.metrics[metric], column)
    assert refused > len(places) / 2


def test_a_table_whose_metrics_are_of_different_windows_is_refused(tmp_path):
    long = make_table().to_arrow("t0")
    moved = long.set_column(2, "episode", pa.array(np.r_[7, long["episode"].to_numpy()[1:]], pa.int32()))
    for table, why in (
        (moved, "cross_entropy has other windows than psnr"),
        (long.slice(0, len(long) - 1), "has other windows"),
        (long.drop_columns(["frames"]), "frames"),
        (pa.concat_tables([long, make_table().to_arrow("t1")]), "no trial, or several"),
    ):
        pq.write_table(table, tmp_path / FILE)
        with pytest.raises(ConfigError, match=f"the table of windows cannot be read .*{why}"):
            WindowTable.load(tmp_path / FILE)


def test_all_means_follow_from_the_table():
    table = join([make_table("arm", 0), make_table("base", 1, episodes=4)])
    summary = summarise(table, perplexity_group=4)
    own = table.of("base")
    assert summary.datasets["base"]["psnr"] == mean_and_sem(own.metrics["psnr"], own.episode)
    losses = own.metrics["cross_entropy"]
    groups = [np.exp(losses[i : i + 4].mean()) for i in range(0, 12, 4)]
    assert summary.datasets["base"]["perplexity"].mean == pytest.approx(np.mean(groups))
    assert summary.datasets["base"]["perplexity_corpus"].mean == pytest.approx(np.exp(losses.mean()))
    overall = summary.overall["psnr"]
    assert overall.mean == pytest.approx(np.mean([s["psnr"].mean for s in summary.datasets.values()]))
    assert (overall.n, overall.episodes) == (36, 12)
    assert Summary.from_dict(summary.to_dict()) == summary


def test_what_some_windows_have_not_is_of_those_that_have_it():
    """No metric where none has; no error where there is one episode alone."""
    table = join([make_table("arm", 0), make_table("base", 1, episodes=4), make_table("alone", 2, episodes=1)])
    nats = np.where(table.dataset == "arm", np.nan, table.metrics["psnr"])
    nats[table.dataset == "base"] *= np.where(np.arange((table.dataset == "base").sum()) % 3, 1, np.nan)
    table = replace(table, metrics={**table.metrics, "action_nats": nats})
    found = summarise(table, 4).datasets
    assert "action_nats" not in found["arm"] and np.isnan(found["alone"]["psnr"].sem)
    own = table.of("base")
    there = ~np.isnan(own.metrics["action_nats"])
    assert 0 < there.sum() < len(own)
    assert found["base"]["action_nats"] == mean_and_sem(own.metrics["action_nats"][there], own.episode[there])


def test_a_difference_is_taken_window_by_window_whatever_their_order():
    a = join([make_table("arm", 0), make_table("base", 1), make_table("mine", 2)])
    shift = {name: column + 0.5 for name, column in a.metrics.items()}
    b = replace(a, metrics=shift).rows(np.random.default_rng(0).permutation(len(a)))
    theirs = b.rows(np.flatnonzero(b.dataset != "mine"))
    difference = paired_difference(theirs, a, 1)
    assert set(difference.datasets) == {"arm", "base"}
    for stats in difference.datasets.values():
        assert stats["psnr"].mean == pytest.approx(0.5) and stats["psnr"].sem < 1e-12
        assert (stats["psnr"].n, stats["psnr"].episodes) == (24, 8)


def test_a_difference_has_the_error_of_the_differences_by_episode():
    a, b = make_table(seed=0), make_table(seed=1)
    found = paired_difference(a, b, 1).datasets["arm"]
    want = mean_and_sem(a.metrics["psnr"] - b.metrics["psnr"], a.episode)
    assert found["psnr"].mean == pytest.approx(want.mean) and found["psnr"].sem == pytest.approx(want.sem)
    # Perplexities: the delta method on both at once, here against the scatter under small changes.
    losses = [t.metrics["cross_entropy"] for t in (a, b)]
    assert found["perplexity_corpus"].mean == pytest.approx(np.exp(losses[0].mean()) - np.exp(losses[1].mean()))
    slopes = [np.exp(x.mean()) * x for x in losses]
    assert found["perplexity_corpus"].sem == pytest.approx(mean_and_sem(slopes[0] - slopes[1], a.episode).sem)


def test_other_windows_or_other_datasets_are_not_compared():
    a = make_table()
    with pytest.raises(
        ConfigError, match=r"only one of the two evaluations has window \('arm', 0, 0\) \(and 1 others\)"
    ):
        paired_difference(a, a.rows(np.arange(2, len(a))), 1)
    twice = a.rows(np.r_[0, np.arange(len(a) - 1)])
    with pytest.raises(ConfigError, match=r"an evaluation contains a window twice: \('arm', 0, 0\)"):
        paired_difference(a, twice, 1)
    with pytest.raises(ConfigError, match="without a common dataset"):
        paired_difference(a, make_table("base"), 1)
    with pytest.raises(ConfigError, match="no windows"):
        join([])
    with pytest.raises(ConfigError, match="differ in length"):
        replace(a, episode=a.episode[1:])
