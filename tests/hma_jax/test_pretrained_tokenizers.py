"""Pretrained tokenizers and pixels behind the one interface: tokens, clips, types, devices."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import AnyTokenizerConfig, ConfigError, Magvit2Config, PixelsConfig, SvdVaeConfig, TokenizerConfig
from hma_jax.config.json import from_dict, to_json
from hma_jax.model.frames import compose, factorise
from hma_jax.tokenizers.io import KINDS, load_config, load_tokenizer, save_tokenizer
from hma_jax.tokenizers.network import from_pixels, to_pixels
from hma_jax.tokenizers.quantizer import ids_to_codes
from tests.hma_jax.pretrained import MAGVIT2_SMALL, PIXELS_SMALL, VAE_SMALL, make, noise
from tests.hma_jax.test_tokenizer import BOTH as TRAINED_HERE

CONFIGS = {c.kind: c for c in (MAGVIT2_SMALL, VAE_SMALL, PIXELS_SMALL)}


@pytest.fixture(scope="module", params=CONFIGS.values(), ids=CONFIGS)
def tokenizer(request):
    return make(request.param, piece=4)


@pytest.fixture(scope="module")
def magvit2():
    return make(MAGVIT2_SMALL, piece=4)


@pytest.fixture(scope="module")
def vae():
    return make(VAE_SMALL, piece=4)


# --- The interface -----------------------------------------------------------------------------


def test_every_kind_is_tested():
    """The user's own code by test_own_tokenizer.py."""
    assert set(KINDS) == {*CONFIGS, *TRAINED_HERE, "python"}, "add a small configuration of yours to CONFIGS"


def test_facts_are_those_of_the_tokens(tokenizer):
    tokens = tokenizer.encode(noise(3))
    facts = (tokenizer.vocab_size, tokenizer.factors, tokenizer.factor_vocab)
    if tokenizer.channels:
        assert tokens.shape == (3, tokenizer.grid**2, tokenizer.channels) and tokens.dtype == np.float32
        assert facts == (0, 0, 0)
    else:
        assert tokens.shape == (3, tokenizer.tokens) and tokens.dtype == np.int32
        assert facts == (64, 2, 8) and len(np.unique(tokens)) > 3
    frames = tokenizer.decode(tokens)
    assert frames.shape == (3, 16, 16, 3) and frames.dtype == np.uint8


def test_published_sizes_are_those_of_the_released_models():
    magvit2, vae = Magvit2Config(), SvdVaeConfig()
    assert (magvit2.tokens, magvit2.factors, magvit2.factor_vocab, magvit2.vocab_size) == (256, 2, 512, 2**18)
    assert (vae.tokens, vae.token_channels, replace(vae, patch=1).grid) == (256, 16, 32)


def test_tokens_do_not_depend_on_the_batch_they_came_in(tokenizer):
    images = noise(9)
    tokens = tokenizer.encode(images)
    assert np.array_equal(tokenizer.encode(images[::-1])[::-1], tokens)
    assert np.array_equal(tokenizer.encode(images[5:6]), tokens[5:6])


def test_decoding_inside_a_jit_gives_the_same_frames(tokenizer):
    tokens = tokenizer.encode(noise(4))
    frames = np.asarray(jax.jit(tokenizer.decode_fn)(tokenizer.params, tokens))
    assert frames.dtype == np.float32
    np.testing.assert_allclose(frames, tokenizer.decode(tokens), atol=0.51)


def test_saved_and_loaded_it_is_the_same(tokenizer, tmp_path):
    save_tokenizer(tokenizer, tmp_path)
    again = load_tokenizer(tmp_path, piece=4)
    assert again.identity == tokenizer.identity and load_config(tmp_path) == tokenizer.config
    assert np.array_equal(again.encode(noise(2)), tokenizer.encode(noise(2)))


def test_every_setting_changes_the_identity(magvit2, vae):
    assert make(MAGVIT2_SMALL, seed=1).identity != magvit2.identity
    for tokenizer, change in (
        (magvit2, {"compute_dtype": "bfloat16"}),
        (magvit2, {"factors": 3}),
        (vae, {"scale": 0.2}),
        (vae, {"patch": 1}),
    ):
        assert make(replace(tokenizer.config, **change)).identity != tokenizer.identity


def test_half_precision_makes_nearly_the_same(tokenizer):
    config = tokenizer.config
    if isinstance(config, PixelsConfig):
        return
    half = make(replace(config, compute_dtype="bfloat16"), piece=4)
    tokens = tokenizer.encode(noise(4))
    got = half.encode(noise(4))
    assert got.dtype == tokens.dtype
    if tokenizer.channels:
        assert 0 < np.abs(got - tokens).max() < 0.05 * np.abs(tokens).max()
    else:
        bits = np.asarray(ids_to_codes(got, 6) == ids_to_codes(tokens, 6))
        assert bits.mean() > 0.9
    frames, same = half.decode(tokens), tokenizer.decode(tokens)
    assert np.abs(frames.astype(int) - same).mean() < 2


@dataclass(frozen=True)
class Holder:
    tokenizer: AnyTokenizerConfig


def test_a_configuration_of_any_kind_comes_back_from_json():
    for config in (*CONFIGS.values(), TokenizerConfig(bits=12)):
        assert from_dict(Holder, json.loads(to_json(Holder(config)))) == Holder(config)
    with pytest.raises(ConfigError, match="unknown kind 'vq'; known: magvit2, svd-vae, pixels"):
        from_dict(Holder, {"tokenizer": {"kind": "vq"}})


@pytest.mark.parametrize(
    ("make_config", "message"),
    [
        (lambda: replace(MAGVIT2_SMALL, image_size=17), "magvit2.image_size 17 is not a multiple of 2"),
        (lambda: replace(MAGVIT2_SMALL, image_size=(16, 17)), r"image_size \(16, 17\) is not a multiple of 2"),
        (lambda: replace(VAE_SMALL, image_size=18), "svd-vae.image_size 18 is not a multiple of 4"),
        (lambda: replace(MAGVIT2_SMALL, groups=3), "4 channels cannot be split into 3 groups"),
        (lambda: replace(MAGVIT2_SMALL, bits=5), "bits 5 cannot be split into 2"),
        (lambda: replace(VAE_SMALL, scale=0.0), "scale must be positive"),
        (lambda: replace(PIXELS_SMALL, std=-1.0), "std must be positive"),
    ],
)
def test_a_configuration_that_cannot_work_is_refused(make_config, message):
    with pytest.raises(ConfigError, match=message):
        make_config()


# --- Images that are not square ----------------------------------------------------------------


@pytest.mark.parametrize("kind", [pytest.param(k, marks=[pytest.mark.slow] * (k == "svd-vae")) for k in CONFIGS])
def test_images_need_not_be_square(kind, tmp_path):
    """Rows and columns are not taken for each other: not going in, not coming out, not on disk."""
    config = replace(CONFIGS[kind], image_size=(12, 20))
    tokenizer = make(config, piece=2)
    images = np.random.default_rng(0).integers(0, 256, (2, 12, 20, 3), np.uint8)
    rows, columns = config.grid_shape
    tokens = tokenizer.encode(images)
    assert tokens.shape[:2] == (2, tokenizer.tokens) == (2, rows * columns) and rows < columns
    frames = tokenizer.decode(tokens)
    assert frames.shape == images.shape
    if kind == "pixels":
        assert np.array_equal(frames, images)
    else:
        network = tokenizer._declared.merge(tokenizer.params)
        if kind == "magvit2":
            codes = ids_to_codes(jnp.asarray(tokens).reshape(2, rows, columns), config.bits)
            want = jax.jit(network.decoder)(codes)
        else:
            want = network.decode(tokenizer.cells(jnp.asarray(tokens)), 1)
        np.testing.assert_array_less(np.abs(np.asarray(to_pixels(want)) - frames), 0.51)
    save_tokenizer(tokenizer, tmp_path)
    assert load_config(tmp_path) == config and load_tokenizer(tmp_path).identity == tokenizer.identity
    with pytest.raises(ConfigError, match="12, 20, 3"):
        tokenizer.encode(images.swapaxes(1, 2))
    for side in ("image_size", "grid"):
        with pytest.raises(ConfigError, match="12 x 20 pixels, but square images|grid of . x .*no single side"):
            getattr(tokenizer, side)


def test_a_square_is_written_as_one_number_and_keeps_its_identity():
    pair = replace(MAGVIT2_SMALL, image_size=(16, 16))
    assert pair == MAGVIT2_SMALL and '"image_size": 16' in to_json(pair)
    assert make(PIXELS_SMALL).identity == make(replace(PIXELS_SMALL, image_size=(16, 16))).identity
    assert make(PIXELS_SMALL).identity == "7f095de6cea08766"  # as before there were others than squares
    with pytest.raises(ConfigError, match="expected 2 values"):
        from_dict(Magvit2Config, {"image_size": [8, 8, 8]})


# --- Ids ---------------------------------------------------------------------------------------


def test_bit_k_of_an_id_is_the_sign_of_channel_k_and_factor_0_holds_the_low_ones(magvit2):
    images = noise(3)
    network = magvit2.declare(magvit2.config)
    z = jax.jit(lambda p, x: network.merge(p).encoder(from_pixels(x)))(magvit2.params, images)
    bits = (np.asarray(z) > 0).reshape(3, -1, 6)
    ids = magvit2.encode(images)
    assert np.array_equal(ids, (bits * 2 ** np.arange(6)).sum(-1))
    digits = factorise(jnp.asarray(ids), magvit2.factors, magvit2.factor_vocab)
    assert np.array_equal(digits[..., 0], (bits[..., :3] * 2 ** np.arange(3)).sum(-1))
    assert np.array_equal(compose(digits, magvit2.factor_vocab), ids)


# --- Latents -----------------------------------------------------------------------------------


def test_tokens_are_patches_of_the_scaled_mean_and_cells_undo_it(vae):
    images = noise(2)
    network = vae.declare(vae.config)
    mean = jax.jit(lambda p, x: network.merge(p).moments(from_pixels(x))[0])(vae.params, images)
    mean = np.asarray(mean)  # [B, 8, 8, 4]
    tokens = vae.encode(images)
    assert tokens.shape == (2, 16, 16)
    patch = 0.18215 * mean[:, 2:4, 4:6].reshape(2, 16)  # second row of patches, third column
    np.testing.assert_allclose(tokens[:, 4 + 2], patch, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(vae.cells(jnp.asarray(tokens)), mean, rtol=1e-4, atol=1e-4)


def test_latents_far_outside_are_clipped_before_they_are_decoded(vae):
    edge = np.full((1, 16, 16), 25 * 0.18215, np.float32)
    assert np.array_equal(vae.decode(4 * edge), vae.decode(edge))


# --- Pixels ------------------------------------------------------------------------------------


def test_every_pixel_comes_back_also_from_half_precision():
    tokenizer = make(PixelsConfig(image_size=16, patch=4))
    images = np.arange(768, dtype=np.uint8).reshape(1, 16, 16, 3)  # all 256 grey levels
    tokens = tokenizer.encode(images)
    assert tokens.shape == (1, 16, 48) and abs(float(tokens.std()) - 1.15) < 0.01
    assert np.array_equal(tokenizer.decode(tokens.astype(np.float16)), images)


def test_a_token_is_its_patch():
    tokenizer = make(PixelsConfig(image_size=16, patch=4))
    images = noise(1)
    patch = images[0, 4:8, 8:12].astype(np.float32).reshape(-1) / 63.75 - 2
    np.testing.assert_allclose(tokenizer.encode(images)[0, 4 + 2], patch, atol=1e-5)
