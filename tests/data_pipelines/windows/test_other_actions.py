"""Other episodes' actions for a window, and what would have been seen under them."""

from __future__ import annotations

import shutil
from collections import Counter

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.sampling.order import hash64, stream_seed
from data_pipelines.tokens import store as store_module
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.counterfactual import CounterfactualFrames
from data_pipelines.windows.evalset import eval_batches, freeze_manifest
from data_pipelines.windows.other_actions import OtherWindow, OtherWindows
from data_pipelines.windows.slicer import make_slicer
from data_pipelines.windows.windows import WindowSet, val_windows
from hma_jax.config import ConfigError
from tests.data_pipelines.windows.test_evalset import small_store


def batches(store, count: int, prompt: int | None = None, **options):
    """(frozen windows, the one batch of all of them)."""
    frozen = freeze_manifest(store, store.names, 4, 5, 0, prompt=prompt, rate=2.0)
    table = store.embodiment_table(store.names, rate=2.0)
    whole = sum(len(d.windows) for d in frozen.datasets)
    (batch,) = eval_batches(store, table, frozen, whole, other_actions=count, prompt=2, **options)
    return frozen, batch


def episodes_and_steps(batch):
    """What each other sequence's actions say where they are from: episode and step of every frame, int [B, N, T]
    each."""
    return (batch["other_actions"][..., i].astype(int) for i in (0, 1))


def test_they_are_whole_sequences_of_other_episodes(tmp_path):
    store = small_store(tmp_path, lengths=(20,) * 16, min_val=8, max_val_fraction=0.5)
    _, batch = batches(store, 7)
    episode, step = episodes_and_steps(batch)
    assert batch["other_valid"].all() and batch["other_actions"].shape == (len(batch["tokens"]), 7, 4, 3)
    assert (episode == episode[..., :1]).all() and (np.diff(step, axis=-1) == 1).all()
    held_out = set(store.manifest("toy").val.episodes)
    for own, others in zip(batch["episode"].tolist(), episode[..., 0].tolist(), strict=True):
        assert set(others) == held_out - {own}  # one of each of the seven


def test_a_window_has_the_same_ones_in_any_batch_and_a_longer_list_begins_with_the_shorter(tmp_path):
    store = small_store(tmp_path, lengths=(20,) * 8, min_val=4, max_val_fraction=0.5)
    frozen, five = batches(store, 5)
    _, nine = batches(store, 9)
    np.testing.assert_array_equal(five["other_actions"], nine["other_actions"][:, :5])
    for row, single in enumerate(
        eval_batches(store, store.embodiment_table(("toy",), rate=2.0), frozen, 1, other_actions=5)
    ):
        np.testing.assert_array_equal(single["other_actions"][0], five["other_actions"][row])
    assert len(np.unique(five["other_actions"], axis=0)) > 1  # not the same for all windows


def test_more_are_taken_from_episodes_once_each_has_given_one_then_from_training(tmp_path):
    """Two episodes held out, each of three windows: one other episode gives three, training the rest."""
    store = small_store(tmp_path, lengths=(6,) * 8, min_val=2, max_val_fraction=0.25)
    _, batch = batches(store, 5)
    episode, step = episodes_and_steps(batch)
    held_out = set(store.manifest("toy").val.episodes)
    for row, own in enumerate(batch["episode"].tolist()):
        (other,) = held_out - {own}
        assert episode[row, :3, 0].tolist() == [other] * 3 and sorted(step[row, :3, 0].tolist()) == [0, 1, 2]
        assert not set(episode[row, 3:, 0].tolist()) & held_out


def test_finding_some_costs_no_more_where_there_are_many_windows(tmp_path, monkeypatch):
    """Training has millions: those that are not chosen are not located, and of episodes the actions alone are kept."""
    store = small_store(tmp_path, lengths=(20,) * 8, min_val=2, max_val_fraction=0.25)
    (name,) = store.names
    others = OtherWindows(store, {name: make_slicer(store, name, 4, 2.0)}, 4, 2.0, 0)
    located, locate = [], WindowSet.locate
    monkeypatch.setattr(WindowSet, "locate", lambda self, i: located.append(i) or locate(self, i))
    chosen = others.choose(name, 0, 0, 40)
    assert len(chosen) == len(located) == 40 and {o.split for o in chosen} == {"val", "train"}
    assert others.actions(name, chosen, 3).shape == (40, 4, 3)
    assert all(others._actions(name, o.split, o.episode).base is None for o in chosen)
    # Each window has its own order of them, and each seed.
    again = OtherWindows(store, {name: make_slicer(store, name, 4, 2.0)}, 4, 2.0, 1)
    orders = [(others, 0, 0), (others, 0, 4), (others, 0, 8), (again, 0, 0)]
    assert len({tuple(by.choose(name, episode, start, 5)) for by, episode, start in orders}) == 4


def test_no_frames_are_read_to_get_their_actions(tmp_path, monkeypatch):
    """An episode's record holds all its frames, and its actions are a thousandth of it."""
    small_store(tmp_path, lengths=(20,) * 8, min_val=4, max_val_fraction=0.5)
    records, decode = [], store_module.decode_episode
    monkeypatch.setattr(store_module, "decode_episode", lambda data: records.append(data) or decode(data))

    def read(count: int):
        """(the batch, records read for it)."""
        before = len(records)
        _, batch = batches(TokenStore(tmp_path / "s"), count)
        return batch, len(records) - before

    (_, alone), (batch, with_others) = read(0), read(3)
    assert alone == with_others == len(set(batch["episode"].tolist())) > 0
    for path in (tmp_path / "s").glob("*/val-*.actions.npy"):  # as of splits without frames: in records alone
        path.unlink()
    same, more = read(3)
    np.testing.assert_array_equal(same["other_actions"], batch["other_actions"])
    assert more > alone


def test_actions_beside_a_part_that_are_damaged_are_named(tmp_path):
    store = small_store(tmp_path)
    (path,) = store.root.glob("toy/*.actions.npy")
    np.save(path, np.load(path)[1:])
    with pytest.raises(DataError, match=r"val-.*.actions.npy: float32 \[\d+, 3\] cannot be the actions of \d+ steps"):
        store.actions("toy", "val", 0)


def test_what_stands_beside_the_parts_of_another_dataset_is_neither_used_nor_called_damaged(tmp_path):
    """It has as many training episodes, and other steps."""
    (tmp_path / "other").mkdir()
    store, other = (
        small_store(at, lengths=(steps,) * 8, min_val=4, max_val_fraction=0.5)
        for at, steps in ((tmp_path, 20), (tmp_path / "other", 26))
    )
    shutil.rmtree(store.root / "toy")
    shutil.copytree(other.root / "toy", store.root / "toy")
    for read in (lambda: store.actions("toy", "val", 0), lambda: store.action_moments("toy", np.arange(2))):
        with pytest.raises(DataError, match="was replaced while it was in use"):
            read()


def test_of_each_episode_the_smallest_hash_comes_first_and_no_others_are_sorted(tmp_path, monkeypatch):
    """At its native rate an episode has a thousand windows, and they are chosen for every frozen window."""
    store = small_store(tmp_path, lengths=(20, 13) * 6, min_val=6, max_val_fraction=0.5)
    (name,) = store.names
    windows = val_windows(store, name, 4, 2, rate=2.0)
    seed = stream_seed(0, "other actions", name, store.manifest(name).val.episodes[2], 1)
    order = np.argsort(hash64(np.arange(len(windows)), stream_seed(seed, "val")))
    seen, rounds = Counter(), {}
    for episode, start in map(windows.locate, order.tolist()):
        rounds.setdefault(seen[episode], []).append(OtherWindow("val", episode, start))
        seen[episode] += 1
    sizes = []
    for sort in ("argsort", "lexsort"):
        real = getattr(np, sort)
        monkeypatch.setattr(np, sort, lambda x, real=real: sizes.append(np.shape(x)[-1]) or real(x))
    others = OtherWindows(store, {name: make_slicer(store, name, 4, 2.0)}, 4, 2.0, 0).choose(name, 2, 1, 12)
    assert others == [w for n in sorted(rounds) for w in rounds[n] if w.episode != 2][:12]
    assert len(seen) == 6 and sizes and max(sizes) == 5


def test_fewer_than_asked_for_are_marked(tmp_path):
    store = small_store(tmp_path, lengths=(4, 4), min_val=1)
    _, batch = batches(store, 5)
    assert batch["other_valid"].tolist() == [[True, False, False, False, False]]
    assert not batch["other_actions"][0, 1:].any()


def test_they_cover_every_real_frame_of_a_short_window(tmp_path):
    """Episodes of three frames and of four: a whole window takes only whole ones."""
    store = small_store(tmp_path, lengths=(3, 4) * 6, min_val=6, max_val_fraction=0.5)
    _, batch = batches(store, 20, prompt=2)
    _, step = episodes_and_steps(batch)
    real = batch["real"].sum(1)
    assert set(real.tolist()) == {3, 4}
    for row, frames in enumerate(real.tolist()):
        chosen = step[row][batch["other_valid"][row]]
        assert len(chosen) > 0 and (chosen[:, :frames] == np.arange(frames)).all()


# --- What would have been seen ----------------------------------------------------------------


def frames_for(frozen, dataset: str = "toy") -> CounterfactualFrames:
    (windows,) = [d.windows for d in frozen.datasets if d.dataset == dataset]
    frames = np.random.default_rng(0).integers(0, 255, (len(windows), 2, 8, 8, 3)).astype(np.uint8)
    return CounterfactualFrames(frozen.hash(), 2, {dataset: frames})


def test_frames_under_other_actions_follow_the_prompt(tmp_path):
    small_store(tmp_path, "arm")
    store = small_store(tmp_path, "toy")
    frozen = freeze_manifest(store, store.names, 4, 5, 0, rate=2.0)
    counterfactual = frames_for(frozen)
    counterfactual.save(tmp_path / "t.npz")
    before = (tmp_path / "t.npz").read_bytes()
    counterfactual.save(tmp_path / "t.npz")
    assert (tmp_path / "t.npz").read_bytes() == before
    _, batch = batches(store, 1, counterfactual=CounterfactualFrames.load(tmp_path / "t.npz"))
    toy = np.asarray([name == "toy" for name in batch["dataset"]])
    assert batch["other_seen"].tolist() == toy.tolist()
    np.testing.assert_array_equal(batch["other_images"][:, :2], batch["images"][:, :2])
    np.testing.assert_array_equal(batch["other_images"][toy, 2:], counterfactual.frames["toy"])


def test_nothing_is_seen_under_actions_that_there_are_not(tmp_path):
    """The held-out episode is longer than all others: none covers its window."""
    store = small_store(tmp_path, lengths=(3, 4), min_val=1)
    frozen = freeze_manifest(store, store.names, 4, 5, 0, prompt=2, rate=2.0)
    _, batch = batches(store, 1, prompt=2, counterfactual=frames_for(frozen))
    assert not batch["other_valid"].any() and not batch["other_seen"].any()
    np.testing.assert_array_equal(batch["other_images"], batch["images"])


def test_frames_of_other_windows_or_prompts_or_damaged_ones_are_refused(tmp_path):
    store = small_store(tmp_path)
    frozen = freeze_manifest(store, store.names, 4, 5, 1, rate=2.0)
    with pytest.raises(ConfigError, match="made for other windows than the frozen ones"):
        batches(store, 1, counterfactual=frames_for(frozen))
    table = store.embodiment_table(store.names, rate=2.0)
    for options, words in (
        ({"other_actions": 0, "prompt": 2}, "need these actions; ask for other_actions of at least 1"),
        ({"other_actions": 1, "prompt": 3}, "made for prompt 2, .* what follows prompt 3; prepare the study again"),
    ):
        with pytest.raises(ConfigError, match=words):
            eval_batches(store, table, frozen, 2, counterfactual=frames_for(frozen), **options)
    frames_for(frozen).save(tmp_path / "t.npz")
    whole = (tmp_path / "t.npz").read_bytes()
    at = 30 + sum(np.frombuffer(whole[26:30], "<u2").tolist())  # where the first array begins, packed
    changed = whole[:at] + b"\xff" + whole[at + 1 :]
    for content in (b"", whole[:-30], changed):
        (tmp_path / "t.npz").write_bytes(content)
        with pytest.raises(DataError, match="t.npz: the frames under other actions cannot be read"):
            CounterfactualFrames.load(tmp_path / "t.npz")
