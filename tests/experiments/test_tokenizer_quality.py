"""What a tokenizer's reconstruction of held-out frames is said to be, and how surely."""

import inspect
import itertools
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from data_pipelines.loading.frames import make_frame_loader
from data_pipelines.sampling.splits import HeldOut
from experiments.preparing import given_tokenizer
from experiments.preparing import tokenizer as tokenizer_step
from experiments.preparing.made_from import MadeFrom
from experiments.preparing.tokenizer import reconstruction_psnr
from experiments.presets import SMOKE
from experiments.running.workspace import Workspace
from experiments.study import StoreConfig
from hma_jax.evaluation.metrics import psnr
from hma_jax.evaluation.statistics import Stat

EACH, GROUPS, EPISODES = 4, 4, 3


class Off:
    """A tokenizer that leaves frames off by what their first pixel says."""

    def reconstruct(self, images):
        return images + images[:, :1, :1]


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
    expected = [psnr(Off().reconstruct(batch), batch) for batch in images]
    assert found.mean == pytest.approx(np.mean(expected))


def test_a_tokenizer_is_trained_on_what_the_store_does_not_hold_out_and_judged_on_what_it_does(tmp_path, monkeypatch):
    held_out = HeldOut(0.3, 3, 7, 0.4)
    kept = {"corrupt": "skip", "max_skipped": 5.0}
    study = replace(
        SMOKE,
        store=StoreConfig(**asdict(held_out), **kept),
        tau=2.0,
        tokenizer_train=replace(SMOKE.tokenizer_train, seed=4),
    )
    loaders, judged = [], []

    def make(*arguments, **options) -> SimpleNamespace:
        loaders.append(SimpleNamespace(**inspect.signature(make_frame_loader).bind(*arguments, **options).arguments))
        return loaders[-1]

    def train(config, train, frames, aside: Path, **_) -> Off:
        frames(6)
        aside.mkdir()
        return Off()

    def judge(tokenizer, frames) -> Stat:
        judged.append(frames)
        return reconstruction_psnr(Off(), Frames(np.random.default_rng(0)))

    monkeypatch.setattr("data_pipelines.loading.frames.make_frame_loader", make)
    monkeypatch.setattr("hma_jax.tokenizers.train.train_tokenizer", train)
    monkeypatch.setattr(tokenizer_step, "reconstruction_psnr", judge)
    monkeypatch.setattr(tokenizer_step, "tokenizer_made_from", lambda *_: MadeFrom({}))
    tokenizer_step.make_tokenizer(study, Workspace(tmp_path), [(SimpleNamespace(name="arm"), tmp_path)])

    same = {"tau": 2.0, "seed": 4, "batch": study.tokenizer_train.batch, "image_size": study.tokenizer.image_size}
    (test, training) = loaders
    for loader, split, start in ((test, "val", 0), (training, "train", 6)):
        expected = {"held_out": held_out} | kept | same | {"split": split, "start_step": start}
        assert {name: getattr(loader, name) for name in expected} == expected
    assert judged == [test]


@pytest.mark.parametrize(
    ("channels", "encode", "said"),
    [
        (3, lambda signs: signs, ""),
        (3, lambda signs: 5.5 * signs, "mean of 0 and a standard deviation of 5.5, and reach 5.5."),
        (3, lambda signs: 0.01 * signs, "standard deviation of 0.01,"),
        (3, lambda signs: signs + 20, "mean of 20 and a standard deviation of 1, and reach 21."),
        (3, lambda signs: np.append(np.tile(signs, 2000), 40), "none beyond model.diffusion.clip, 10."),
        (0, lambda signs: 5.5 * signs, ""),  # ids
    ],
)
def test_unusual_latents_are_told(channels, encode, said, tmp_path, monkeypatch, capsys):
    """Models of them were trained in vain, without a word."""
    tokenizer = SimpleNamespace(channels=channels, image_size=8, encode=encode)
    monkeypatch.setattr("hma_jax.tokenizers.io.load_tokenizer", lambda _: tokenizer)
    monkeypatch.setattr(given_tokenizer, "make_frames", lambda *_, **__: iter([np.float32([-1, 1])]))
    monkeypatch.setattr(given_tokenizer, "reconstruction_psnr", lambda *_: Stat(20.0, 0.1, 8, 2))
    workspace = Workspace(tmp_path)
    workspace.tokenizer.mkdir()
    given_tokenizer.judge_tokenizer(SMOKE, workspace, [])
    told = " ".join(capsys.readouterr().out.split())
    assert said in told and ("standard deviation" in told) == bool(said)
