from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from data_pipelines.errors import DataError, EpisodeError
from data_pipelines.sampling.splits import HeldOut, held_out
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.tokens.manifest_file import load_manifest
from data_pipelines.tokens.store import TokenStore
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import FakeLatents, FakeTokenizer, make_spec, png, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset

SPEC = make_spec(hz=4)  # stride 2
FILES = [
    *("train-00000-of-00001.array_record", "train-00000-of-00001.moments.npy"),
    *("val-00000-of-00001.actions.npy", "val-00000-of-00001.array_record"),
]


@pytest.fixture
def rlds(tmp_path):
    return write_rlds(tmp_path / "rlds", SPEC, [5, 6, 7, 8, 9, 10, 11, 12], shards=2)


def files(directory):
    return sorted(p.name for p in directory.iterdir())


def visible(directory):
    """What is no leftover of an unfinished job."""
    return [name for name in files(directory) if not name.startswith(".")]


def test_every_episode_is_stored_once_with_its_own_frames_and_actions(tmp_path, rlds):
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", batch=7)
    store = TokenStore(tmp_path / "store")
    manifest = store.manifest("toy")
    seen = []
    for split in ("train", "val"):
        for i, number in enumerate(manifest.split(split).episodes):
            item = store.episode("toy", split, i)
            steps = 5 + number
            assert (item.episode, item.success) == (number, bool(number % 2))
            assert manifest.split(split).steps[i] == steps
            assert (item.tokens == number * 256 + np.arange(0, steps, 2)[:, None]).all()
            assert item.actions[:, :2].tolist() == [[number, t] for t in range(steps)]
            assert (item.frames is not None) == (split == "val")
            if item.frames is not None:
                assert (item.frames[:, 0, 0, 1] == np.arange(0, steps, 2)).all()
            seen.append(number)
    assert sorted(seen) == list(range(8))
    assert set(manifest.val.episodes) == set(np.flatnonzero(held_out("toy", RldsDataset(rlds).ids, HeldOut())))
    assert files(tmp_path / "store" / "toy") == ["episodes.columns", "manifest.json", "parts", *FILES]
    assert files(tmp_path / "store") == ["toy"]


def test_latents_are_stored_in_half_precision_with_their_own_frames(tmp_path, rlds):
    manifest = tokenize_dataset(SPEC, rlds, FakeLatents(), tmp_path / "store", batch=7)
    facts = manifest.tokenizer
    assert (facts.channels, facts.vocab_size, facts.factors, facts.factor_vocab) == (3, 0, 0, 0)
    store = TokenStore(tmp_path / "store")
    for i, number in enumerate(manifest.train.episodes):
        tokens, steps = store.episode("toy", "train", i).tokens, np.arange(0, 5 + number, 2)
        assert tokens.dtype == np.float16 and tokens.shape == (len(steps), 4, 3)
        assert (tokens[..., 0] == number).all() and (tokens[..., 1] == steps[:, None]).all()
        assert np.array_equal(tokens[..., 2], np.float16(np.float32(steps[:, None]) / 3).repeat(4, 1))


def test_frames_are_stored_corrected_and_other_tokens_are_refused(tmp_path):
    corrected = replace(SPEC, image_corrections=("rotate_180", "swap_red_blue"))
    picture = np.random.default_rng(0).integers(0, 255, (8, 8, 3), np.uint8)

    def draw(_, features):
        features["steps/observation/image"] = [png(picture)] * len(features["steps/observation/image"])

    directory, frames = write_rlds(tmp_path, SPEC, [6] * 8, change=draw), {}
    for name, entry in (("plain", SPEC), ("corrected", corrected)):
        manifest = tokenize_dataset(entry, directory, FakeTokenizer(), tmp_path / name, keep_frames="all")
        stored = TokenStore(tmp_path / name).episode("toy", "train", 0)
        frames[name], text = stored.frames[0], (tmp_path / name / "toy" / "manifest.json").read_text()
        assert manifest.spec.image_corrections == entry.image_corrections
        assert ("image_corrections" in text) == (name == "corrected")  # so that older stores keep their hash
    assert np.array_equal(frames["plain"], picture)
    assert np.array_equal(frames["corrected"], picture[::-1, ::-1, ::-1])
    with pytest.raises(ConfigError, match="spec.image_corrections"):
        tokenize_dataset(corrected, directory, FakeTokenizer(), tmp_path / "plain", keep_frames="all")


def test_ids_are_not_taken_for_latents(tmp_path, rlds):
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    with pytest.raises(ConfigError, match="with other settings.*tokenizer.channels: 0 -> 3"):
        tokenize_dataset(SPEC, rlds, FakeLatents(), tmp_path / "store")


def test_result_is_the_same_bytes_whenever_wherever_and_in_whatever_batches(tmp_path, rlds):
    elsewhere = write_rlds(tmp_path / "other place", SPEC, [5, 6, 7, 8, 9, 10, 11, 12], shards=2)
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "a", batch=3)
    tokenize_dataset(SPEC, elsewhere, FakeTokenizer(), tmp_path / "b", batch=256)
    for name in ("manifest.json", *FILES):
        assert (tmp_path / "a/toy" / name).read_bytes() == (tmp_path / "b/toy" / name).read_bytes()
    assert TokenStore(tmp_path / "a").hash() == TokenStore(tmp_path / "b").hash()


def test_content_hash_sees_a_single_pixel(tmp_path):
    def spoil(episode, features):
        if episode == 1:
            features["steps/observation/image"][0] = features["steps/observation/image"][1]

    hashes = set()
    for change in (None, spoil):
        root = tmp_path / str(change is None)
        rlds = write_rlds(root, SPEC, [6] * 4, change=change)
        tokenize_dataset(SPEC, rlds, FakeTokenizer(), root / "store")
        hashes.add(TokenStore(root / "store").hash())
    assert len(hashes) == 2


def test_statistics_are_over_native_train_actions(tmp_path, rlds):
    manifest = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    rows = [(e, t, 0) for e in manifest.train.episodes for t in range(5 + e)]
    np.testing.assert_allclose(manifest.action_mean, np.mean(rows, axis=0), rtol=1e-12)
    np.testing.assert_allclose(manifest.action_std, np.std(rows, axis=0), rtol=1e-12)
    assert manifest.action_min == tuple(np.min(rows, axis=0))
    assert manifest.action_max == tuple(np.max(rows, axis=0))


def test_all_phases_can_be_stored(tmp_path, rlds):
    manifest = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", frame_step=1)
    item = TokenStore(tmp_path / "store").episode("toy", "train", 0)
    assert len(item.tokens) == len(item.actions) == manifest.train.steps[0]
    with pytest.raises(ConfigError, match="frame_step 3 does not divide the stride 2"):
        tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "other", frame_step=3)


@pytest.mark.parametrize("keep, expected", [("none", (False, False)), ("all", (True, True))])
def test_raw_frames_are_kept_as_asked(tmp_path, rlds, keep, expected):
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", keep_frames=keep)
    store = TokenStore(tmp_path / "store")
    assert tuple(store.episode("toy", s, 0).frames is not None for s in ("train", "val")) == expected


def test_second_run_does_nothing_and_other_settings_are_refused(tmp_path, rlds):
    first = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    stamp = (tmp_path / "store/toy" / FILES[0]).stat().st_mtime_ns
    described = replace(SPEC, note="words", camera="more words")
    assert tokenize_dataset(described, rlds, FakeTokenizer(), tmp_path / "store") == first
    assert (tmp_path / "store/toy" / FILES[0]).stat().st_mtime_ns == stamp
    with pytest.raises(ConfigError, match="with other settings.*tokenizer.identity: 'fake' -> 'new'"):
        tokenize_dataset(SPEC, rlds, FakeTokenizer("new"), tmp_path / "store")
    with pytest.raises(ConfigError, match="settings.keep_frames: 'val' -> 'all'"):
        tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", keep_frames="all")


def test_interrupted_job_leaves_no_dataset_and_can_be_repeated(tmp_path, rlds):
    class Dies(FakeTokenizer):
        def encode(self, images):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        tokenize_dataset(SPEC, rlds, Dies(), tmp_path / "store")
    assert visible(tmp_path / "store") == []
    with pytest.raises(DataError, match="the token store is empty"):
        TokenStore(tmp_path / "store")
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    assert files(tmp_path / "store") == ["toy"]


def test_no_device_encodes_padding_while_frames_are_left(tmp_path, rlds):
    """Eight devices took half of their rows from a batch of 256, the other half were zeros."""

    class Wide(FakeTokenizer):
        at_once, rows = 3, []

        def encode(self, images):
            self.rows.append(len(images))
            return super().encode(images)

    tokenize_dataset(SPEC, rlds, Wide(), tmp_path / "store", batch=4)
    *full, rest = Wide.rows
    assert full and set(full) == {6} and rest <= 6


def test_unwritable_directory_is_one_clear_message(tmp_path, rlds):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match=r"file/store/toy: .* cannot be written there \(Not a dir"):
        tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "file" / "store")


def test_full_disk_is_one_clear_message_and_leaves_nothing(tmp_path, rlds, monkeypatch):
    from data_pipelines.tokens import part_files

    class Full:
        def __init__(self, path, options):
            open(path, "wb").close()

        def write(self, record):
            pass

        def close(self):  # what ArrayRecord does when the disk is full
            raise RuntimeError("write() failed: No space left on device")

    monkeypatch.setattr(part_files.array_record_module, "ArrayRecordWriter", Full)
    with pytest.raises(ConfigError, match="cannot be written there .*No space left"):
        tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    assert visible(tmp_path / "store") == []


def test_wrong_spec_is_found_before_anything_is_written(tmp_path, rlds):
    with pytest.raises(ConfigError, match="images there"):
        tokenize_dataset(replace(SPEC, image_key="rgb"), rlds, FakeTokenizer(), tmp_path / "store")
    with pytest.raises(ConfigError, match="but 4 were expected"):
        tokenize_dataset(replace(SPEC, action_dims=(4,)), rlds, FakeTokenizer(), tmp_path / "store")
    assert not (tmp_path / "store").exists()


def spoil_first(episode, features):
    if episode == 0:
        features["steps/action"][2] = np.nan


def test_unusable_episode_stops_the_job_or_is_skipped_and_recorded(tmp_path):
    rlds = write_rlds(tmp_path / "rlds", SPEC, [6] * 5, change=spoil_first)
    with pytest.raises(EpisodeError, match="not finite at step 2"):
        tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    manifest = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", corrupt="skip")
    assert sorted((*manifest.train.episodes, *manifest.val.episodes)) == [1, 2, 3, 4]
    (loss,) = manifest.skipped
    assert (loss.file, loss.offset, loss.episodes) == ("toy-train.tfrecord-00000-of-00001", 0, 1)
    stored = json.loads((tmp_path / "store/toy/manifest.json").read_text())["skipped"]
    assert [sorted(entry) for entry in stored] == [["episodes", "file", "offset", "reason"]]
    assert "episode 0" in loss.reason and str(tmp_path) not in loss.reason
    assert load_manifest(tmp_path / "store/toy/manifest.json") == manifest


def test_truncated_shard_is_skipped_and_recorded_without_its_path(tmp_path, rlds):
    shard = sorted(rlds.glob("*.tfrecord*"))[0]
    shard.write_bytes(shard.read_bytes()[:-1])
    manifest = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", corrupt="skip")
    assert manifest.skipped_count == 1
    assert manifest.skipped[0].reason.startswith(shard.name)


def test_skipping_too_much_stops_the_job(tmp_path):
    def spoil(episode, features):
        features["steps/action"][0] = np.inf

    rlds = write_rlds(tmp_path / "rlds", SPEC, [6] * 5, change=spoil)
    with pytest.raises(DataError, match="more than max_skipped=3"):
        tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", corrupt="skip", max_skipped=3)
    with pytest.raises(
        DataError, match=r"no episode can be used .* The last one skipped: .*episode 4 .*is not finite at step 0"
    ):
        tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", corrupt="skip")
    assert visible(tmp_path / "store") == []


def test_progress_reaches_the_number_of_episodes(tmp_path, rlds):
    calls = []
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", batch=4, progress=lambda *c: calls.append(c))
    assert calls[-1] == (8, 8) and len(calls) > 2


def test_manifest_is_json_that_people_can_read(tmp_path, rlds):
    tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store")
    values = json.loads((tmp_path / "store/toy/manifest.json").read_text())
    assert values["spec"]["hz"] == 4 and values["tokenizer"]["identity"] == "fake"
    assert values["train"]["parts"] == [6] and values["settings"]["frame_step"] == 2


def test_a_limit_on_what_is_held_out_that_changes_nothing_makes_no_other_store(tmp_path, rlds):
    """With the limit 0.5 the same two of eight episodes are held out."""
    there = tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", max_val_fraction=0.5)
    assert tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store") == there
    with pytest.raises(ConfigError, match="settings.max_val_fraction: 0.5 -> 0.125"):
        tokenize_dataset(SPEC, rlds, FakeTokenizer(), tmp_path / "store", max_val_fraction=0.125)
