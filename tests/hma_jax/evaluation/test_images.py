"""Images that are compared on the devices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import EvalConfig
from hma_jax.evaluation.controllability import counterfactual
from hma_jax.evaluation.images import image_metrics
from hma_jax.evaluation.metrics import MAX_PSNR, psnr
from hma_jax.evaluation.protocol import Predicted


@pytest.mark.exact
def test_frames_that_no_action_changes_cost_nothing_to_the_last_bit():
    """A processor with fused multiplication and addition printed 2.384e-07 dB, which is read as a gain."""
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (8, 3, 8, 8, 3), np.uint8)  # [B, T, H, W, C]
    shown = rng.integers(0, 256, (8, 2, 8, 8, 3), np.uint8)  # tokens are the images themselves
    predicted = Predicted(shown, np.repeat(shown[:, -1:], 5, axis=1), None)
    config = EvalConfig(prompt_frames=1)
    judge = jax.jit(lambda made, seen: image_metrics(lambda _, tokens: tokens, 64, {}, made, seen, config))
    assert not judge(predicted, images)["delta_psnr"].any()
    gain = jax.jit(counterfactual)(shown, shown, images[:, 1:], images[:, :1], np.ones(8, bool), None)
    assert not gain["counterfactual_gain"].any()


IMAGES = np.random.default_rng(0).integers(0, 256, (2, 5, 8, 8, 3), np.uint8)
REAL = np.arange(5) < np.array([[5], [4]])  # [B, T]


@jax.jit
def compared(predicted: Predicted):
    """With IMAGES, of which two are given; latents are the values of pixels."""
    others = IMAGES, np.ones(2, bool)
    decode = lambda _, latents: latents.astype(jnp.uint8)  # noqa: E731
    return image_metrics(decode, 64, {}, predicted, IMAGES, EvalConfig(prompt_frames=2), REAL, others)


def perfect() -> Predicted:
    future = IMAGES[:, 2:].astype(np.float32)
    last = np.stack([future[0, 2:3], future[1, 1:2]])
    return Predicted(future.copy(), last, None, future.copy())


def test_a_short_window_ends_with_its_last_real_frame():
    found = compared(perfect())
    for name in ("psnr", "psnr_last", "psnr_random", "counterfactual_psnr"):
        np.testing.assert_allclose(found[name], MAX_PSNR, rtol=1e-6, err_msg=name)
    copied = [psnr(np.repeat(x[1:2], n, axis=0), x[2 : 2 + n]).mean() for x, n in zip(IMAGES, (3, 2), strict=True)]
    np.testing.assert_allclose(found["psnr_copy"], copied, rtol=1e-5)


@pytest.mark.parametrize(
    ("part", "window", "frame", "judged"),
    [("tokens", 0, 0, False), ("random_last", 0, 0, False), ("other", 1, 1, False), ("tokens", 1, 2, True)],
)
def test_windows_with_a_latent_that_is_no_number_are_marked_unless_it_is_padding(part, window, frame, judged):
    predicted = perfect()
    getattr(predicted, part)[window, frame, 0, 0, 0] = np.nan
    assert compared(predicted)["finite"].tolist() == [judged or window != w for w in (0, 1)]
