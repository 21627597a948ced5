"""The continuous tokenizer: the scale of its latents, what it decodes, the noise it is trained with."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, TokenizerConfig, TokenizerTrainConfig
from hma_jax.tokenizers.autoencoder import declare_tokenizer
from hma_jax.tokenizers.continuous import ContinuousTokenizer, make_continuous
from hma_jax.tokenizers.lfq import LfqTokenizer
from hma_jax.tokenizers.train import make_optimizer, make_train_step, tokenizer_loss
from hma_jax.training.state import TrainState
from tests.hma_jax.pretrained import noise

CONTINUOUS = TokenizerConfig(
    image_size=16, downsample=4, quantise=False, bits=6, channels=16, encoder_blocks=1, decoder_blocks=1
)


@pytest.fixture(scope="module")
def continuous():
    return ContinuousTokenizer(CONTINUOUS, declare_tokenizer(CONTINUOUS).init(0), 0.3)


def test_latents_that_cannot_be_decoded_are_refused(continuous):
    latents = np.zeros((2, 16, 6), np.float32)
    for wrong in (latents[..., :5], latents[:, :9], latents[0], latents.astype(np.int32)):
        with pytest.raises(ConfigError, match=r"decodes latents, float \[B, 16, 6\], got"):
            continuous.decode(wrong)
    latents[1, 3, 2] = np.nan
    with pytest.raises(ConfigError, match="not finite; did the model diverge"):
        continuous.decode(latents)


def test_half_precision_latents_decode_as_well(continuous):
    """The token store keeps them so."""
    latents = continuous.encode(noise(2))
    exact, stored = continuous.decode(latents), continuous.decode(latents.astype(np.float16))
    assert np.abs(exact.astype(int) - stored).max() <= 1


def test_latents_have_unit_deviation_on_the_frames_they_were_measured_on():
    batches = [noise(8, seed=seed) for seed in range(3)]
    tokenizer = make_continuous(CONTINUOUS, declare_tokenizer(CONTINUOUS).init(0), iter(batches))
    latents = np.concatenate([tokenizer.encode(images) for images in batches])
    assert latents.std() == pytest.approx(1, abs=1e-5) and abs(tokenizer.latent_std - 1) > 0.1


def test_scale_of_the_latents_is_undone_by_decoding(continuous):
    other = ContinuousTokenizer(CONTINUOUS, continuous.params, 2 * continuous.latent_std)
    latents = continuous.encode(noise(4))
    np.testing.assert_allclose(other.encode(noise(4)), latents / 2, rtol=1e-6)
    assert np.array_equal(other.decode(latents / 2), continuous.decode(latents))


def test_latents_outside_the_encoders_range_are_taken_back_to_it(continuous):
    edge = np.full((1, 16, 6), 1 / continuous.latent_std, np.float32)
    assert np.array_equal(continuous.decode(5 * edge), continuous.decode(edge))
    assert not np.array_equal(continuous.decode(0.5 * edge), continuous.decode(edge))


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf")])
def test_what_is_no_scale_is_refused(continuous, scale):
    with pytest.raises(ConfigError, match="standard deviation of the latents must be positive"):
        ContinuousTokenizer(CONTINUOUS, continuous.params, scale)


def test_kind_must_be_that_of_the_configuration(continuous):
    with pytest.raises(ConfigError, match="needs tokenizer.quantise=true"):
        LfqTokenizer(CONTINUOUS, continuous.params)
    with pytest.raises(ConfigError, match="needs tokenizer.quantise=false"):
        ContinuousTokenizer(replace(CONTINUOUS, quantise=True), continuous.params, 1.0)


def test_any_number_of_channels_makes_a_continuous_token():
    assert TokenizerConfig(quantise=False, bits=37).token_channels == 37
    for wrong in ({"bits": 0}, {"latent_noise": -0.1}):
        with pytest.raises(ConfigError, match=f"tokenizer.{next(iter(wrong))}"):
            TokenizerConfig(quantise=False, **wrong)


QUICK = replace(CONTINUOUS, encoder_blocks=0, decoder_blocks=0)
"""Compiled in no time."""


def test_noise_reaches_the_decoder_and_is_the_keys():
    declared = declare_tokenizer(QUICK)
    params, images = declared.init(0), jnp.asarray(noise(4))

    def losses(noise: float) -> list[float]:
        """Of the same images under two keys."""
        chosen = replace(QUICK, latent_noise=noise)
        loss = jax.jit(lambda params, key: tokenizer_loss(declared, params, images, chosen, key)[0])
        return [float(loss(params, jax.random.key(seed))) for seed in (0, 1)]

    silent, noisy = losses(0.0), losses(0.3)
    assert silent[0] == silent[1] and len({*silent, *noisy}) == 3


def test_every_step_of_training_draws_noise_of_its_own():
    config, train = replace(QUICK, latent_noise=0.5), TokenizerTrainConfig()
    declared = declare_tokenizer(config)
    params, step = declared.init(0), jax.jit(make_train_step(config, train, declared))
    optimizer = make_optimizer(train, declared).init(params)
    losses = [float(step(TrainState(jnp.int32(n), params, optimizer), noise(4))[1]["loss"]) for n in (0, 0, 1)]
    assert losses[0] == losses[1] != losses[2]


def test_the_psnr_that_training_shows_is_that_of_images_from_0_to_255():
    declared, images = declare_tokenizer(QUICK), noise(4)
    params, config = declared.init(0), replace(QUICK, latent_noise=0.0)

    @jax.jit
    def shown_and_made(params):
        model = declared.merge(params)
        made = model.decoder(model.encoder(images / 127.5 - 1.0))
        return tokenizer_loss(declared, params, jnp.asarray(images), config, jax.random.key(0))[1]["psnr"], made

    shown, made = shown_and_made(params)
    error = np.mean(((np.asarray(made, np.float64) + 1) * 127.5 - images) ** 2)
    assert float(shown) == pytest.approx(10 * np.log10(255**2 / error), abs=1e-3)
