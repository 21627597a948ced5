"""The tokenizers: what tokens mean, what they depend on, and that training teaches them something."""

import itertools
import pickle
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, TokenizerConfig, TokenizerTrainConfig
from hma_jax.evaluation.metrics import psnr
from hma_jax.model.frames import compose, factorise
from hma_jax.model.params import Declared, ParamSpec, zeros
from hma_jax.tokenizers import quantizer
from hma_jax.tokenizers.autoencoder import AutoencoderTokenizer, declare_tokenizer
from hma_jax.tokenizers.base import PIECE, in_pieces
from hma_jax.tokenizers.continuous import ContinuousTokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer
from hma_jax.tokenizers.quantizer import (
    commitment,
    ids_to_codes,
    latents_to_ids,
    nearest_code,
    quantize,
)
from hma_jax.tokenizers.train import make_optimizer, tokenizer_loss, train_tokenizer
from hma_jax.training.checkpoints import CheckpointError
from hma_jax.training.loop import LoopOptions
from tests.hma_jax.pretrained import noise

CONFIG = TokenizerConfig(
    image_size=16, downsample=4, bits=6, factors=2, channels=16, encoder_blocks=1, decoder_blocks=1
)
CONTINUOUS = replace(CONFIG, quantise=False)
BOTH = {"lfq": CONFIG, "continuous": CONTINUOUS}
TRAIN = TokenizerTrainConfig(steps=40, batch=8, learning_rate=1e-2, warmup_steps=2)

entropies = jax.jit(quantizer.entropies, static_argnums=(1, 2))


def fresh(config: TokenizerConfig, seed: int = 0) -> AutoencoderTokenizer:
    """Untrained: random weights do for everything but quality."""
    params = declare_tokenizer(config).init(seed)
    return LfqTokenizer(config, params) if config.quantise else ContinuousTokenizer(config, params, 0.3)


@pytest.fixture(scope="module", params=BOTH.values(), ids=BOTH)
def tokenizer(request):
    return fresh(request.param)


@pytest.fixture(scope="module")
def discrete():
    return fresh(CONFIG)


def scenes(count: int, seed: int = 0) -> np.ndarray:
    """A bright square somewhere on a dim background: simple enough to be learnt in seconds."""
    rng = np.random.default_rng(seed)
    images = np.full((count, 16, 16, 3), 40, np.uint8)
    for image, (row, column), colour in zip(
        images, rng.integers(0, 12, (count, 2)), rng.integers(128, 256, (count, 3)), strict=True
    ):
        image[row : row + 5, column : column + 5] = colour
    return images


# --- Ids -------------------------------------------------------------------------------------


def test_every_id_survives_the_way_through_codes():
    ids = jnp.arange(CONFIG.vocab_size, dtype=jnp.int32)
    codes = ids_to_codes(ids, CONFIG.bits)
    assert set(np.unique(codes)) == {-1.0, 1.0} and len(np.unique(codes, axis=0)) == CONFIG.vocab_size
    assert np.array_equal(latents_to_ids(codes), ids)
    assert np.array_equal(latents_to_ids(0.01 * codes), ids)  # the sign counts, not the size


def test_bit_k_of_an_id_is_channel_k():
    only_k = 2 * jnp.eye(CONFIG.bits) - 1
    assert latents_to_ids(only_k).tolist() == [2**k for k in range(CONFIG.bits)]


@pytest.mark.parametrize("factors", [1, 2, 3])
def test_factors_are_those_of_the_model(factors):
    config = replace(CONFIG, factors=factors)
    ids = jnp.arange(config.vocab_size, dtype=jnp.int32)
    digits = factorise(ids, factors, config.factor_vocab)
    assert np.array_equal(compose(digits, config.factor_vocab), ids)
    low = config.bits // factors  # factor 0 is the low channels
    assert np.array_equal(digits[:, 0], latents_to_ids(ids_to_codes(ids, config.bits)[:, :low]))


# --- Quantiser -------------------------------------------------------------------------------


def test_gradient_passes_the_quantiser_unchanged():
    z = jnp.asarray(np.random.default_rng(0).normal(size=(5, 6)), jnp.float32).at[0, 0].set(0.0)
    codes, pull = jax.vjp(quantize, z)
    np.testing.assert_allclose(codes, np.where(z > 0, 1, -1), atol=1e-6)
    arriving = jnp.arange(30.0).reshape(5, 6)
    assert np.array_equal(pull(arriving)[0], arriving)


def test_codes_used_in_training_are_those_of_the_ids():
    z = jnp.asarray(np.random.default_rng(1).normal(size=(50, 6)), jnp.float32).at[0].set(0.0)
    assert np.array_equal(nearest_code(z), ids_to_codes(latents_to_ids(z), 6))


def test_commitment_pulls_latents_to_their_own_code():
    z = jnp.array([[0.5, -0.25, 1.0]])
    value, gradient = jax.value_and_grad(commitment)(z)
    assert value == pytest.approx((0.5**2 + 0.75**2) / 3)
    np.testing.assert_allclose(gradient, 2 / 3 * np.array([[-0.5, 0.75, 0.0]]), rtol=1e-6)


@pytest.mark.parametrize("factors", [1, 2, 3])
def test_entropies_are_those_of_a_softmax_over_all_codes(factors):
    """Against the definition, with every code of a factor written out."""
    z = np.random.default_rng(2).normal(size=(7, 2, 6)).astype(np.float32)
    temperature, width = 0.7, 6 // factors
    codes = np.array(list(itertools.product([-1, 1], repeat=width)))
    parts = z.reshape(14, factors, 1, width)
    p = np.exp(-((parts - codes) ** 2).sum(-1) / temperature)
    p /= p.sum(-1, keepdims=True)
    mean = p.mean(0)
    expected = [-(q * np.log(q)).sum(-1).mean() / width for q in (p, mean)]
    np.testing.assert_allclose(entropies(jnp.asarray(z), factors, temperature), expected, rtol=1e-5)


def test_entropies_reach_their_bounds():
    every_code = ids_to_codes(jnp.arange(64), 6)
    uncertainty, diversity = entropies(every_code, 2, 0.05)
    assert uncertainty == pytest.approx(0, abs=1e-6) and diversity == pytest.approx(np.log(2), abs=1e-5)
    uncertainty, diversity = entropies(jnp.zeros((9, 6)), 2, 1.0)
    assert uncertainty == pytest.approx(np.log(2)) and diversity == pytest.approx(np.log(2))
    assert entropies(jnp.ones((9, 6)), 2, 0.05)[1] == pytest.approx(0, abs=1e-6)  # one code for all


# --- Images to tokens and back ---------------------------------------------------------------


def test_shapes_and_types_of_both_ways(tokenizer):
    tokens = tokenizer.encode(noise(3))
    if tokenizer.kind == "lfq":
        assert tokens.shape == (3, tokenizer.tokens) == (3, 16) and tokens.dtype == np.int32
        assert tokens.min() >= 0 and tokens.max() < tokenizer.vocab_size == 64
        assert (tokenizer.channels, tokenizer.factors, tokenizer.factor_vocab) == (0, 2, 8)
    else:
        assert tokens.shape == (3, tokenizer.tokens, tokenizer.channels) == (3, 16, 6)
        assert tokens.dtype == np.float32
        assert (tokenizer.vocab_size, tokenizer.factors, tokenizer.factor_vocab) == (0, 0, 0)
    assert len(np.unique(tokens)) > 10
    frames = tokenizer.decode(tokens)
    assert frames.shape == (3, 16, 16, 3) and frames.dtype == np.uint8


def test_tokens_do_not_depend_on_the_batch_they_came_in(tokenizer):
    """Else a dataset tokenised on another day, or in other batches, would be another dataset."""
    images = noise(2 * PIECE + 3)
    tokens = tokenizer.encode(images)
    assert len(tokens) == len(images)
    assert np.array_equal(tokenizer.encode(images[::-1])[::-1], tokens)
    for i in (0, PIECE - 1, PIECE, len(images) - 1):  # the last of these stood in a padded piece
        assert np.array_equal(tokenizer.encode(images[i : i + 1])[0], tokens[i])
    frames = tokenizer.decode(tokens)
    assert np.array_equal(tokenizer.decode(tokens[-5:]), frames[-5:])


def test_images_are_encoded_in_full_precision_on_every_device(tokenizer):
    """What accelerators round more by default; a CPU does not."""
    program = jax.jit(tokenizer.encode_fn).lower(tokenizer.params, noise(1)).as_text()
    products = re.findall("dot_general.*", program)
    assert products and all("precision = [HIGHEST, HIGHEST]" in product for product in products)


@pytest.mark.parametrize("rows", [1, 4, 5, 8])
def test_networks_only_see_whole_pieces(rows):
    """One shape: one compilation, and rounding that cannot depend on the size of a batch."""
    sizes = []

    def double(piece):
        sizes.append(len(piece))
        return 2 * piece

    numbers = np.arange(rows * 3).reshape(rows, 3)
    assert np.array_equal(in_pieces(double, numbers, size=4), 2 * numbers)
    assert set(sizes) == {4} and len(sizes) == -(-rows // 4)


def test_a_token_sees_its_own_patch_only(tokenizer):
    """Row-major grid: a change inside patch (r, c) may change token 4 r + c and no other."""
    before = noise(8)
    tokens = tokenizer.encode(before)
    for token in range(16):
        row, column = 4 * (token // 4), 4 * (token % 4)
        after = before.copy()
        after[:, row : row + 4, column : column + 4] ^= 255
        changed = (tokenizer.encode(after) != tokens).reshape(8, 16, -1).any(axis=(0, 2))
        assert changed[token], "it does not even see its own patch"
        assert changed.sum() == 1


def test_decoding_inside_a_jit_gives_the_same_frames(tokenizer):
    tokens = tokenizer.encode(noise(PIECE))
    frames = np.asarray(jax.jit(tokenizer.decode_fn)(tokenizer.params, tokens))
    assert frames.dtype == np.float32 and frames.min() >= 0 and frames.max() <= 255
    np.testing.assert_allclose(frames, tokenizer.decode(tokens), atol=0.51)


def test_a_tokenizer_goes_to_another_process(tokenizer):
    """Pickled, as it goes there; the devices that it has here cannot be."""
    other = pickle.loads(pickle.dumps(tokenizer))
    assert type(other) is type(tokenizer) and (other.identity, other.piece) == (tokenizer.identity, tokenizer.piece)


def test_what_cannot_be_encoded_is_refused(tokenizer):
    images = noise(2)
    for wrong in (images.astype(np.float32), images[0], images[:, :8], images[..., :1]):
        with pytest.raises(ConfigError, match=r"encodes uint8 images \[B, 16, 16, 3\], got"):
            tokenizer.encode(wrong)
    with pytest.raises(ConfigError, match="empty batch"):
        tokenizer.encode(images[:0])
    with pytest.raises(ConfigError, match="encode at least 1 image at a time, got 0"):
        LfqTokenizer(CONFIG, {}, piece=0)


def test_ids_that_cannot_be_decoded_are_refused(discrete):
    ids = np.zeros((2, 16), np.int32)
    for given, got in (
        (ids[:, :9], r"int32 \[2, 9\]"),
        (ids + 3.7, r"float64 \[2, 16\]"),
        (ids > 0, r"bool \[2, 16\]"),
    ):
        with pytest.raises(ConfigError, match=rf"decodes ids, integers \[B, 16\], got {got}"):
            discrete.decode(given)
    for wrong in (-1, 64):
        with pytest.raises(ConfigError, match=r"must lie in \[0, 64\)"):
            discrete.decode(ids + wrong)


# --- Training --------------------------------------------------------------------------------


def test_regularisers_reach_loss_and_encoder():
    config = replace(CONFIG, encoder_blocks=0, decoder_blocks=0)  # quick to compile
    declared = declare_tokenizer(config)
    params, images = declared.init(0), jnp.asarray(scenes(4))

    weighted = [replace(config, **{name: 0.5}) for name in ("entropy_weight", "commitment_weight")]

    @jax.jit
    def evaluate(params):
        def one(config):
            loss = partial(tokenizer_loss, declared, images=images, config=config, key=jax.random.key(0))
            (total, metrics), gradient = jax.value_and_grad(loss, has_aux=True)(params)
            return total, metrics, gradient["encoder"]["head"]["kernel"]

        return [one(c) for c in [config, *weighted]]

    (plain, terms, at_rest), *others = evaluate(params)
    expected = float(terms["uncertainty"] - terms["diversity"]), float(terms["commitment"])
    for term, (total, _, moved) in zip(expected, others, strict=True):
        assert term != 0 and float(total - plain) == pytest.approx(0.5 * term, abs=1e-6)
        assert not np.allclose(moved, at_rest)


def test_a_wide_factor_is_trained_but_has_no_entropies():
    """They take an array of all codes for each token."""
    wide = {"bits": 13, "factors": 1}
    with pytest.raises(ConfigError, match="a factor of 13 bits is too wide for the entropy loss"):
        replace(CONFIG, **wide, entropy_weight=0.1)
    config = replace(CONFIG, **wide, encoder_blocks=0, decoder_blocks=0, commitment_weight=0.5)
    declared, key = declare_tokenizer(config), jax.random.key(0)
    shapes = declared.shapes(), jax.ShapeDtypeStruct((4, 16, 16, 3), jnp.uint8)
    _, terms = jax.eval_shape(lambda params, images: tokenizer_loss(declared, params, images, config, key), *shapes)
    assert set(terms) == {"loss", "psnr", "commitment"}


def train(run_dir: Path, *, config=CONFIG, settings=TRAIN, last_step: int | None = None, **options):
    """Trains on random scenes; the source breaks after `last_step` batches."""

    def batches(start: int):
        for step in itertools.count(start):
            if last_step is not None and step >= last_step:
                raise OSError("the disk went away")
            yield scenes(settings.batch, seed=step)

    return train_tokenizer(config, settings, batches, run_dir, **options)


@pytest.fixture(scope="module", params=BOTH.values(), ids=BOTH)
def trained(request, tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("tokenizer")
    metrics = []
    tokenizer = train(
        run_dir,
        config=request.param,
        provenance={"data": "a"},
        progress=lambda step, steps, values: metrics.append(values),
    )
    return tokenizer, metrics, run_dir


def test_training_raises_psnr_on_images_it_has_not_seen(trained):
    tokenizer, metrics, _ = trained
    assert len(metrics) == TRAIN.steps
    assert np.mean([m["loss"] for m in metrics[-5:]]) < 0.5 * metrics[0]["loss"]
    held_out = scenes(32, seed=10_000)
    untrained = fresh(tokenizer.config, TRAIN.seed)
    quality, before = (psnr(held_out, t.decode(t.encode(held_out))).mean() for t in (tokenizer, untrained))
    assert quality > before + 4


def test_same_seed_same_tokenizer_also_after_a_crash(trained, tmp_path):
    config, options = trained[0].config, LoopOptions(checkpoint_every=10)
    with pytest.raises(OSError, match="the disk went away"):
        train(tmp_path, config=config, last_step=25, options=options)
    assert train(tmp_path, config=config, options=options).identity == trained[0].identity


@pytest.mark.parametrize("trained", [CONFIG], ids=["lfq"], indirect=True)
def test_another_seed_is_another_tokenizer(trained, tmp_path):
    other = train(tmp_path, config=trained[0].config, settings=replace(TRAIN, seed=1))
    assert other.identity != trained[0].identity


def test_run_of_another_configuration_is_not_resumed(trained, tmp_path):
    again = partial(train, shutil.copytree(trained[2], tmp_path / "run"), config=trained[0].config)
    with pytest.raises(CheckpointError, match=r"train.learning_rate: 0.01 -> 0.1"):
        again(settings=replace(TRAIN, learning_rate=0.1), provenance={"data": "a"})
    with pytest.raises(CheckpointError, match="provenance.data: 'a' -> 'b'"):
        again(provenance={"data": "b"})
    assert again(provenance={"data": "a"}).identity == trained[0].identity


@pytest.mark.parametrize(
    ("images", "got"),
    [
        (np.zeros((8, 16, 16, 3), np.float32), r"float32 \[8, 16, 16, 3\]"),  # in 0..1, say: all of them would be black
        (np.zeros((8, 3, 16, 16), np.uint8), r"uint8 \[8, 3, 16, 16\]"),
    ],
    ids=["floats", "channels first"],
)
def test_other_images_are_not_trained_on(images, got, tmp_path):
    with pytest.raises(ConfigError, match=rf"a tokenizer is trained on uint8 images \[B, 16, 16, 3\], got {got}"):
        train_tokenizer(CONFIG, TRAIN, lambda start: itertools.repeat(images), tmp_path)


TWO = Declared(None, {name: ParamSpec((3,), (None,), "hidden", name == "w", zeros) for name in ("w", "b")}, 1)
"""A matrix, and a bias, which does not decay."""


def updates_of(gradients: list[float], **settings) -> dict[str, np.ndarray]:
    """[n, 3] each: what the optimiser adds to TWO, all ones, in every step."""
    params = {"w": jnp.ones(3), "b": jnp.ones(3)}
    optimizer = make_optimizer(replace(TRAIN, **settings), TWO)
    state, update, found = optimizer.init(params), jax.jit(optimizer.update), []
    for gradient in gradients:
        moved, state = update({name: jnp.full(3, gradient) for name in params}, state, params)
        found.append(moved)
    return {name: np.array([moved[name] for moved in found]) for name in params}


@pytest.mark.parametrize("steps", [1, 2, 3])
def test_runs_shorter_than_their_warm_up_learn(steps):
    sizes = np.abs(updates_of([1.0] * steps, steps=steps, warmup_steps=50)["w"])
    assert np.isfinite(sizes).all() and sizes.max() == pytest.approx(TRAIN.learning_rate, rel=0.01)


def test_the_rate_warms_up_and_falls_to_its_end_and_biases_do_not_decay():
    """Without gradients decay alone moves anything."""
    settings = dict(steps=10, warmup_steps=2, learning_rate=0.1, final_fraction=0.25, weight_decay=0.5)
    found = updates_of([0.0] * 11, **settings)
    rates = -found["w"][:, 0] / 0.5
    np.testing.assert_allclose(rates[[0, 1, 2, 10]], [0, 0.05, 0.1, 0.025], rtol=1e-5)
    assert (np.diff(rates[2:]) < 0).all() and not found["b"].any()


def test_gradients_are_clipped_to_the_norm_that_is_configured():
    """What is above it counts no more than what reaches it."""
    above, at = (updates_of([g, 0.1, 0.1], weight_decay=0.0, clip_norm=2.0)["w"] for g in (100.0, 2 / 6**0.5))
    np.testing.assert_allclose(above, at, rtol=1e-4)
