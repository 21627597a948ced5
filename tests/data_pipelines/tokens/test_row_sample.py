"""Quantiles of a dataset's actions: exact while rows are few, within what is stated beyond, the same for everyone."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.loading.selection import LoaderConfig, select_windows, training_table
from data_pipelines.tokens import row_sample
from data_pipelines.tokens import store as store_module
from data_pipelines.tokens.manifest_file import load_manifest
from data_pipelines.tokens.row_sample import (
    QUANTILES,
    ROWS,
    ActionRange,
    RowSample,
    RowSampler,
    merge_samples,
    rows_of_part,
)
from data_pipelines.tokens.store import TokenStore
from hma_jax.config.json import from_dict, to_dict
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec("toy", (3,))


def make_rows(episode: int, steps: int) -> np.ndarray:
    return np.random.default_rng(episode).normal(size=(steps, 2)).astype(np.float32) * [1, 100]


def sample_of(episodes: dict[int, np.ndarray], limit: int = ROWS) -> RowSample:
    sampler = RowSampler(limit)
    for number, rows in episodes.items():
        sampler.add(rows, number)
    return sampler.sample()


def test_quantiles_of_few_rows_are_exact():
    episodes = {e: make_rows(e, 40 + e) for e in range(8)}
    rows = np.concatenate(list(episodes.values()))
    expected = np.quantile(rows, QUANTILES, axis=0, method="inverted_cdf")
    assert sample_of(episodes).quantiles() == tuple(map(tuple, expected.astype(np.float32).tolist()))


def test_quantiles_of_many_rows_are_those_of_a_random_sample():
    """Rows that drift within an episode and between episodes, as actions do."""
    episodes = {e: np.sin(e / 50 + np.arange(200) / 60)[:, None].astype(np.float32) for e in range(500)}
    rows = np.sort(np.concatenate(list(episodes.values()))[:, 0])
    for q, (value,) in zip(QUANTILES, sample_of(episodes).quantiles(), strict=True):
        share = np.searchsorted(rows, value, side="right") / len(rows)
        assert abs(share - q) < 4 * np.sqrt(q * (1 - q) / ROWS)


def test_neither_order_nor_pieces_change_a_bit():
    episodes = {e: make_rows(e, 100) for e in range(120)}  # 12,000 rows
    whole = sample_of(episodes)
    backwards = sample_of(dict(reversed(episodes.items())))
    thirds = [sample_of({e: rows for e, rows in episodes.items() if e % 3 == k}) for k in range(3)]
    assert whole == backwards == merge_samples(thirds) == merge_samples(thirds[::-1])
    assert from_dict(RowSample, json.loads(json.dumps(to_dict(whole)))) == whole
    assert len(whole.arrays()[0]) == ROWS


def test_what_all_parts_keep_is_small_and_yet_the_smallest_of_all():
    parts = 64
    pieces = [sample_of({p: make_rows(p, 1000)}, rows_of_part(parts)) for p in range(parts)]
    assert merge_samples(pieces) == sample_of({p: make_rows(p, 1000) for p in range(parts)})
    for parts in (1, 7, 64, 1024, 100_000):
        assert 32 <= rows_of_part(parts) <= ROWS
        assert rows_of_part(parts) == 32 or parts * rows_of_part(parts) <= 8 * ROWS + parts


def test_video_alone_has_no_quantiles():
    assert sample_of({0: np.zeros((5, 0), np.float32)}).quantiles() == ()
    assert merge_samples([RowSample()]) == RowSample()


def test_manifest_keeps_the_quantiles_whoever_makes_the_parts(tmp_path):
    rlds = write_rlds(tmp_path, SPEC, [5, 6, 7, 8, 9, 10, 11, 12], shards=2)
    alone = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "one", part_size=500)

    def join(_: int):
        return tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "three", part_size=500)

    with ThreadPoolExecutor(3) as pool:
        shared, *others = pool.map(join, range(3))
    rows = np.float32([(e, t, 0) for e in alone.train.episodes for t in range(5 + e)])
    expected = np.quantile(rows, QUANTILES, axis=0, method="inverted_cdf")
    assert alone.action_quantiles == tuple(map(tuple, expected.tolist()))
    assert len(alone.train.parts) > 3
    texts = [(tmp_path / store / "toy/manifest.json").read_bytes() for store in ("one", "three")]
    assert texts[0] == texts[1] and [shared, *others] == [alone] * 3


# --- as the scale of actions --------------------------------------------------------------------


def test_quantiles_become_minus_one_and_one_and_back():
    table = EmbodimentTable((Embodiment("arm", 2, 2, (0.0, 5.0), (3.0, 1e-9), low=(-2.0, 5.0), high=(6.0, 5.0)),))
    raw = np.float32([[[-2, 5, 6, 5.1], [2, 5, 10, 5]]])
    given = np.asarray(table.scale().normalise(raw, np.array([0])))
    np.testing.assert_allclose(given, [[[-1, 0, 1, 0], [0, 0, 2, 0]]])  # not cut off; dead values are 0
    back = np.asarray(table.scale().unnormalise(given, np.array([0])))
    np.testing.assert_allclose(back, [[[-2, 5, 6, 5], [2, 5, 10, 5]]])


def test_the_scale_is_an_option_and_off_by_default(tmp_path):
    rlds = write_rlds(tmp_path, SPEC, [30] * 8)
    manifest = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    store = TokenStore(tmp_path / "store")
    (plain,) = store.embodiment_table(["toy"], rate=2.0).entries
    scaled = manifest.embodiment(scale="quantiles", rate=2.0)
    assert (plain.low, plain.high, plain.centre, plain.unit) == ((), (), plain.mean, plain.std)
    assert (scaled.low[:2], scaled.high[:2]) == (
        manifest.action_quantiles[0][:2], manifest.action_quantiles[-1][:2],
    )  # fmt: skip
    assert replace(scaled, low=(), high=()) == plain


@pytest.mark.parametrize("rounding", [0.0, 1e-8])
def test_a_value_that_moves_in_less_than_a_hundredth_is_measured_by_its_extremes(rounding, tmp_path):
    """Not by what rounding leaves of it in the others, of which such a move were millions."""

    def change(episode, features):
        actions = features["steps/action"]
        actions[1:, 2] = rounding * np.random.default_rng(episode).uniform(size=len(actions) - 1)
        actions[0, 2] = 4 if episode == 3 else 0

    rlds = write_rlds(tmp_path, SPEC, [60] * 8, change=change)
    manifest = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", min_val=0, val_fraction=0.0)
    assert manifest.action_quantiles[0][2] == 0 <= manifest.action_quantiles[-1][2] <= rounding
    scaled = manifest.embodiment(scale="quantiles", rate=2.0)
    assert (scaled.low[2], scaled.high[2]) == (0, 4)


def test_the_episodes_that_are_sampled_are_known_before_any_is_read(monkeypatch):
    monkeypatch.setattr(row_sample, "PIECE", 50)
    rng = np.random.default_rng(0)
    numbers, steps = rng.permutation(1000)[:60], rng.integers(0, 40, 60)
    sampler = RowSampler(25)
    for number, count in zip(numbers.tolist(), steps.tolist(), strict=True):
        sampler.add(np.full((count, 1), number), number)
    sampled = set(sampler.sample().arrays()[1][:, 0].astype(int).tolist())
    assert set(numbers[row_sample.sampled_episodes(numbers, steps, 25)].tolist()) == sampled
    assert len(row_sample.sampled_episodes(numbers, steps)) == (steps > 0).sum()


def test_quantiles_of_some_trajectories_read_those_that_are_sampled_alone(tmp_path, monkeypatch):
    """Of millions all would take hours, at every start. A constant value needs no more."""

    def change(episode, features):
        features["steps/action"][:] = np.random.default_rng(episode).normal(size=(120, 3))
        features["steps/action"][:, 1] = 5

    manifest = tokenize_dataset(
        SPEC, write_rlds(tmp_path, SPEC, [120] * 8, change=change), FakeTokenizer(), tmp_path / "s"
    )
    store, read = TokenStore(tmp_path / "s"), set()
    whole = store.action_range("toy", range(len(manifest.train.episodes)))
    assert whole == ActionRange(manifest.action_quantiles)
    assert manifest.embodiment(scale="quantiles", action_range=whole, rate=2.0) == manifest.embodiment(
        scale="quantiles", rate=2.0
    )
    real, few = store.episode, row_sample.sampled_episodes
    monkeypatch.setattr(store, "episode", lambda *place: read.add(place[2]) or real(*place))
    monkeypatch.setattr(store_module, "sampled_episodes", lambda *rows: few(*rows, 2))
    store.action_range("toy", range(len(manifest.train.episodes)))
    assert 1 <= len(read) <= 2


def test_quantiles_of_some_trajectories_are_of_those_alone(tmp_path):
    """Their extremes too, which stand in where a value moves in less than a hundredth of the steps."""

    def change(episode, features):
        features["steps/action"][0, 2] = 1 + episode

    rlds = write_rlds(tmp_path, SPEC, [120] * 8, change=change)
    manifest = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    store = TokenStore(tmp_path / "store")
    whole = store.action_range("toy", range(len(manifest.train.episodes)))
    assert (whole.quantiles, whole.low, whole.high) == (
        manifest.action_quantiles, manifest.action_min, manifest.action_max,
    )  # fmt: skip
    config = LoaderConfig(frames=6, max_trajectories=1)
    (used,) = select_windows(store, config).sets["toy"].episodes.tolist()
    (scaled,) = training_table(store, config, "quantiles").entries
    number = manifest.train.episodes[used]
    assert (scaled.low[0], scaled.high[0], scaled.high[1], scaled.low[2], scaled.high[2]) == (
        number, number, 118, 0, 1 + number,
    )  # fmt: skip
    assert number + 1 < manifest.action_max[2]


def test_a_store_without_quantiles_is_read_and_says_what_it_lacks(tmp_path):
    rlds = write_rlds(tmp_path, SPEC, [6] * 6)
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    path = tmp_path / "store/toy/manifest.json"
    values = json.loads(path.read_text())
    del values["action_quantiles"]
    path.write_text(json.dumps(values))
    manifest = load_manifest(path)
    assert manifest.embodiment(rate=2.0).low == ()
    with pytest.raises(DataError, match="toy: .* has no quantiles of actions.*train.action_scale=deviation"):
        manifest.embodiment(scale="quantiles", rate=2.0)
