from __future__ import annotations

import builtins
import errno
import io
import json
import os
import pickle
import resource
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from data_pipelines.errors import DataError, UnreachableError
from data_pipelines.sources.rlds import location
from data_pipelines.tokens import store as store_module
from data_pipelines.tokens.episode_record import StoredEpisode, decode_episode, encode_episode, token_dtype
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import FakeTokenizer
from tests.data_pipelines.tokenizing import tokenize_dataset


def make_item(**changes) -> StoredEpisode:
    rng = np.random.default_rng(0)
    values = dict(
        episode=17,
        success=None,
        tokens=rng.integers(0, 60000, (3, 5)).astype(np.uint16),
        actions=rng.normal(size=(6, 7)).astype(np.float32),
        frames=rng.integers(0, 255, (3, 8, 8, 3)).astype(np.uint8),
    )
    return StoredEpisode(**(values | changes))


@pytest.mark.parametrize("success", [None, True, False])
@pytest.mark.parametrize("dtype", [np.uint16, np.uint32])
@pytest.mark.parametrize("frames", [True, False])
def test_record_keeps_everything(success, dtype, frames):
    item = make_item(success=success)
    kept = item.frames if frames else None
    item = make_item(success=success, tokens=item.tokens.astype(dtype), frames=kept)
    back = decode_episode(encode_episode(item))
    assert (back.episode, back.success) == (17, success)
    assert back.tokens.dtype == dtype and np.array_equal(back.tokens, item.tokens)
    assert np.array_equal(back.actions, item.actions)
    assert np.array_equal(back.frames, item.frames) if frames else back.frames is None


@pytest.mark.parametrize("channels", [1, 3])
def test_record_keeps_latents(channels):
    latents = np.random.default_rng(1).normal(size=(3, 5, channels)).astype(np.float16)
    item = make_item(tokens=latents)
    back = decode_episode(encode_episode(item))
    assert back.tokens.dtype == np.float16 and np.array_equal(back.tokens, latents)
    assert np.array_equal(back.actions, item.actions) and np.array_equal(back.frames, item.frames)


def test_records_of_ids_have_kept_their_layout():
    """Written out by hand: stores from before there were latents must still be read."""
    header = np.asarray([1, 17, -1, 3, 5, 6, 7, 2, 8, 0], "<i4").tobytes()
    item = make_item()
    data = header + item.actions.tobytes() + item.tokens.tobytes() + item.frames.tobytes()
    assert encode_episode(item) == data
    assert np.array_equal(decode_episode(data).tokens, item.tokens)


def test_record_of_another_length_or_version_is_refused():
    data = encode_episode(make_item())
    for bad in (data[:-1], data + b"\0", data[:10], b"\0" + data[1:], b"\2" + data[1:]):
        with pytest.raises(ValueError, match="episode record|no episode"):
            decode_episode(bad)


def test_small_vocabularies_and_latents_take_two_bytes():
    assert token_dtype(65536) == np.uint16 and token_dtype(65537) == np.uint32
    assert token_dtype(0, channels=16) == np.float16


def test_manifest_from_before_there_were_latents_is_one_of_ids(store_root, copy):
    path = copy / "arm/manifest.json"
    values = json.loads(path.read_text())
    assert values["tokenizer"].pop("channels") == 0
    path.write_text(json.dumps(values))
    assert TokenStore(copy).manifest("arm") == TokenStore(store_root).manifest("arm")


def test_table_follows_the_order_asked_for(store):
    table = store.embodiment_table(("hand", "arm"), rate=2.0)
    assert table.names == ("hand", "arm")
    hand = table.entries[0]
    assert (hand.action_dim, hand.stride, hand.chunk) == (6, 5, 30)
    assert hand.mean == store.manifest("hand").action_mean


def test_hash_covers_the_chosen_datasets_only(store):
    assert store.hash(("arm", "base")) == store.hash(("base", "arm"))
    assert len({store.hash(), store.hash(("arm",)), store.hash(("base",))}) == 3


def test_pickled_store_and_many_threads_read_the_same(store):
    expected = [store.episode("arm", "train", i).tokens[0, 0] for i in range(38)]
    copy = pickle.loads(pickle.dumps(store))
    with ThreadPoolExecutor(8) as pool:
        read = pool.map(lambda i: copy.episode("arm", "train", i % 38).tokens[0, 0], range(380))
        assert list(read) == expected * 10


def test_unknown_dataset_lists_those_there(store):
    with pytest.raises(ConfigError, match="'leg' is not in the token store .* it has arm, base, hand"):
        store.manifest("leg")


def test_a_copy_under_another_name_is_named(store_root, tmp_path):
    for name in ("arm", "arm_before"):
        shutil.copytree(store_root / "arm", tmp_path / name)
    with pytest.raises(DataError, match="arm_before: .* name of its dataset, 'arm'.*move it out of the store"):
        TokenStore(tmp_path)


def test_missing_or_empty_store(tmp_path):
    with pytest.raises(DataError, match="there is no token store"):
        TokenStore(tmp_path / "absent")
    with pytest.raises(DataError, match="the token store is empty"):
        TokenStore(tmp_path)


@pytest.fixture
def copy(store_root, tmp_path):
    shutil.copytree(store_root / "arm", tmp_path / "arm")
    return tmp_path


@pytest.mark.parametrize("content", ["", "{", "[]", "{}", '{"format": 1, "spec": 3}', '{"format": 1}'])
def test_damaged_manifest(copy, content):
    (copy / "arm/manifest.json").write_text(content)
    with pytest.raises(DataError, match=r"arm/manifest.json: .*tokenise it again"):
        TokenStore(copy)


def test_flipped_bit_is_an_error_not_another_token(copy):
    path = copy / "arm/train-00000-of-00001.array_record"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    store = TokenStore(copy)
    episodes = store.manifest("arm").train.episodes
    errors = 0
    for i in range(38):
        try:
            assert (store.episode("arm", "train", i).tokens // 256 == episodes[i]).all()
        except DataError as error:
            errors += 1
            assert str(path) in str(error) and "tokenise the dataset again" in str(error)
    assert errors >= 1


@pytest.mark.parametrize("spoil", ["truncate", "remove", "empty"])
def test_damaged_or_missing_file(copy, spoil):
    path = copy / "arm/train-00000-of-00001.array_record"
    if spoil == "remove":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2 if spoil == "truncate" else 0])
    with pytest.raises(DataError, match=r"train-00000-of-00001.array_record: .*tokenise the dataset again"):
        TokenStore(copy).episode("arm", "train", 0)


# --- A disk that fails is no damage ----------------------------------------------------------


class Failing:
    """The reader of a disk that fails: the library gives an error of its own where it reads, none where it opens."""

    def __init__(self, reader, count: int):
        self.reader, self.count = reader, count

    def num_records(self) -> int:
        return self.count

    def read(self, first: int, end: int) -> list[bytes]:
        raise RuntimeError("pread() failed: Stale file handle")


@pytest.fixture
def failing(monkeypatch):
    """`failing(times, path, opening)`: so often `path` cannot be read, or not even be opened; gives the waits."""

    def start(times: int, path: Path, opening: bool = False) -> list[float]:
        waits, left = [], [times]
        plain, library = builtins.open, store_module.array_record_module.ArrayRecordReader

        def fails(place) -> bool:
            failed = str(place) == str(path) and left[0] > 0
            left[0] -= failed
            return failed

        def opened(place, *args, **options):
            if fails(place):
                raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), str(place))
            return plain(place, *args, **options)

        def reader(place, **options):
            real = library(place, **options)
            return Failing(real, 0 if opening else real.num_records()) if fails(place) else real

        for owner in (builtins, io):  # pathlib takes it from there
            monkeypatch.setattr(owner, "open", opened)
        monkeypatch.setattr(store_module, "array_record_module", SimpleNamespace(ArrayRecordReader=reader))
        monkeypatch.setattr(location.time, "sleep", waits.append)
        return waits

    return start


@pytest.mark.parametrize("opening", [False, True])
@pytest.mark.parametrize("times", [1, 3])
def test_a_disk_that_comes_back_is_read_on(copy, failing, opening, times):
    store = TokenStore(copy)
    waits = failing(times, copy / "arm/train-00000-of-00001.array_record", opening)
    assert store.episode("arm", "train", 5).episode == store.manifest("arm").train.episodes[5]
    assert len(waits) == times - 1


@pytest.mark.parametrize("opening", [False, True])
def test_a_disk_that_stays_away_is_no_reason_to_remove_the_dataset(copy, failing, opening):
    path = copy / "arm/train-00000-of-00001.array_record"
    store = TokenStore(copy)
    failing(10**6, path, opening)
    with pytest.raises(UnreachableError, match=rf"{path}: cannot be read .*Too many open files.*same command again"):
        store.episode("arm", "train", 5)


@pytest.mark.parametrize("name", ["manifest.json", "episodes.columns", "train-00000-of-00001.moments.npy"])
def test_what_stands_beside_the_episodes_is_read_again_too(copy, failing, name):
    waits = failing(2, copy / "arm" / name)
    assert TokenStore(copy).action_moments("arm", np.arange(3)).count > 0
    assert len(waits) == 2
    failing(10**6, copy / "arm" / name)
    with pytest.raises(UnreachableError, match=rf"{name}: cannot be read .*Too many open files.*same command again"):
        TokenStore(copy).action_moments("arm", np.arange(3))


def test_a_disk_that_fails_in_the_middle_of_a_file_is_no_damage(copy, monkeypatch):
    path, plain = copy / "arm/train-00000-of-00001.moments.npy", builtins.open

    class Torn(io.FileIO):
        """Gives what stands before the array."""

        def readinto(self, buffer) -> int:
            if self.tell() >= 128:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            return super().readinto(memoryview(buffer)[:128])

        def readall(self) -> bytes:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    store = TokenStore(copy)
    for owner in (builtins, io):
        monkeypatch.setattr(
            owner,
            "open",
            lambda place, *a, **b: io.BufferedReader(Torn(place)) if place == path else plain(place, *a, **b),
        )
    monkeypatch.setattr(location.time, "sleep", lambda seconds: None)
    with pytest.raises(UnreachableError, match="moments.npy: cannot be read .*Input/output error"):
        store.action_moments("arm", np.arange(3))


def test_a_dataset_whose_manifest_cannot_be_read_now_is_not_replaced(copy, rlds, failing):
    failing(10**6, copy / "arm" / "manifest.json")
    spec, directory = next((spec, directory) for spec, directory in rlds.items() if spec.name == "arm")
    with pytest.raises(UnreachableError):
        tokenize_dataset(spec, directory, FakeTokenizer(), copy, overwrite=True)
    assert (copy / "arm" / "manifest.json").exists()


def test_files_kept_open_leave_room_for_those_of_the_rest(copy, monkeypatch):
    store = TokenStore(copy)
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    assert store._max_open == min(512, before[0] // 2)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (256, before[1]))  # as on macOS
        assert pickle.loads(pickle.dumps(store))._max_open == 128
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


# --- Replaced while it is read -----------------------------------------------------------------


def test_a_dataset_that_was_replaced_meanwhile_is_not_mixed_with_the_old_one(copy, rlds):
    store = TokenStore(copy)
    kept = store.episode("arm", "val", 0)
    again = pickle.loads(pickle.dumps(store))
    spec, directory = next((spec, directory) for spec, directory in rlds.items() if spec.name == "arm")
    tokenize_dataset(spec, directory, FakeTokenizer("another"), copy, overwrite=True)
    assert np.array_equal(store.episode("arm", "val", 0).tokens, kept.tokens)  # of the file that is open
    for reader in (store, again):
        with pytest.raises(DataError, match=rf"{copy / 'arm'}: .*replaced .*new run"):
            reader.episode("arm", "train", 0)
    shutil.rmtree(copy / "arm")
    with pytest.raises(DataError, match=rf"{copy / 'arm'}: .*removed"):
        store.episode("arm", "train", 0)


def test_a_dataset_that_was_replaced_by_an_equal_one_is_read_on(store_root, copy):
    store = TokenStore(copy)
    shutil.rmtree(copy / "arm")
    shutil.copytree(store_root / "arm", copy / "arm")
    os.utime(copy / "arm" / "manifest.json")
    assert store.episode("arm", "train", 0).episode == store.manifest("arm").train.episodes[0]
