from __future__ import annotations

import itertools
import re
import resource
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.loading.loader import describe_batch, make_loader
from data_pipelines.loading.selection import LoaderConfig, select_windows, training_table
from data_pipelines.sources.identity import describe
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import ConfigError
from hma_jax.model.embodiments import EmbodimentTable
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

STATM = Path("/proc/self/statm")
CONFIG = LoaderConfig(frames=6, batch=16, seed=3)


def take(store, table, count, config=CONFIG, **options):
    return list(itertools.islice(make_loader(store, table, config, **options), count))


def same(a, b):
    return set(a) == set(b) and all(np.array_equal(a[k], b[k]) for k in a)


# --- what a batch holds ------------------------------------------------------------------------


def test_batch_has_the_agreed_shapes_and_types(store, table):
    (batch,) = take(store, table, 1)
    assert {k: (v.shape, v.dtype.name) for k, v in batch.items()} == {
        "tokens": ((16, 6, 4), "int32"),
        "actions": ((16, 6, 30), "float32"),
        "embodiment": ((16,), "int32"),
        "real": ((16, 6), "bool"),
    }


def test_latents_come_in_the_windows_of_the_ids(store, latent_store, table):
    ids, latents = take(store, table, 3), take(latent_store, table, 3)
    for a, b in zip(ids, latents, strict=True):
        assert b["tokens"].shape == (16, 6, 4, 3) and b["tokens"].dtype == np.float32
        assert np.array_equal(b["tokens"][..., 0] * 256 + b["tokens"][..., 1], a["tokens"])
        np.testing.assert_allclose(b["tokens"][..., 2], b["tokens"][..., 1] / 3, rtol=1e-3)
        assert np.array_equal(a["actions"], b["actions"])


def test_every_row_is_one_window_with_its_own_actions(store, table):
    """The fixture's tokens and actions both say (episode, step)."""
    for batch in take(store, table, 12):
        rows = zip(batch["tokens"], batch["actions"], batch["embodiment"], strict=True)
        for tokens, actions, embodiment in rows:
            entry = table.entries[embodiment]
            stride, dim = entry.stride, entry.action_dim
            episode, step = tokens[:, 0] // 256, tokens[:, 0] % 256
            assert (np.diff(step) == stride).all() and len(set(episode)) == 1
            chunk = actions[:, : stride * dim].reshape(6, stride, dim)
            assert (chunk[..., 0] == episode[0]).all()
            assert (chunk[..., 1] == step[:, None] + np.arange(stride)).all()
            assert (actions[:, stride * dim :] == 0).all()
        assert batch["real"].all()


def test_held_out_episodes_are_never_seen(store, table):
    held = {name: set(store.manifest(name).val.episodes) for name in store.names}
    for batch in take(store, table, 40):
        for tokens, embodiment in zip(batch["tokens"], batch["embodiment"], strict=True):
            assert tokens[0, 0] // 256 not in held[table.names[embodiment]]


def test_batches_mix_embodiments(store, table):
    assert all(len(set(batch["embodiment"].tolist())) == 3 for batch in take(store, table, 20))


def test_datasets_are_drawn_with_the_cube_root_of_their_windows(store, table):
    mixture = select_windows(store, CONFIG).mixture
    counts = {n: len(s) for n, s in select_windows(store, CONFIG).sets.items()}
    assert max(counts.values()) > 5 * min(counts.values())
    root = np.cbrt([counts[n] for n in mixture.names])
    seen = np.concatenate([b["embodiment"] for b in take(store, table, 200)])
    frequency = np.bincount(seen, minlength=3)[[table.index(n) for n in mixture.names]] / len(seen)
    np.testing.assert_allclose(frequency, root / root.sum(), atol=0.005)


def test_an_epoch_visits_every_window_once(store):
    table = store.embodiment_table(("base",), rate=2.0)
    config = LoaderConfig(frames=6, batch=5, datasets=("base",))
    n = len(select_windows(store, config).sets["base"])
    assert n % 5 == 0
    for epoch in range(2):
        batches = take(store, table, n // 5, config, start_step=epoch * n // 5)
        assert len({int(t) for b in batches for t in b["tokens"][:, 0, 0]}) == n


# --- order ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("processes", [2, 4, 16])
def test_global_batch_does_not_depend_on_the_number_of_processes(store, table, processes):
    whole = take(store, table, 4)
    rows = np.split(np.arange(CONFIG.batch), processes)
    parts = [take(store, table, 4, rows=own) for own in rows]
    for step, batch in enumerate(whole):
        joined = {k: np.concatenate([part[step][k] for part in parts]) for k in batch}
        assert same(batch, joined)


@pytest.mark.parametrize("rows", [None, np.arange(CONFIG.batch // 2, CONFIG.batch)], ids=["alone", "one-of-two"])
@pytest.mark.parametrize("datasets", [(), ("arm",)])
def test_resuming_at_every_step_continues_exactly(datasets, rows, store, table):
    """A mixture and a single dataset; alone and as one of two processes."""
    config = replace(CONFIG, datasets=datasets)
    straight = take(store, table, 9, config, rows=rows)
    for start in range(9):
        rest = take(store, table, 2, config, start_step=start, rows=rows)
        for batch, expected in zip(rest, straight[start:], strict=False):
            assert same(batch, expected)


def test_the_records_of_a_batch_are_those_that_its_rows_were_read_from(store, table):
    """The fixture's tokens say (episode, step)."""
    for step, batch in enumerate(take(store, table, 3)):
        records = describe_batch(store, table, CONFIG, step)
        assert len(records) == CONFIG.batch
        for tokens, embodiment, record in zip(batch["tokens"], batch["embodiment"], records, strict=True):
            name, place, frame = re.fullmatch(r"(\w+): (.*), from frame (\d+)", record).groups()
            assert name == table.names[embodiment] and int(frame) == tokens[0, 0] % 256
            assert place == describe(store.manifest(name).runs, tokens[0, 0] // 256)


def test_resuming_with_other_processes_and_threads_continues_exactly(store, table):
    straight = take(store, table, 4)
    parts = [
        take(store, table, 2, start_step=2, rows=own, threads=4 * p)
        for p, own in enumerate(np.split(np.arange(CONFIG.batch), 2))
    ]
    for k in (0, 1):
        assert same(straight[2 + k], {n: np.concatenate([p[k][n] for p in parts]) for n in straight[0]})


def test_far_steps_cost_nothing(store, table):
    assert take(store, table, 1, start_step=10**9)[0]["tokens"].shape == (16, 6, 4)


@pytest.mark.skipif(not STATM.exists(), reason="needs /proc")
def test_memory_stays_flat(store, table):
    """A loader that keeps what it has read grows by 20 kB a batch here."""

    def resident() -> int:
        return int(STATM.read_text().split()[1]) * resource.getpagesize()

    loader = make_loader(store, table, CONFIG)
    for _ in range(200):
        next(loader)
    before = resident()
    for _ in range(600):
        next(loader)
    assert resident() - before < 6e6


def test_seed_changes_the_order(store, table):
    assert not same(take(store, table, 1)[0], take(store, table, 1, replace(CONFIG, seed=4))[0])


def test_a_dataset_more_does_not_reorder_the_others(store):
    few, more = ("arm", "base"), ("arm", "base", "hand")
    orders = []
    for names in (few, more):
        table = store.embodiment_table(names, rate=2.0)
        batches = take(store, table, 12, replace(CONFIG, datasets=names))
        rows = [(e, t[0, 0]) for b in batches for e, t in zip(b["embodiment"], b["tokens"], strict=True)]
        orders.append([t for e, t in rows if e == 0][:40])
    assert orders[0] == orders[1]


# --- subsets, control ------------------------------------------------------------------------------


def test_small_subset_is_inside_the_large_one(store):
    table = store.embodiment_table(("arm",), rate=2.0)
    seen = []
    for limit in (2, 10, None):
        config = LoaderConfig(frames=6, batch=16, datasets=("arm",), max_trajectories=limit)
        seen.append({int(t) // 256 for b in take(store, table, 40, config) for t in b["tokens"][:, 0, 0]})
    assert [len(s) for s in seen] == [2, 10, 38]
    assert seen[0] < seen[1] < seen[2]


def test_shuffled_actions_change_the_actions_and_nothing_else(store, table):
    true = take(store, table, 6)
    shuffled = take(store, table, 6, replace(CONFIG, shuffle_actions=True))
    other, rows = 0, 0
    for a, b in zip(true, shuffled, strict=True):
        assert np.array_equal(a["tokens"], b["tokens"]) and np.array_equal(a["embodiment"], b["embodiment"])
        changed = a["actions"][:, 0, 0] != b["actions"][:, 0, 0]  # value 0 is the episode's number
        other, rows = other + changed.sum(), rows + len(changed)
        for row, embodiment in zip(b["actions"], b["embodiment"], strict=True):
            entry = table.entries[embodiment]  # a whole window of the same dataset's train split
            assert (row[:, entry.chunk :] == 0).all() and len(set(row[:, 0])) == 1
            assert int(row[0, 0]) in store.manifest(entry.name).train.episodes
            assert (np.diff(row[:, 1]) == entry.stride).all()
    assert other == rows
    again = take(store, table, 6, replace(CONFIG, shuffle_actions=True))
    assert all(map(same, shuffled, again))


def test_a_window_meets_other_actions_on_each_visit(store):
    """Otherwise a wrong pair could be learnt by heart."""
    table = store.embodiment_table(("base",), rate=2.0)
    config = LoaderConfig(frames=20, batch=10, datasets=("base",), shuffle_actions=True)  # one window each
    pairs: dict[int, set[int]] = {}
    for batch in take(store, table, 24, config):
        for tokens, actions in zip(batch["tokens"], batch["actions"], strict=True):
            pairs.setdefault(int(tokens[0, 0]) // 256, set()).add(int(actions[0, 0]))
    assert np.mean([len(p) for p in pairs.values()]) > 4
    assert not any(own in met for own, met in pairs.items())


# --- errors ----------------------------------------------------------------------------------------


def store_of(tmp_path, lengths: dict[str, list[int]], hz=4, **options) -> TokenStore:
    for name, steps in lengths.items():
        spec = make_spec(name, hz=hz)
        tokenize_dataset(spec, write_rlds(tmp_path, spec, steps), FakeTokenizer(), tmp_path / "store", **options)
    return TokenStore(tmp_path / "store")


def test_short_episodes_fill_up_their_windows_with_what_is_marked(tmp_path):
    """At 4 Hz natively 8 steps are four frames; one of 3 steps is too short to learn from."""
    store = store_of(tmp_path, {"mixed": [8, 30, 3] * 5})
    config = LoaderConfig(frames=6, batch=4)
    short = sum(n < 4 for n in store.manifest("mixed").train.steps)
    assert select_windows(store, config).sets["mixed"].too_short == short >= 3
    seen = set()
    for batch in take(store, store.embodiment_table(("mixed",), rate=2.0), 12, config):
        for real, tokens, actions in zip(batch["real"], batch["tokens"], batch["actions"], strict=True):
            count = int(real.sum())
            seen.add(count)
            assert real.tolist() == [t < count for t in range(6)]
            assert (tokens[count:] == 0).all() and (actions[count:] == 0).all()
            assert (np.diff(tokens[:count, 0]) == 2).all()
            assert (actions[:count, :6].reshape(count, 2, 3)[..., 1] == tokens[:count, :1] % 256 + [0, 1]).all()
    assert seen == {4, 6}


def test_shuffled_actions_reach_every_real_frame(tmp_path):
    """Those of a shorter window are repeated; frames that are none get none."""
    store = store_of(tmp_path, {"mixed": [8, 30] * 5})
    config = LoaderConfig(frames=6, batch=4)
    table = store.embodiment_table(("mixed",), rate=2.0)
    pairs = zip(
        take(store, table, 12, config), take(store, table, 12, replace(config, shuffle_actions=True)), strict=True
    )
    for true, shuffled in pairs:
        assert np.array_equal(true["real"], shuffled["real"]) and np.array_equal(true["tokens"], shuffled["tokens"])
        given = shuffled["actions"][..., 0]  # the number of the episode
        assert len(set(given[0][true["real"][0]])) == 1 and (given[~true["real"]] == 0).all()
        assert (given[true["real"]] != true["actions"][..., 0][true["real"]]).all()


def test_windows_of_a_single_episode_meet_actions_of_another_window_of_it(tmp_path):
    """There is no other episode to take them from."""
    store = store_of(tmp_path, {"single": [40, 40]}, min_val=1, max_val=1)
    config, table = LoaderConfig(frames=6, batch=15), store.embodiment_table(("single",), rate=2.0)
    assert len(store.manifest("single").train.episodes) == 1 and len(select_windows(store, config).sets["single"]) >= 10
    pairs = zip(*(take(store, table, 8, replace(config, shuffle_actions=s)) for s in (False, True)), strict=True)
    for true, shuffled in pairs:
        assert np.array_equal(true["tokens"], shuffled["tokens"])
        assert (true["actions"] != shuffled["actions"]).any(axis=(1, 2)).all()


def test_dataset_without_windows_is_dropped_and_reported(tmp_path):
    store = store_of(tmp_path, {"long": [20] * 6, "short": [3] * 6})
    selected = select_windows(store, LoaderConfig(frames=6, batch=4))
    assert set(selected.mixture.names) == {"long"}
    assert "a window has at least 2 frames, which at stride 2 need 4 native frames" in selected.mixture.dropped["short"]
    table = store.embodiment_table(("short", "long"), rate=2.0)
    (batch,) = take(store, table, 1, LoaderConfig(frames=6, batch=4))
    assert set(batch["embodiment"].tolist()) == {1}
    with pytest.raises(
        DataError, match="short: a window has at least 2 frames, .* longest of its 5 train episodes has 3"
    ):
        make_loader(store, table, LoaderConfig(frames=6, batch=4, datasets=("short",)))


@pytest.mark.parametrize("weighed", ["used", "all"])
def test_a_dataset_whose_drawn_trajectories_were_all_skipped_is_dropped_and_reported(tmp_path, weighed):
    """It has other windows, so that it weighs something by all there are: an order of nothing would never end."""
    spec, damaged = make_spec("whole"), make_spec("damaged")

    def spoil(episode, features):
        if episode % 2:
            features["steps/action"][3, 0] = np.nan

    tokenize_dataset(spec, write_rlds(tmp_path, spec, [30] * 6), FakeTokenizer(), tmp_path / "store")
    source = write_rlds(tmp_path, damaged, [30] * 20, change=spoil)
    tokenize_dataset(damaged, source, FakeTokenizer(), tmp_path / "store", corrupt="skip")
    store, lost = TokenStore(tmp_path / "store"), []
    for seed in range(8):
        mixture = select_windows(store, LoaderConfig(frames=4, max_trajectories=1, seed=seed, weighed=weighed)).mixture
        assert mixture.names == ("whole",) if mixture.dropped else {"whole", "damaged"} == set(mixture.names)
        lost += mixture.dropped.items()
    assert set(lost) == {("damaged", "all trajectories that were drawn from it were skipped: raise max_trajectories")}


# --- order of datasets, weights, statistics, rate ---------------------------------------------------


def test_datasets_are_drawn_anew_in_every_batch(store, table):
    """Equal weights used to give a few sequences of datasets for ever, the same for every seed."""
    config, sequences = replace(CONFIG, tau=1e9, batch=12), {}
    for seed in (0, 1):
        batches = take(store, table, 60, replace(config, seed=seed))
        sequences[seed] = {tuple(batch["embodiment"].tolist()) for batch in batches}
        assert len(sequences[seed]) == 60
    assert not sequences[0] & sequences[1]


def test_weights_can_be_frozen_while_trajectories_are_capped(store):
    free, capped = LoaderConfig(frames=6), LoaderConfig(frames=6, max_trajectories=2)
    weights = {
        (config.max_trajectories, weighed): select_windows(store, replace(config, weighed=weighed)).mixture.weights
        for config in (free, capped)
        for weighed in ("used", "all")
    }
    assert weights[None, "used"] == weights[None, "all"] == weights[2, "all"] != weights[2, "used"]
    sets = select_windows(store, replace(capped, weighed="all")).sets
    assert all(len(s.episodes) == 2 for s in sets.values()), "the cap itself still holds"


def test_a_cap_that_concerns_nothing_is_refused(store):
    """A name that is mistyped capped no trajectory."""
    with pytest.raises(ConfigError, match="loader.max_trajectories applies to base, but it is not set"):
        LoaderConfig(frames=6, capped=("base",))
    capped = select_windows(store, LoaderConfig(frames=6, max_trajectories=2, capped=("base",))).sets
    assert len(capped["base"].episodes) == 2 < len(capped["arm"].episodes)
    for config in (
        LoaderConfig(frames=6, max_trajectories=2, capped=("bsae",)),
        LoaderConfig(frames=6, max_trajectories=2, capped=("bsae",), datasets=("base", "arm")),
    ):
        with pytest.raises(ConfigError, match="loader.capped names bsae, not among the datasets .*: .*base"):
            select_windows(store, config)


def test_statistics_are_of_exactly_the_trajectories_used(store):
    """The first value of an action is the number of its episode, so every choice has its own mean."""
    config = LoaderConfig(frames=6, max_trajectories=2)
    for entry, name in zip(training_table(store, config).entries, store.names, strict=True):
        used = select_windows(store, config).sets[name].episodes
        rows = np.concatenate([store.episode(name, "train", int(i)).actions for i in used]).astype(np.float64)
        np.testing.assert_allclose(entry.mean, rows.mean(0), rtol=1e-14)
        np.testing.assert_allclose(entry.std, rows.std(0), rtol=1e-12)
        assert entry.mean != store.manifest(name).action_mean
    everything = training_table(store, LoaderConfig(frames=6))
    assert everything == store.embodiment_table(store.names, rate=2.0)


def test_damaged_statistics_are_named(store_root, tmp_path):
    shutil.copytree(store_root, tmp_path / "store")
    path = next((tmp_path / "store").glob("arm/*.moments.npy"))
    whole = path.read_bytes()
    for damaged, words in (
        (whole[:50], r"the action statistics of \d+ episodes cannot be read"),
        (whole.replace(b"'shape'", b"'shape(", 1), r"the action statistics of \d+ episodes cannot be read"),
        (whole.replace(b"<f8", b"<i8", 1), r"int64 \[\d+, 7\] cannot be the action statistics of \d+ episodes"),
    ):
        path.write_bytes(damaged)
        with pytest.raises(DataError, match=f"moments.npy: {words}.* Remove .*/arm and tokenise"):
            training_table(TokenStore(tmp_path / "store"), LoaderConfig(frames=6, max_trajectories=2))
    path.unlink()
    with pytest.raises(DataError, match="moments.npy: the file is missing from the token store. Remove .*/arm and"):
        training_table(TokenStore(tmp_path / "store"), LoaderConfig(frames=6, max_trajectories=2))


def test_the_rate_is_a_setting(tmp_path):
    store = store_of(tmp_path, {"toy": [40] * 6}, hz=10, frame_step=1)
    for rate, stride in ((2.0, 5), (None, 1), (5.0, 2)):
        config = LoaderConfig(frames=6, batch=4, rate=rate)
        (batch,) = take(store, training_table(store, config), 1, config)
        assert (np.diff(batch["tokens"][..., 0]) == stride).all() and batch["actions"].shape == (4, 6, 3 * stride)
    with pytest.raises(
        ConfigError, match="toy: the model was trained with frames at stride 5, but here the stride is 2"
    ):
        make_loader(store, store.embodiment_table(("toy",), rate=2.0), config)


def test_a_store_without_the_frames_of_a_rate_names_the_command(store):
    with pytest.raises(ConfigError, match="arm: the native rate .* every 2nd.*hma tokenize"):
        select_windows(store, LoaderConfig(frames=6, rate=None))


def test_unknown_dataset(store, table):
    with pytest.raises(ConfigError, match="'leg' is not in the token store"):
        make_loader(store, table, replace(CONFIG, datasets=("leg",)))


def test_rows_need_not_lie_side_by_side(store, table):
    [whole], [some] = take(store, table, 1), take(store, table, 1, rows=[9, 2, 3])
    assert same({k: x[[9, 2, 3]] for k, x in whole.items()}, some)


@pytest.mark.parametrize("rows", [[16], [-1], []])
def test_rows_that_a_batch_does_not_have(store, table, rows):
    with pytest.raises(ConfigError, match=r"are not in a batch of 16 rows"):
        make_loader(store, table, CONFIG, rows=rows)


def test_table_of_another_action_layout(store, table):
    wrong = EmbodimentTable((replace(table.entries[0], stride=1), *table.entries[1:]))
    with pytest.raises(
        ConfigError, match="arm: the model was trained with frames at stride 1, but here the stride is 2"
    ):
        make_loader(store, wrong, CONFIG)


def test_swapped_actions_are_refused(store, tmp_path):
    """The same number of values at the same rate, in another order."""
    spec = make_spec("hand", (2, 1, 3), hz=10)
    table = store.embodiment_table(("hand",), rate=2.0)
    swapped = replace(spec, action_keys=spec.action_keys[::-1], action_dims=spec.action_dims[::-1])
    tokenize_dataset(swapped, write_rlds(tmp_path, spec, [60] * 4), FakeTokenizer(), tmp_path / "store")
    other, config = TokenStore(tmp_path / "store"), replace(CONFIG, datasets=("hand",))
    with pytest.raises(ConfigError, match="hand: the action has other values, or another order of them"):
        make_loader(other, table, config)
    unknown = EmbodimentTable((replace(table.entries[0], layout=""),))  # a converted model
    assert next(make_loader(other, unknown, config))["tokens"].shape == (16, 6, 4)


def test_datasets_of_different_tokenizers_do_not_mix(store_root, tmp_path):
    for name, tokenizer in (("a", FakeTokenizer("one")), ("b", FakeTokenizer("two"))):
        spec = make_spec(name, hz=2)
        tokenize_dataset(spec, write_rlds(tmp_path, spec, [20] * 4), tokenizer, tmp_path / "store")
    store = TokenStore(tmp_path / "store")
    with pytest.raises(ConfigError, match="tokenised with different tokenizers"):
        make_loader(store, store.embodiment_table(store.names, rate=2.0), CONFIG)


@pytest.mark.parametrize("change", [{"frames": 0}, {"batch": 0}, {"tau": 0.0}, {"datasets": ("a", "a")}])
def test_impossible_configs_are_refused(change):
    with pytest.raises(ConfigError, match=f"loader.{next(iter(change))}"):
        replace(CONFIG, **change)
