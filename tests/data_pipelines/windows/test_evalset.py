from __future__ import annotations

import json

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.evalset import (
    ChoiceSettings,
    EvalManifest,
    eval_batches,
    freeze_manifest,
    subsample_windows,
)
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import FakeTokenizer, make_spec, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset


@pytest.fixture(scope="module")
def manifest(store):
    return freeze_manifest(store, store.names, frames=4, windows_per_dataset=5, seed=0, rate=2.0)


def test_windows_of_an_episode_do_not_overlap(store):
    everything = freeze_manifest(store, store.names, 4, 500, seed=0, rate=2.0)
    for entry in everything.datasets:
        facts = store.manifest(entry.dataset)
        assert len(set(entry.windows)) == len(entry.windows) > 0
        for episode, start in entry.windows:
            assert start % 4 == 0
            assert (start + 4) * facts.spec.stride <= facts.val.steps[episode]


def test_windows_are_whole_where_the_prompt_fills_them(store, manifest):
    filled = freeze_manifest(store, store.names, 4, 5, 0, prompt=4, rate=2.0)
    assert filled == manifest and filled.hash() == manifest.hash() and filled.settings == ChoiceSettings(5, 4)


def test_fewer_windows_are_a_subset_of_more(store):
    few, more = (freeze_manifest(store, store.names, 4, n, seed=0, rate=2.0) for n in (2, 4))
    for a, b in zip(few.datasets, more.datasets, strict=True):
        assert len(a.windows) == 2 and set(a.windows) < set(b.windows)
    assert len({freeze_manifest(store, store.names, 4, 2, seed=seed, rate=2.0).datasets for seed in range(4)}) > 2


def test_some_of_the_windows_are_of_as_many_episodes_as_can_be_and_not_of_neighbours():
    frozen = [(0, 0), (0, 4), (0, 8), (1, 4), (3, 0), (3, 8)]
    assert subsample_windows(frozen, 3) == ((0, 0), (1, 4), (3, 0)) and subsample_windows(frozen, 4) == (
        (0, 0),
        (0, 4),
        (1, 4),
        (3, 0),
    )
    assert subsample_windows(frozen, 9) == tuple(frozen)
    many = [(episode, start) for episode in range(40) for start in (0, 4)]
    assert subsample_windows(many, 4) == ((0, 0), (10, 0), (20, 0), (30, 0))


def names_of(batch):
    """(dataset, episode, start) of the rows that are not padding."""
    rows = zip(batch["dataset"], batch["episode"].tolist(), batch["start"].tolist(), strict=True)
    return [name for name, valid in zip(rows, batch["valid"], strict=True) if valid]


def test_an_episode_is_read_once_for_all_its_windows(store, table, monkeypatch):
    frozen, read, episode = freeze_manifest(store, ("arm",), 4, 5, 0, rate=2.0), [], TokenStore.episode
    monkeypatch.setattr(TokenStore, "episode", lambda self, *place: read.append(place) or episode(self, *place))
    windows = sum(batch["valid"].sum() for batch in eval_batches(store, table, frozen, batch=2))
    assert windows == 5 and len(read) == len(set(read)) == 2


def test_batches_give_each_window_once_with_its_images_and_actions(store, table, manifest):
    seen = []
    for batch in eval_batches(store, table, manifest, batch=2):
        assert batch["images"].shape == (2, 4, 8, 8, 3) and batch["images"].dtype == np.uint8
        assert np.array_equal(batch["images"][..., 0, 0, 1], batch["tokens"][..., 0] % 256)
        for row, name in enumerate(batch["dataset"]):
            entry = table.entries[table.index(name)]
            assert batch["embodiment"][row] == table.index(name)
            facts = store.manifest(name)
            for key, recorded in (("action_mean", facts.action_mean), ("action_std", facts.action_std)):
                own = batch[key][row, : entry.chunk].reshape(entry.stride, entry.action_dim)
                np.testing.assert_allclose(own, [recorded] * entry.stride, rtol=1e-6)
            steps = batch["tokens"][row, :, 0] % 256
            chunk = batch["actions"][row, :, : entry.chunk].reshape(4, entry.stride, entry.action_dim)
            assert (chunk[..., 1] == steps[..., None] + np.arange(entry.stride)).all()
            # A frame's colour says which episode and which native step it is of.
            episode, step = divmod(int(batch["tokens"][row, 0, 0]), 256)
            assert (batch["episode"][row], batch["start"][row]) == (episode, step)
        seen += names_of(batch)
    wanted = [
        (d.dataset, store.manifest(d.dataset).val.episodes[at], start * store.manifest(d.dataset).frame_step)
        for d in manifest.datasets
        for at, start in d.windows
    ]
    assert seen == wanted


def test_the_first_windows_of_each_dataset_alone(store, table, manifest):
    everything = [names_of(b) for b in eval_batches(store, table, manifest, 100)][0]
    (few,) = eval_batches(store, table, manifest, 6, first=2)
    for name in store.names:
        assert [w for w in names_of(few) if w[0] == name] == [w for w in everything if w[0] == name][:2]


def test_latents_come_in_the_windows_of_the_ids(store, latent_store, table, manifest):
    frozen = freeze_manifest(latent_store, store.names, frames=4, windows_per_dataset=5, seed=0, rate=2.0)
    assert frozen.datasets == manifest.datasets
    pairs = zip(eval_batches(store, table, manifest, 2), eval_batches(latent_store, table, frozen, 2), strict=True)
    for a, b in pairs:
        assert b["tokens"].shape == (2, 4, 4, 3) and b["tokens"].dtype == np.float32
        assert np.array_equal(b["tokens"][..., 0] * 256 + b["tokens"][..., 1], a["tokens"])
        assert np.array_equal(a["images"], b["images"])


def test_only_the_last_batch_is_padded_by_repeating(store, table, manifest):
    *whole, last = eval_batches(store, table, manifest, 7)
    assert all(b["valid"].all() for b in whole) and any(len(set(b["dataset"])) == 2 for b in whole)
    count = sum(len(d.windows) for d in manifest.datasets) % 7
    assert count > 1
    assert last["valid"].tolist() == [row < count for row in range(7)]
    for row in range(count, 7):
        assert np.array_equal(last["tokens"][row], last["tokens"][count - 1])
        assert last["dataset"][row] == last["dataset"][count - 1]


def test_a_window_keeps_its_name_in_other_batches_and_selections(store, table, manifest):
    def tokens(batch, datasets=None):
        return {
            name: t.tobytes()
            for b in eval_batches(store, table, manifest, batch, datasets)
            for name, t in zip(names_of(b), b["tokens"][b["valid"]], strict=True)
        }

    everything = tokens(4)
    assert tokens(1) == everything
    assert tokens(3, ("hand",)).items() < everything.items()


def test_file_round_trip_and_hash(store, manifest, tmp_path):
    manifest.save(tmp_path / "new" / "eval.json")
    loaded = EvalManifest.load(tmp_path / "new" / "eval.json")
    assert loaded == manifest and loaded.hash() == manifest.hash() and loaded.settings == ChoiceSettings(5, None)
    assert freeze_manifest(store, store.names, 4, 5, seed=1, rate=2.0).hash() != manifest.hash()
    assert freeze_manifest(store, store.names[::-1], 4, 5, seed=0, rate=2.0) == manifest


def test_edited_file_is_refused(manifest, tmp_path):
    path = tmp_path / "eval.json"
    manifest.save(path)
    values = json.loads(path.read_text())
    values["datasets"][0]["windows"].pop()
    path.write_text(json.dumps(values))
    with pytest.raises(DataError, match="do not match the hash in it"):
        EvalManifest.load(path)
    for content in ("", "[]", "{}", '{"frames": "x"}'):
        path.write_text(content)
        with pytest.raises(DataError, match="not an evaluation set"):
            EvalManifest.load(path)
    with pytest.raises(DataError, match="cannot be read"):
        EvalManifest.load(tmp_path / "absent.json")


def test_unwritable_file_is_one_clear_message(manifest, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="file/eval.json: cannot be written"):
        manifest.save(tmp_path / "file" / "eval.json")


def small_store(tmp_path, name="toy", lengths=(20,) * 4, **options):
    spec = make_spec(name, hz=2)
    rlds = write_rlds(tmp_path, spec, list(lengths))
    tokenize_dataset(spec, rlds, FakeTokenizer(), tmp_path / "s", **options)
    return TokenStore(tmp_path / "s")


def test_other_data_is_refused(store, table, manifest, tmp_path):
    other = small_store(tmp_path, "arm")
    small_store(tmp_path, "base")
    small_store(tmp_path, "hand")
    with pytest.raises(ConfigError, match="not the one on which the evaluation set was frozen"):
        eval_batches(TokenStore(other.root), table, manifest, 2)


def test_store_without_raw_frames_is_refused(tmp_path):
    store = small_store(tmp_path, keep_frames="none")
    frozen = freeze_manifest(store, ("toy",), 4, 5, 0, rate=2.0)
    with pytest.raises(ConfigError, match="keep_frames='val'"):
        eval_batches(store, store.embodiment_table(("toy",), rate=2.0), frozen, 2)


def test_dataset_too_short_to_evaluate_is_reported_and_all_of_them_an_error(tmp_path):
    small_store(tmp_path, "long")
    store = small_store(tmp_path, "short", [2] * 4)
    frozen = freeze_manifest(store, store.names, 4, 5, 0, prompt=2, rate=2.0)
    assert frozen.names == ("long",)
    assert "a window has at least 3 frames, which at stride 1 need 3 native frames" in frozen.empty["short"]
    with pytest.raises(DataError, match="short: a window has at least 3 frames.*has 2.*a shorter prompt"):
        freeze_manifest(store, ("short",), 4, 5, 0, prompt=2, rate=2.0)


def test_short_episodes_are_judged_up_to_their_end(tmp_path):
    """Of four frames the prompt takes two: three are enough, and the fourth is no frame."""
    small_store(tmp_path, "long")
    store = small_store(tmp_path, "short", [3] * 4)
    frozen = freeze_manifest(store, store.names, 4, 5, 0, prompt=2, rate=2.0)
    assert frozen.names == ("long", "short")
    (batch,) = eval_batches(store, store.embodiment_table(store.names, rate=2.0), frozen, 12)
    rows = zip(batch["dataset"], batch["real"], batch["tokens"], batch["images"], batch["actions"], strict=True)
    for name, real, *arrays in rows:
        assert real.tolist() == [True, True, True, name == "long"]
        assert all((x[~real] == 0).all() and (x[:3] != 0).any() for x in arrays)
    whole = freeze_manifest(store, store.names, 4, 5, 0, rate=2.0)
    assert whole.names == ("long",) and "real" not in next(
        eval_batches(store, store.embodiment_table(("long",), rate=2.0), whole, 2)
    )


def test_the_rate_is_that_of_the_frames(tmp_path):
    """4 Hz natively: at 2 Hz every other frame, at the native rate each."""
    spec = make_spec("toy", hz=4)
    rlds = write_rlds(tmp_path, spec, [20] * 4)
    tokenize_dataset(spec, rlds, FakeTokenizer(), tmp_path / "s", frame_step=1)
    store = TokenStore(tmp_path / "s")
    for rate, stride in ((2.0, 2), (None, 1), (1.0, 4)):
        frozen = freeze_manifest(store, ("toy",), 4, 5, 0, rate=rate)
        assert {start for _, start in frozen.datasets[0].windows} == set(range(0, 21 - 4 * stride, 4 * stride))
        batch = next(eval_batches(store, store.embodiment_table(("toy",), rate), frozen, 1))
        assert (np.diff(batch["tokens"][0, :, 0]) == stride).all()
        assert batch["actions"].shape == (1, 4, 3 * stride)
    with pytest.raises(ConfigError, match="stride 2, but here the stride is 4"):
        eval_batches(store, store.embodiment_table(("toy",), rate=2.0), frozen, 1)


def test_unknown_dataset_is_named(store, table, manifest):
    with pytest.raises(ConfigError, match="not in the evaluation set: leg"):
        eval_batches(store, table, manifest, 2, ("leg",))


def test_frames_that_are_none_are_marked_whichever_dataset_has_them(tmp_path):
    """Else padding counted as frames where the last dataset has whole windows."""
    small_store(tmp_path, "a", [3] * 4)
    store = small_store(tmp_path, "b")
    frozen = freeze_manifest(store, store.names, 4, 5, 0, prompt=2, rate=2.0)
    assert frozen.least == 3
    batch = next(eval_batches(store, store.embodiment_table(store.names, rate=2.0), frozen, 12))
    assert [real.sum() for real in batch["real"]] == [3 if name == "a" else 4 for name in batch["dataset"]]
