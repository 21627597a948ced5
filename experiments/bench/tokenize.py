"""Tokenizers: images in, tokens out, and back, host copies included."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from experiments.bench.record import Stage
from experiments.bench.timing import WARM_UP, time_by_turns, time_once
from hma_jax.config import Magvit2Config, SvdVaeConfig, require
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.io import load_tokenizer
from hma_jax.tokenizers.pretrained import Magvit2Tokenizer, SvdVaeTokenizer

PUBLISHED = {"magvit2": (Magvit2Tokenizer, Magvit2Config), "svd-vae": (SvdVaeTokenizer, SvdVaeConfig)}
"""Timed with drawn weights: speed does not depend on them."""


def make_tokenizer(name: str, dtype: str, piece: int | None, seed: int) -> Tokenizer:
    """A published tokenizer by name, or the one in a directory. Raises ConfigError if there is none."""
    if name not in PUBLISHED:
        require(Path(name).is_dir(), f"no tokenizer {name!r}: give {', '.join(PUBLISHED)} or a tokenizer's directory")
        return load_tokenizer(Path(name), piece=piece)
    kind, config_class = PUBLISHED[name]
    config = config_class(dtype=dtype)
    return kind(config, kind.declare(config).init(seed), piece=piece)


def time_tokenizer(tokenizer: Tokenizer, repeats: int, seed: int) -> list[Stage]:
    """Stages `encode`, `decode` and `both`, for as many images as the devices take at once."""
    rows = tokenizer.at_once
    shape = (rows, tokenizer.image_size, tokenizer.image_size, 3)
    images = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
    tokens, encode_seconds = time_once(lambda: tokenizer.encode(images))
    _, decode_seconds = time_once(lambda: tokenizer.decode(tokens))
    calls = {
        "encode": lambda: tokenizer.encode(images),
        "decode": lambda: tokenizer.decode(tokens),
        "both": lambda: tokenizer.decode(tokenizer.encode(images)),
    }
    timings = time_by_turns(calls, repeats, warm_up=WARM_UP - 1)
    first = {"encode": encode_seconds, "decode": decode_seconds, "both": 0.0}
    return [
        Stage(name, rows, timing, max(first[name] - timing.median, 0.0), frames=rows)
        for name, timing in timings.items()
    ]
