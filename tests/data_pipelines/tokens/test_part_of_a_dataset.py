"""`max_train`: the tokens of a part of a dataset are those that a run on so many trajectories uses of the whole."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.loading.frames import make_frame_loader
from data_pipelines.loading.selection import LoaderConfig, training_table
from data_pipelines.sampling.splits import HeldOut, used_episodes
from data_pipelines.sources.identity import EpisodeRun
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.tokens.store import TokenStore
from data_pipelines.tokens.tokenize_job import plan_again
from data_pipelines.windows.windows import train_windows, val_windows
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec(hz=4)  # stride 2
EPISODES = 30  # of which every third has one frame of two, too few for a window


@pytest.fixture(scope="module")
def rlds(tmp_path_factory):
    return write_rlds(
        tmp_path_factory.mktemp("rlds"), SPEC, [3 if i % 3 == 1 else 9 for i in range(EPISODES)], shards=3
    )


@pytest.fixture(scope="module")
def whole(rlds, tmp_path_factory):
    root = tmp_path_factory.mktemp("whole")
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), root)
    return TokenStore(root)


def trained(store: TokenStore, limit: int | None = None, seed: int = 0) -> list[int]:
    """The numbers of the episodes whose windows are drawn."""
    chosen = train_windows(store, "toy", 4, limit, seed, rate=2.0).episodes
    return np.asarray(store.manifest("toy").train.episodes)[chosen].tolist()


def part(rlds, root, count: int, **options) -> TokenStore:
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), root, max_train=count, **options)
    return TokenStore(root)


def test_a_part_is_what_a_run_on_so_many_trajectories_uses_of_the_whole(rlds, whole, tmp_path, monkeypatch):
    opened, open_episode = [], RldsDataset.open_episode
    monkeypatch.setattr(
        RldsDataset, "open_episode", lambda self, i, *keys: opened.append(i) or open_episode(self, i, *keys)
    )
    store = part(rlds, tmp_path, 12)
    manifest, of_whole = store.manifest("toy"), whole.manifest("toy")
    assert len(manifest.train.episodes) == 12 and list(manifest.val.episodes) == list(of_whole.val.episodes)
    assert sorted(opened) == sorted((*manifest.train.episodes, *manifest.val.episodes))  # no other record is read
    assert manifest.left_out == EPISODES - 12 - len(manifest.val.episodes) and of_whole.left_out == 0
    usable = trained(store)
    assert 1 < len(usable) < 12  # those too short for a window are not replaced
    for count in (1, 2, len(usable)):
        assert trained(store, count) == trained(whole, count)
    assert trained(store, 12) == usable
    assert len(trained(store, 2, seed=7)) == 2 and set(trained(store, 2, seed=7)) < set(usable)
    windows = [val_windows(one, "toy", 4, 2, rate=2.0) for one in (store, whole)]
    assert windows[0].ends.tolist() == windows[1].ends.tolist()
    tables = (
        training_table(store, LoaderConfig(frames=4, max_trajectories=len(usable))),
        training_table(whole, LoaderConfig(frames=4, max_trajectories=len(usable))),
    )
    assert tables[0] == tables[1]


def test_parts_are_nested_and_one_that_leaves_nothing_out_is_the_whole(rlds, whole, tmp_path):
    sizes = [set(part(rlds, tmp_path / f"{n}", n).manifest("toy").train.episodes) for n in (2, 5)]
    assert sizes[0] < sizes[1] < set(whole.manifest("toy").train.episodes)
    assert part(rlds, whole.root, EPISODES).hash() == whole.hash()  # nothing is done, nothing refused
    assert part(rlds, tmp_path / "all", 28).hash() == whole.hash()
    with pytest.raises(ConfigError, match=r"\(settings.max_train: None -> 5\)"):
        part(rlds, whole.root, 5)
    with pytest.raises(ConfigError, match=r"\(settings.max_train: 5 -> 6\)"):
        part(rlds, tmp_path / "5", 6)
    limits = [
        plan_again(whole.manifest("toy"), SPEC, HeldOut(max_train=n), rate=2.0).settings.max_train
        for n in (5, EPISODES)
    ]
    assert limits == [5, None]


def test_what_is_missing_counts_only_if_it_is_of_the_part(tmp_path):
    spec = make_spec()
    rlds = write_rlds(tmp_path, spec, [4] * EPISODES, shards=3)
    (used,) = np.nonzero(np.logical_or(*used_episodes(spec, RldsDataset(rlds).runs, HeldOut(max_train=8))))
    sorted(rlds.glob("*.tfrecord*"))[2].unlink()
    manifest = tokenize_dataset(
        spec, rlds, FakeTokenizer(), tmp_path / "store", max_train=8, corrupt="skip", max_skipped=10
    )
    assert sorted((*manifest.train.episodes, *manifest.val.episodes)) == [e for e in used if e < 20]
    assert manifest.skipped_count == (used >= 20).sum() > 0 and manifest.left_out == EPISODES - len(used)
    assert manifest.skipped[0].reason.startswith("toy-train.tfrecord-00002-of-00003: ")


def test_of_a_split_that_the_entry_holds_out_at_most_max_val_are_used():
    spec = make_spec()
    spec = type(spec)(**(vars(spec) | {"split": "train+val", "val_split": "val"}))
    runs = [EpisodeRun("a", 0, 50, "train"), EpisodeRun("b", 0, 30, "val")]
    assert [mask.sum() for mask in used_episodes(spec, runs, HeldOut(max_val=5))] == [50, 30]
    train, val = used_episodes(spec, runs, HeldOut(max_val=5, max_train=7))
    assert train[:50].sum() == train.sum() == 7 and val[50:].sum() == val.sum() == 5


def test_a_tokenizer_is_trained_on_the_frames_of_the_part(rlds):
    amount = HeldOut(max_train=3)
    train, val = used_episodes(SPEC, RldsDataset(rlds).runs, amount)
    for split, used in (("train", train), ("val", val)):
        loader = make_frame_loader([(SPEC, rlds)], 8, 8, seed=1, tau=3.0, held_out=amount, split=split)
        seen = {int(e) for step in range(6) for e in loader.episodes(step)[1]}
        assert seen == set(np.flatnonzero(used).tolist())


def test_a_part_of_no_episode_is_refused():
    with pytest.raises(ConfigError, match=r"store\.max_train must be at least 1, got 0"):
        HeldOut(max_train=0).check("store.")
