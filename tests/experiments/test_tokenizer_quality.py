"""What a tokenizer's reconstruction of held-out frames is said to be, and how surely."""

import itertools

import numpy as np
import pytest

from experiments.preparing import tokenizer as tokenizer_step
from experiments.preparing.tokenizer import reconstruction_psnr
from hma_jax.evaluation.metrics import psnr

EACH, GROUPS, EPISODES = 4, 4, 3


class Off:
    """A tokenizer that leaves frames off by what their first pixel says."""

    def encode(self, images):
        return images

    def decode(self, tokens):
        return tokens + tokens[:, :1, :1]


class Frames:
    """Batches of GROUPS episodes, EACH frames of each; every third is of another dataset. Frames of an episode are
    equally hard, up to one grey level."""

    def __init__(self, rng: np.random.Generator):
        self.rng, self.step = rng, 0
        self.hard = rng.integers(2, 30, (2, EPISODES))

    def episodes(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        number = step * GROUPS + np.arange(GROUPS)
        return np.repeat(number % 3 == 2, EACH).astype(int), np.repeat(number // 2 % EPISODES, EACH)

    def __iter__(self):
        return self

    def __next__(self) -> np.ndarray:
        off = self.hard[self.episodes(self.step)] + self.rng.integers(0, 2, GROUPS * EACH)
        self.step += 1
        return np.broadcast_to(off[:, None, None, None], (GROUPS * EACH, 2, 2, 3)).astype(np.uint8)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    monkeypatch.setattr(tokenizer_step, "QUALITY_FRAMES", 2 * EPISODES * EACH)


def test_the_error_of_a_reconstruction_counts_episodes_within_datasets():
    """In three hundred tries the standard error is what means scatter by, up to three in ten: episodes tell it
    badly."""
    means, sems, rng = [], [], np.random.default_rng(0)
    for _ in range(300):
        found = reconstruction_psnr(Off(), Frames(rng))
        assert (found.n, found.episodes) == (32, 5)  # two batches: three episodes of one dataset, two of the other
        means.append(found.mean)
        sems.append(found.sem)
    assert np.sqrt(np.mean(np.square(sems))) == pytest.approx(np.std(means), rel=0.3)


def test_every_frame_counts_equally():
    images = list(itertools.islice(Frames(np.random.default_rng(1)), 2))
    found = reconstruction_psnr(Off(), Frames(np.random.default_rng(1)))
    expected = [psnr(Off().decode(batch), batch) for batch in images]
    assert found.mean == pytest.approx(np.mean(expected))
