"""What a success head is trained on, and what it is asked."""

from types import SimpleNamespace

import numpy as np
import pytest

from experiments.applications.judging import head as of_head
from experiments.applications.judging.head import (
    HeadConfig,
    HeadJudge,
    SuccessHead,
    fit_heads,
    init_head,
    load_head,
    save_head,
    train_head,
)
from experiments.applications.policies.network import EncoderConfig
from hma_jax.config import ConfigError

CONFIG = HeadConfig(encoder=EncoderConfig(8, (4, 4, 4), 8))


def test_a_head_is_trained_and_asked_with_the_first_frame_before_the_present_one(monkeypatch):
    """Every fourth pair is learnt as the tokenizer shows it, here by 100 brighter."""
    levels = np.arange(12, dtype=np.uint8).reshape(2, 6)
    images = np.broadcast_to(levels[..., None, None, None], (2, 6, 8, 8, 3)).copy()
    lengths = np.array([6, 5])
    steps = np.nonzero(np.arange(6) < lengths[:, None])
    demos = SimpleNamespace(images=images, reached=levels > 2, steps=lambda: steps)
    monkeypatch.setattr(of_head, "fit_heads", lambda *given: {CONFIG.fit.steps: given})
    pairs, labels, *_ = train_head(demos, CONFIG, 0, lambda shown: shown + 100, lambda *_: None)
    first, present = pairs[:, :, 0, 0, 0].T.tolist()
    brighter = [100 * (i % 4 == 0) for i in range(11)]
    assert present == np.add(np.arange(11), brighter).tolist() and labels.tolist() == (np.arange(11) > 2).tolist()
    assert first == np.add([0] * 6 + [6] * 5, brighter).tolist()

    asked = SuccessHead(CONFIG, {})
    asked.predict_pairs = lambda pairs: pairs[:, 1, 0, 0, 0] - 10.0 * pairs[:, 0, 0, 0, 0]
    np.testing.assert_array_equal(asked.probabilities(images, images[:, :1]), levels - 10.0 * levels[:, :1])


@pytest.mark.parametrize(
    "images",
    [
        np.zeros((2, 8, 8, 3)),
        np.zeros((2, 8, 8, 3), int),
        np.zeros((2, 8, 8), np.uint8),
        np.zeros((0, 8, 8, 3), np.uint8),
    ],
    ids=["in 0..1", "int64", "grey", "none"],
)
def test_a_head_is_asked_of_images_of_256_levels(images):
    """Those in 0..1 were rounded, and looked black."""
    usual = np.zeros((2, 8, 8, 3), np.uint8)
    for pair in ((images, usual[:1]), (usual, images)):
        with pytest.raises(ConfigError, match=r"need images uint8 \[..., H, W, 3\], got "):
            SuccessHead(CONFIG, {}).probabilities(*pair)


def test_a_head_is_read_as_it_was_written_and_refused_where_its_description_lacks_something(tmp_path):
    where = str(tmp_path / "head")
    save_head(SuccessHead(CONFIG, init_head(CONFIG, 0), {"frames": 1.0}), where)
    assert load_head(where).measured == {"frames": 1.0} and load_head(where).config == CONFIG
    for damaged in ("{}", "[]"):
        (tmp_path / "head/head.json").write_text(damaged)
        with pytest.raises(ConfigError, match="head.json does not say all of config, measured; train it again"):
            load_head(where)


@pytest.mark.parametrize(("hold", "message"), [(0, "must be at least 1, got 0"), (1.5, r"whole numbers, got \[1.5\]")])
def test_a_judge_waits_for_one_or_more_frames_with_success(hold, message):
    """With 0 every episode ended at once."""
    with pytest.raises(ConfigError, match=message):
        HeadJudge(SuccessHead(CONFIG, {}), hold)


def test_frames_with_success_weigh_as_much_together_as_those_without(monkeypatch):
    monkeypatch.setattr(of_head, "fit", lambda params, loss, data, *_: {0: data})
    monkeypatch.setattr(of_head, "SuccessHead", lambda config, data: data)
    labels = np.array([True, False, False, False, False])
    data = fit_heads(np.zeros((5, 2, 8, 8, 3), np.uint8), labels, CONFIG, 0, lambda *_: None)[0]
    np.testing.assert_allclose(data["weight"], [2.5, 0.625, 0.625, 0.625, 0.625])
