"""Episodes keep their names, and with them split and subset, whatever happens to others."""

from __future__ import annotations

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.sampling.splits import HeldOut, held_out
from data_pipelines.sources.identity import EpisodeRun, describe, episode_ids
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.windows import train_windows
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.shards import index_shard
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec()
OPTIONS = {"corrupt": "skip", "max_skipped": 100}


def test_ids_depend_on_file_and_place_alone():
    whole = episode_ids([EpisodeRun("a", 0, 5), EpisodeRun("b", 0, 3)])
    assert whole.dtype == np.uint64 and len(set(whole.tolist())) == 8
    assert np.array_equal(episode_ids([EpisodeRun("b", 1, 2)]), whole[6:])
    assert np.array_equal(episode_ids([EpisodeRun("a", 0, 2), EpisodeRun("a", 2, 3)]), whole[:5])
    with pytest.raises(DataError, match="a, episode 1: two episodes have this name"):
        episode_ids([EpisodeRun("a", 0, 3), EpisodeRun("a", 1, 1)])
    assert describe([EpisodeRun("a", 0, 5), EpisodeRun("b", 4, 3)], 6) == "b, episode 5"


def damage(directory) -> set[int]:
    """Cuts five episodes off: the first shard's last two, one in the third, and two in the last."""
    shards = sorted(directory.glob("*.tfrecord*"))
    per_shard = 1000 // len(shards)
    lost = set()
    for shard, count in ((0, 2), (2, 1), (len(shards) - 1, 2)):
        offset = int(index_shard(shards[shard]).offsets[per_shard - count])
        shards[shard].write_bytes(shards[shard].read_bytes()[:offset])
        lost |= set(range((shard + 1) * per_shard - count, (shard + 1) * per_shard))
    return lost


def test_losing_episodes_moves_no_other(tmp_path):
    """Five of 1,000: every other validation episode stays, and every subset keeps its other members."""
    directory = write_rlds(tmp_path / "rlds", SPEC, [2] * 1000, shards=20)
    tokenize_dataset(SPEC, directory, FakeTokenizer(), tmp_path / "whole", **OPTIONS)
    lost = damage(directory)
    tokenize_dataset(SPEC, directory, FakeTokenizer(), tmp_path / "less", **OPTIONS)
    whole, less = TokenStore(tmp_path / "whole"), TokenStore(tmp_path / "less")
    before, after = whole.manifest("toy"), less.manifest("toy")
    assert len(before.val.episodes) == 50 and after.skipped_count == 5
    assert set(after.val.episodes) == set(before.val.episodes) - lost
    assert set(after.train.episodes) == set(before.train.episodes) - lost
    for limit in (1, 10, 100, 900):
        had, has = (chosen(store, limit) for store in (whole, less))
        assert has == had - lost and len(had) == limit
    position = list(after.train.episodes).index(999 - 3)  # the record that is stored is the one it is named by
    assert less.episode("toy", "train", position).actions[0, 0] == 999 - 3


def chosen(store: TokenStore, limit: int) -> set[int]:
    windows = train_windows(store, "toy", 1, limit, rate=2.0)
    return {int(store.manifest("toy").train.episodes[i]) for i in windows.episodes}


def test_a_shard_that_is_absent_changes_no_other_split(tmp_path):
    directory = write_rlds(tmp_path, SPEC, [2] * 40, shards=4)
    whole = RldsDataset(directory)
    mask = held_out("toy", whole.ids, HeldOut())
    sorted(directory.glob("*.tfrecord*"))[1].unlink()
    rest = RldsDataset(directory, corrupt="skip")
    assert rest.numbers.tolist() == [*range(10), *range(20, 40)]
    assert np.array_equal(held_out("toy", rest.ids, HeldOut()), mask)
    keys = (SPEC.image_key, SPEC.action_keys)
    assert [rest.episode(i, *keys).actions[0, 0] for i in range(30)] == rest.numbers.tolist()
