"""Images that are compared on the devices."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from hma_jax.config import EvalConfig
from hma_jax.evaluation.controllability import counterfactual
from hma_jax.evaluation.images import image_metrics
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
