"""Commands on tiny RLDS datasets under registered names, in which nothing is learnt: a training step only counts."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import jax.numpy as jnp
import pytest

from data_pipelines.registry import get_spec
from experiments.preparing import tokenizer
from hma_jax.tokenizers import train as tokenizer_training
from hma_jax.training import train as model_training

ARM, BASE = map(get_spec, ("berkeley_gnm_cory_hall", "ucsd_pick_and_place_dataset_converted_externally_to_rlds"))
LENGTHS = [12, 13, 14, 15, 12, 13]  # a whole window of the smoke study takes 12 native frames
SMOKE = ("--preset", "smoke")


def idle_step(*_):
    """A training step that counts."""

    def step(state, batch):
        return state._replace(step=state.step + 1), {"loss": jnp.float32(5), "psnr": jnp.float32(5)}

    return step


@contextmanager
def idle() -> Iterator[None]:
    """Within it nothing is learnt."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tokenizer_training, "make_train_step", idle_step)
        patch.setattr(model_training, "make_train_step", idle_step)
        patch.setattr(tokenizer, "QUALITY_FRAMES", 8)
        yield


@pytest.fixture(scope="module", autouse=True)
def idle_training() -> Iterator[None]:
    with idle():
        yield
