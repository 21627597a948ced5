"""Tokenizers on disk: the same one comes back, or a message says why not. Never another one."""

import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError, TokenizerConfig
from hma_jax.tokenizers.autoencoder import AutoencoderTokenizer, declare_tokenizer
from hma_jax.tokenizers.continuous import ContinuousTokenizer
from hma_jax.tokenizers.io import DESCRIPTION, WEIGHTS, load_tokenizer, save_tokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer

PAGE = Path(__file__).parents[2] / "docs" / "checkpoints.md"
CONFIG = TokenizerConfig(image_size=8, downsample=4, bits=4, factors=2, channels=4, encoder_blocks=1, decoder_blocks=1)
CONTINUOUS = replace(CONFIG, quantise=False)
BOTH = {"lfq": CONFIG, "continuous": CONTINUOUS}


def make(config=CONFIG, seed: int = 0, scale: float = 0.4, params=None) -> AutoencoderTokenizer:
    params = declare_tokenizer(config).init(seed) if params is None else params
    return LfqTokenizer(config, params) if config.quantise else ContinuousTokenizer(config, params, scale)


@pytest.fixture(scope="module", params=BOTH.values(), ids=BOTH)
def tokenizer(request):
    return make(request.param)


@pytest.fixture(scope="module")
def saved(tokenizer, tmp_path_factory):
    directory = tmp_path_factory.mktemp("saved")
    save_tokenizer(tokenizer, directory)
    return directory


@pytest.fixture
def copy(saved, tmp_path):
    """A saved tokenizer to be spoilt."""
    return shutil.copytree(saved, tmp_path / "tokenizer")


def refusal(directory, **options) -> str:
    with pytest.raises(ConfigError) as error:
        load_tokenizer(directory, **options)
    message = str(error.value)
    assert str(directory) in message, "it does not say where"
    return message


@pytest.mark.parametrize("config", BOTH.values(), ids=BOTH)
def test_the_program_of_the_page_computes_the_same_without_this_project(config, tmp_path, monkeypatch):
    """With NumPy: the methods that it calls are PyTorch's too."""
    rng = np.random.default_rng(0)
    config = replace(config, image_size=12, decoder_blocks=2)
    shapes = declare_tokenizer(config).shapes()
    there = make(config, params=jax.tree.map(lambda x: np.float32(rng.normal(size=x.shape)) / 2, shapes))
    save_tokenizer(there, tmp_path / "tokenizer")
    (program,) = (text for text in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL) if WEIGHTS in text)
    assert "hma_jax" not in program and "import torch as xp" in program
    monkeypatch.chdir(tmp_path)
    here: dict[str, Any] = {}
    exec(program.replace("import torch as xp", "import numpy as xp"), here)
    images = rng.integers(0, 256, (5, 12, 12, 3), np.uint8)
    tokens = there.encode(images)
    np.testing.assert_allclose(here["encode"](images), tokens, atol=1e-5)
    frames = here["decode"](tokens)
    assert frames.dtype == np.uint8 and np.abs(frames.astype(int) - there.decode(tokens)).max() <= 1


def test_what_was_saved_comes_back(tokenizer, saved):
    images = np.random.default_rng(0).integers(0, 256, (5, 8, 8, 3), np.uint8)
    again = load_tokenizer(saved, expect=tokenizer.config)
    tokens = tokenizer.encode(images)
    assert again.identity == tokenizer.identity
    assert np.array_equal(again.encode(images), tokens)
    assert np.array_equal(again.decode(tokens), tokenizer.decode(tokens))


def test_identity_is_of_every_weight_and_every_setting(tokenizer):
    config = tokenizer.config
    assert make(config).identity == tokenizer.identity
    leaves, structure = jax.tree.flatten(tokenizer.params)
    seen = {tokenizer.identity}
    for i, leaf in enumerate(leaves):
        flat = np.array(leaf).ravel()
        flat[-1] = np.nextafter(flat[-1], np.float32(9))  # the last bit of one number
        changed = jax.tree.unflatten(structure, [*leaves[:i], flat.reshape(leaf.shape), *leaves[i + 1 :]])
        seen.add(make(config, params=changed).identity)
    assert len(seen) == 1 + len(leaves)
    # The same weights, but other ids' meaning or another scale.
    other = make(replace(config, factors=1)) if config.quantise else make(config, scale=0.41)
    assert other.identity not in seen


def test_settings_of_the_other_kind_do_not_change_the_identity():
    """Tokenizers from before there were two kinds keep theirs."""
    assert make(replace(CONFIG, latent_noise=0.5)).identity == make().identity
    assert make(replace(CONTINUOUS, factors=1, entropy_weight=0.1)).identity == make(CONTINUOUS).identity
    assert make(CONTINUOUS).identity != make().identity


def test_saving_replaces_the_tokenizer_that_is_there(copy):
    other = make(replace(CONFIG, channels=5), seed=3)
    save_tokenizer(other, copy)
    assert load_tokenizer(copy).identity == other.identity
    assert {p.name for p in copy.iterdir()} == {DESCRIPTION, WEIGHTS}


@pytest.mark.parametrize("replaced", [0, 1])
def test_a_save_that_is_cut_short_leaves_no_tokenizer(copy, monkeypatch, replaced):
    """Killed before or after the weights were put in place."""
    calls = []

    def die(source, target):
        if len(calls) == replaced:
            raise KeyboardInterrupt
        calls.append(target)
        os.rename(source, target)

    monkeypatch.setattr("hma_jax.runtime.files.os.replace", die)
    with pytest.raises(KeyboardInterrupt):
        save_tokenizer(make(seed=1), copy)
    assert "no tokenizer at" in refusal(copy)


def test_nothing_there(tmp_path):
    for place in (tmp_path, tmp_path / "none"):
        assert "hma tokenizer train" in refusal(place)


@pytest.mark.parametrize("name", [DESCRIPTION, WEIGHTS])
def test_missing_file(copy, name):
    (copy / name).unlink()
    assert f"{name} is missing" in refusal(copy)


@pytest.mark.parametrize("name", [DESCRIPTION, WEIGHTS])
def test_truncated_file(copy, name):
    whole = (copy / name).read_bytes()
    for size in {0, 1, len(whole) // 2, len(whole) - 40}:
        (copy / name).write_bytes(whole[:size])
        message = refusal(copy)
        assert name in message and "again" in message


@pytest.mark.parametrize("name", [DESCRIPTION, WEIGHTS])
def test_flipped_bit_is_refused_or_harmless(copy, tokenizer, name):
    """Harmless: a date or a permission in the archive. What is loaded is what was saved."""
    whole = (copy / name).read_bytes()
    places = range(0, len(whole), 3 if name == DESCRIPTION else 37)
    refused = 0
    for place in places:
        spoilt = bytearray(whole)
        spoilt[place] ^= 1 << place % 8
        (copy / name).write_bytes(spoilt)
        try:
            assert load_tokenizer(copy).identity == tokenizer.identity
        except ConfigError:
            refused += 1
    assert refused > 0.5 * len(places)


@pytest.mark.parametrize(("field", "value"), [(8, 1), (10, 99)], ids=["encrypted", "unknown compression"])
def test_archive_that_claims_what_numpy_never_writes(copy, field, value):
    content = bytearray((copy / WEIGHTS).read_bytes())
    for header in (b"PK\x01\x02", b"PK\x03\x04"):  # of the directory and of the entry itself
        content[content.index(header) + field - 2 * (header == b"PK\x03\x04")] = value
    (copy / WEIGHTS).write_bytes(content)
    assert f"{WEIGHTS} is damaged" in refusal(copy)


@pytest.mark.parametrize("scale", [None, "1", True, 0.0, float("nan")])
def test_scale_that_is_none(scale, tmp_path):
    save_tokenizer(make(CONTINUOUS), tmp_path)
    values = json.loads((tmp_path / DESCRIPTION).read_text())
    (tmp_path / DESCRIPTION).write_text(json.dumps(values | {"latent_std": scale}))
    assert "again" in refusal(tmp_path)


@pytest.mark.parametrize("config", BOTH.values(), ids=BOTH)
def test_kind_that_the_configuration_contradicts(config, tmp_path):
    save_tokenizer(make(config), tmp_path)
    values = json.loads((tmp_path / DESCRIPTION).read_text())
    values["config"]["quantise"] = not config.quantise
    (tmp_path / DESCRIPTION).write_text(json.dumps(values))
    assert "needs tokenizer.quantise=" in refusal(tmp_path)


@pytest.mark.parametrize("text", ["null", "3", "[]", "{}", '{"kind": "lfq", "config": 3, "identity": "x"}'])
def test_json_that_describes_no_tokenizer(copy, text):
    (copy / DESCRIPTION).write_text(text)
    assert DESCRIPTION in refusal(copy)


def test_unknown_kind(copy):
    values = json.loads((copy / DESCRIPTION).read_text())
    (copy / DESCRIPTION).write_text(json.dumps(values | {"kind": "magvit"}))
    assert "unknown tokenizer kind 'magvit'; known: lfq, continuous" in refusal(copy)


def test_weights_of_another_training(copy, tmp_path):
    save_tokenizer(make(seed=1), tmp_path / "other")
    shutil.copy(tmp_path / "other" / WEIGHTS, copy / WEIGHTS)
    assert f"{WEIGHTS} is not the file that {DESCRIPTION} describes" in refusal(copy)


def test_weights_of_another_configuration(copy, tmp_path):
    save_tokenizer(make(replace(CONFIG, channels=5)), tmp_path / "other")
    shutil.copy(tmp_path / "other" / WEIGHTS, copy / WEIGHTS)
    message = refusal(copy)
    assert "should be (4,) but is (5,)" in message


def test_edited_configuration(copy):
    values = json.loads((copy / DESCRIPTION).read_text())
    values["config"]["image_size"] = 16
    (copy / DESCRIPTION).write_text(json.dumps(values))
    assert "identity" in refusal(copy)


def test_another_configuration_than_expected_names_the_fields(saved):
    message = refusal(saved, expect=replace(CONFIG, bits=6, channels=8))
    assert "bits: 4 -> 6" in message and "channels: 4 -> 8" in message and "factors" not in message


def test_directory_that_cannot_be_written(tokenizer, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot write the tokenizer to .*file/tokenizer"):
        save_tokenizer(tokenizer, tmp_path / "file" / "tokenizer")
