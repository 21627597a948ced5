"""Token folders of the official release: read as they are written, refused where they are damaged."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.tokens.import_tokens import LATENT_SCALE, import_tokens, pair_folders
from data_pipelines.tokens.release_folder import open_folder
from data_pipelines.tokens.store import TokenStore
from data_pipelines.windows.slicer import make_slicer
from data_pipelines.windows.windows import train_windows
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import GOLDEN

CASE = GOLDEN / "15_windows"
GRID, DIM = 4, 3


def write_folder(path: Path, lengths=(7, 5, 9), latents=False, first=0, action_files=1, **change) -> Path:
    """Frame n's tokens are n, n + 1, ... and its action n, n / 2, -n; episodes have gaps in their ids."""
    frames = sum(lengths)
    count = first + np.arange(frames)
    cells = count[:, None] + np.arange(GRID**2)
    video = cells.reshape(frames, GRID, GRID).astype(np.uint32)
    if latents:
        video = (cells.reshape(frames, 1, GRID, GRID) + np.array([0, 100, 200, 300]).reshape(4, 1, 1)).astype(
            np.float16
        )
    actions = np.stack([count, count / 2, -count], axis=1).astype(np.float32)
    (path / "actions").mkdir(parents=True)
    video.tofile(path / "video.bin")
    for k, part in enumerate(np.split(actions, [1] if action_files == 2 else [], axis=1)):
        np.ascontiguousarray(part).tofile(path / "actions" / f"part_{k}.bin")
    np.repeat(3 * np.arange(len(lengths), dtype=np.int32), lengths).tofile(path / "segment_ids.bin")
    metadata = {
        "token_dtype": str(video.dtype), "action_dim": DIM, "s": 16, "h": GRID, "w": GRID, "hz": 1,
        "num_images": frames, "name": "toy_arm", "quantized": not latents,
        "vocab_size": None if latents else 262144, "latent_channels": 4 if latents else None,
        "encoder_type": "temporalvae" if latents else "magvit",
        "encoder_name_or_path": "data/stable-video-diffusion-img2vid" if latents else "data/magvit2.ckpt",
    }  # fmt: skip
    (path / "metadata.json").write_text(json.dumps(metadata | change))
    return path


@pytest.fixture
def pair(tmp_path):
    return write_folder(tmp_path / "toy_train"), write_folder(tmp_path / "toy_val", (4, 6), first=500)


def test_ids_episodes_and_actions_arrive_as_they_are(tmp_path, pair):
    manifest = import_tokens(*pair, tmp_path / "store", hz=4)
    facts = manifest.tokenizer
    assert (facts.vocab_size, facts.factors, facts.factor_vocab, facts.channels) == (262144, 2, 512, 0)
    assert (facts.identity, facts.image_size, facts.tokens) == (
        "magvit magvit2.ckpt (release folder)",
        64,
        16,
    )
    assert (manifest.spec.name, manifest.spec.stride, manifest.frame_step) == ("toy_arm", 2, 2)
    store = TokenStore(tmp_path / "store")
    for split, lengths, first in (("train", (7, 5, 9), 0), ("val", (4, 6), 500)):
        assert manifest.split(split).steps == lengths
        for i, steps in enumerate(lengths):
            item = store.episode("toy_arm", split, i)
            n = first + np.arange(steps)
            assert item.success is None and item.frames is None and item.tokens.dtype == np.uint32
            np.testing.assert_array_equal(item.tokens, n[::2, None] + np.arange(16))
            np.testing.assert_array_equal(item.actions, np.stack([n, n / 2, -n], axis=1))
            first += steps
    assert (*manifest.train.episodes, *manifest.val.episodes) == tuple(range(5))
    rows = np.arange(21)
    np.testing.assert_allclose(manifest.action_mean, [10, 5, -10])
    np.testing.assert_allclose(manifest.action_std[0], rows.std())
    assert (
        len(train_windows(store, "toy_arm", 3, min_real=3, rate=2.0)) == 1 + 0 + 2
    )  # 6 native frames each, starts every other one


def test_latents_become_scaled_patches_in_the_order_the_models_read(tmp_path):
    from hma_jax.model.frames import patchify

    pair = [write_folder(tmp_path / f"toy_{s}", latents=True) for s in ("train", "val")]
    manifest = import_tokens(*pair, tmp_path / "store", hz=2)
    facts = manifest.tokenizer
    assert (facts.channels, facts.tokens, facts.grid, facts.vocab_size, facts.image_size) == (16, 4, 2, 0, 32)
    item = TokenStore(tmp_path / "store").episode("toy_arm", "train", 1)
    raw = np.asarray(open_folder(pair[0]).video[7:12], np.float32) * LATENT_SCALE
    expected = np.asarray(patchify(np.moveaxis(raw, 1, -1), 2))
    assert item.tokens.dtype == np.float16
    np.testing.assert_allclose(item.tokens, expected, rtol=2**-11)
    single = import_tokens(*pair, tmp_path / "cells", hz=2, patch=1)
    assert (single.tokenizer.tokens, single.tokenizer.channels) == (16, 4)
    with pytest.raises(ConfigError, match="frame_step 2 does not divide the stride 1"):
        import_tokens(*pair, tmp_path / "none", hz=2, frame_step=2)
    with pytest.raises(ConfigError, match="patch 3 does not divide the grid 4"):
        import_tokens(*pair, tmp_path / "none", hz=2, patch=3)


@pytest.mark.parametrize("kind, tolerance", [("tokens", 0), ("latents", 2**-11)])
def test_windows_of_an_imported_store_are_what_the_release_reads(tmp_path, kind, tolerance):
    """Golden case 15. The release's own windows that leave an episode are not followed."""
    folder = open_folder(CASE / kind)
    items, compared = np.load(CASE / "items.npz"), 0
    for key in items:
        frames, stride, start = map(int, re.findall(r"\d+", key))
        field = key.rpartition("__")[2]
        episode = int(np.searchsorted(folder.bounds, start, side="right") - 1)
        first = start - folder.bounds[episode]
        if field == ("latents" if kind == "tokens" else "input_ids") or (
            start + frames * stride > folder.bounds[episode + 1]
        ):
            continue
        root = tmp_path / f"{stride}"
        manifest = import_tokens(CASE / kind, CASE / kind, root, hz=2 * stride, patch=1, frame_step=1)
        store = TokenStore(root)
        item, cut = store.episode("toy_arm", "train", episode), make_slicer(store, "toy_arm", frames, 2.0)
        if field == "action_ids":
            got = cut.chunks(item.actions, first, width=items[key].shape[1])
        else:
            got = cut.tokens(item, first)
        np.testing.assert_allclose(got.reshape(items[key].shape), items[key], rtol=tolerance)
        compared += 1
    assert compared >= 6
    facts = json.loads((CASE / "windows.json").read_text())
    np.testing.assert_allclose(manifest.action_mean, facts["action_mean"], rtol=1e-5)
    np.testing.assert_allclose(manifest.action_std, facts["action_std"], rtol=1e-5)
    assert len(folder) == facts["episodes"]


def test_actions_in_several_files_are_joined_by_name(tmp_path):
    folder = open_folder(write_folder(tmp_path / "toy_train", action_files=2))
    n = np.arange(21)
    np.testing.assert_array_equal(folder.actions, np.stack([n, n / 2, -n], axis=1))


def test_the_rate_comes_from_the_user_or_the_registry_never_from_the_folder(tmp_path, pair):
    with pytest.raises(ConfigError, match="'toy_arm' is not in the registry.*--hz.*metadata.json says 1"):
        import_tokens(*pair, tmp_path / "store")
    manifest = import_tokens(*pair, tmp_path / "store", name="unitree_g1_sample")
    assert manifest.spec.hz == 30 and manifest.spec.stride == 15
    with pytest.raises(ConfigError, match="hz, the native rate, must be positive and finite, got 0"):
        import_tokens(*pair, tmp_path / "store", name="unitree_g1_sample", hz=0)


class Decoder:
    """Whatever made the toy ids: paints the first id of a frame."""

    identity, image_size, grid, tokens, channels = "decoder", 8, 4, 16, 0
    vocab_size, factors, factor_vocab = 262144, 2, 512

    def decode(self, ids):
        assert ids.dtype == np.int32
        return np.broadcast_to((ids[:, 0, None, None, None] % 251).astype(np.uint8), (len(ids), 8, 8, 3))


def test_a_tokenizer_decodes_the_frames_that_evaluation_compares_with(tmp_path, pair):
    manifest = import_tokens(*pair, tmp_path / "store", hz=4, tokenizer=Decoder())
    assert (manifest.tokenizer.identity, manifest.tokenizer.image_size) == ("decoder", 8)
    assert manifest.settings.keep_frames == "val" and manifest.source_version == "release, frames decoded"
    store = TokenStore(tmp_path / "store")
    assert store.episode("toy_arm", "train", 0).frames is None
    frames = store.episode("toy_arm", "val", 1).frames
    assert frames[:, 0, 0, 0].tolist() == [(504 + t) % 251 for t in (0, 2, 4)]
    other = Decoder()
    other.grid, other.tokens = 8, 64
    with pytest.raises(ConfigError, match="its tokens have grid 4, but the tokenizer makes 8"):
        import_tokens(*pair, tmp_path / "none", hz=4, tokenizer=other)


def test_a_second_run_does_nothing_and_other_folders_are_refused(tmp_path, pair):
    first = import_tokens(*pair, tmp_path / "store", hz=4)
    stamp = (tmp_path / "store/toy_arm/train-00000-of-00001.array_record").stat().st_mtime_ns
    assert import_tokens(*pair, tmp_path / "store", hz=4) == first
    assert (tmp_path / "store/toy_arm/train-00000-of-00001.array_record").stat().st_mtime_ns == stamp
    with pytest.raises(ConfigError, match="with other settings .*hz: 4.0 -> 6.0"):
        import_tokens(*pair, tmp_path / "store", hz=6)


@pytest.mark.parametrize("file", ["actions/part_0.bin", "segment_ids.bin"])
def test_folders_that_changed_are_not_taken_for_those_that_were_imported(file, tmp_path, pair):
    """Else actions that were corrected stayed the old ones in the store."""
    import_tokens(*pair, tmp_path / "store", hz=4)
    values = np.fromfile(pair[0] / file, np.int32 if file.startswith("segment") else np.float32)
    values[-1] += 1  # the last frame is an episode of its own, or has another action
    values.tofile(pair[0] / file)
    with pytest.raises(ConfigError, match="already tokenised with other settings .source: "):
        import_tokens(*pair, tmp_path / "store", hz=4)


def test_folders_that_do_not_belong_together_are_refused(tmp_path, pair):
    latents = write_folder(tmp_path / "latents", latents=True)
    with pytest.raises(ConfigError, match="do not belong together: .*channels: 0 -> 16"):
        import_tokens(pair[0], latents, tmp_path / "store", hz=4)


def cut(name, size):
    def change(path):
        data = (path / name).read_bytes()
        (path / name).write_bytes(data[:size])

    return change


def rewrite(name, values):
    return lambda path: np.asarray(values).tofile(path / name)


def meta(**change):
    def apply(path):
        values = json.loads((path / "metadata.json").read_text())
        (path / "metadata.json").write_text(json.dumps(values | change))

    return apply


def both(first, second):
    return lambda path: (first(path), second(path))


@pytest.mark.parametrize(
    "damage, message",
    [
        (cut("video.bin", 100), r"video.bin: it has 100 bytes, but by .* it should have 1344 \(uint32 \[21, 4, 4\]\)"),
        (cut("segment_ids.bin", 80), "segment_ids.bin: it has 80 bytes, but by num_images .* it should have 84"),
        (cut("actions/part_0.bin", 90), r"part_0.bin: its 90 bytes are not an array float32 \[21, A\]"),
        (cut("metadata.json", 9), "metadata.json cannot be read"),
        (lambda p: (p / "metadata.json").unlink(), "metadata.json is missing: give a folder of the release"),
        (lambda p: (p / "actions/part_0.bin").unlink(), r"actions: no \*.bin"),
        (meta(num_images=0), "num_images is 0, not a positive number"),
        (meta(action_dim=4), "3 values per frame, but metadata.json says action_dim 4"),
        (meta(vocab_size=None), "vocab_size is None"),
        (rewrite("segment_ids.bin", np.int32([0] * 10 + [2] * 5 + [1] * 6)), "falls from 2 to 1 at frame 15"),
        (
            rewrite("video.bin", np.full((21, 4, 4), 300000, np.uint32)),
            "id 300000 in frames 0 to 6, but vocab_size",
        ),
        (
            both(rewrite("video.bin", np.full((21, 4, 4), -1, np.int32)), meta(token_dtype="int32")),
            "id -1 in frames 0 to 6, but vocab_size",
        ),
        (
            rewrite("actions/part_0.bin", np.full((21, 3), np.nan, np.float32)),
            "actions: not finite at frame 0",
        ),
    ],
)
def test_damage_is_named_with_file_and_sizes(tmp_path, pair, damage, message):
    damage(pair[0])
    with pytest.raises(DataError, match=message):
        import_tokens(*pair, tmp_path / "store", hz=4)
    assert not (tmp_path / "store" / "toy_arm").exists()


def test_raw_images_are_refused(tmp_path, pair):
    meta(token_dtype="uint8")(pair[0])
    with pytest.raises(ConfigError, match="raw images .* not tokens"):
        import_tokens(*pair, tmp_path / "store", hz=4)


def test_ids_of_a_vocabulary_that_is_no_power_of_512_stay_whole(tmp_path, pair):
    for folder in pair:
        meta(vocab_size=200_000)(folder)
    facts = import_tokens(*pair, tmp_path / "store", hz=4).tokenizer
    assert (facts.vocab_size, facts.factors, facts.factor_vocab) == (200_000, 1, 200_000)
    decoder = Decoder()
    decoder.vocab_size, decoder.factors, decoder.factor_vocab = 200_000, 1, 200_000
    import_tokens(*pair, tmp_path / "decoded", hz=4, tokenizer=decoder)


@pytest.mark.parametrize(
    "change",
    [
        {"token_dtype": "nonsense"}, {"token_dtype": "O"}, {"token_dtype": [1]}, {"latent_channels": -4},
        {"latent_channels": "4"}, {"h": 10**4000, "w": 10**4000}, {"num_images": True}, {"vocab_size": 2**40},
        {"action_dim": "x"},
    ],
)  # fmt: skip
def test_metadata_of_the_wrong_kind_is_named(tmp_path, change):
    with pytest.raises(DataError, match=r"metadata.json: .* Download the folder again"):
        open_folder(write_folder(tmp_path / "toy_train", **change))


def test_name_of_a_folder_is_no_path(tmp_path):
    pair = [write_folder(tmp_path / f"toy_{split}", name="../../elsewhere") for split in ("train", "val")]
    with pytest.raises(DataError, match=r"toy_train/metadata.json: name is '../../elsewhere'; use up to 128 letters"):
        import_tokens(*pair, tmp_path / "store", hz=4)
    assert import_tokens(*pair, tmp_path / "store", name="mine", hz=4).spec.name == "mine"


def test_episode_numbers_at_both_ends_of_their_type(tmp_path):
    """Their difference does not fit into the type."""
    folder = write_folder(tmp_path / "toy_train", lengths=(2, 2))
    rewrite("segment_ids.bin", np.array([-(2**31), -(2**31), 2**31 - 1, 2**31 - 1], np.int32))(folder)
    assert len(open_folder(folder)) == 2
    rewrite("segment_ids.bin", np.array([2**31 - 1, 2**31 - 1, -(2**31), -(2**31)], np.int32))(folder)
    with pytest.raises(DataError, match="segment_ids.bin: the episode number falls"):
        open_folder(folder)


def test_pairs_are_found_by_name(tmp_path, pair):
    assert pair_folders([pair[0]]) == pair_folders(list(pair)) == [("toy", *pair)]
    with pytest.raises(ConfigError, match="must end in _train or _val"):
        pair_folders([tmp_path / "toy"])
    with pytest.raises(ConfigError, match="lone_val: no such folder"):
        pair_folders([tmp_path / "lone_train"])
