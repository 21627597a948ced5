"""Clips play, keep their pixels, and say which frames were given."""

import base64
import io
import re

import numpy as np
from PIL import Image, ImageSequence

from experiments.report.clips import GIVEN, HOLD_MS, PREDICTED, REST, SHOW_MS, animate, describe_clips
from experiments.report.pieces import moving

RNG = np.random.default_rng(0)
CLIPS = [RNG.integers(0, 255, (6, 16, 16, 3), np.uint8) for _ in range(3)]


def test_an_animation_plays_all_frames_without_loss():
    picture = Image.open(io.BytesIO(animate(CLIPS, prompt=2)))
    assert picture.is_animated and picture.n_frames == 6
    durations = []
    for t, frame in enumerate(ImageSequence.Iterator(picture)):
        pixels = np.asarray(frame.convert("RGB"))
        for i, clip in enumerate(CLIPS):
            np.testing.assert_array_equal(pixels[:16, 17 * i : 17 * i + 16], clip[t])
        durations.append(frame.info["duration"])
    assert durations == [SHOW_MS] * 5 + [HOLD_MS]


def test_the_bar_says_what_was_given():
    frames = ImageSequence.Iterator(Image.open(io.BytesIO(animate(CLIPS, prompt=2))))
    bars = [np.asarray(f.convert("RGB"))[-1] for f in frames]

    def share(bar, colour):
        return round(6 * float((bar == colour).all(-1).mean()))

    assert [share(b, GIVEN) for b in bars] == [1, 2, 2, 2, 2, 2]
    assert [share(b, PREDICTED) for b in bars] == [0, 0, 1, 2, 3, 4]
    assert share(bars[0], REST) == 5


def test_robots_stand_in_the_order_asked_for(tmp_path):
    kinds = ("true", "predicted", "random")
    samples = {f"{name}/{kind}": clip[None] for name in "abc" for kind, clip in zip(kinds, CLIPS, strict=True)}
    np.savez(tmp_path / "samples.npz", **samples)
    words = describe_clips(tmp_path / "samples.npz", 2, ("c", "a", "unknown"))
    assert words.index("<figcaption>c<") < words.index("<figcaption>a<") and "<figcaption>b<" not in words
    assert words.count("data:image/webp;base64,") == 2 * 2  # each moves, or stands still
    assert words.count("class=strip") == 2  # the same on paper


def test_a_clip_that_stands_still_is_its_last_frame():
    """There predictions are the furthest from what was given. Both say what they show."""
    film = animate(CLIPS, prompt=2)
    pictures = re.findall(r'<span class=(\w+)><img loading=lazy alt="arm" src="data:image/webp;base64,(.*?)">', moving(
        film, "arm", "loading=lazy"
    ))  # fmt: skip
    (_, plays), (kind, still) = pictures
    assert kind == "still" and base64.b64decode(plays) == film
    *_, last = ImageSequence.Iterator(Image.open(io.BytesIO(film)))
    np.testing.assert_array_equal(Image.open(io.BytesIO(base64.b64decode(still))).convert("RGB"), last.convert("RGB"))
