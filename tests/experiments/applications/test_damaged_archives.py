"""An .npz file with a changed byte is named, whoever reads it."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from experiments.applications.detector import Detector
from experiments.applications.endurance.films import Film, load_films
from experiments.applications.judging.rollouts import load_rollout
from experiments.applications.policies.demonstrations import load_demonstrations
from hma_jax.config import ConfigError
from hma_jax.simulator.starts import load_starts

READERS = (Detector.load, load_films, load_rollout, load_demonstrations, load_starts)


@pytest.mark.parametrize("read", READERS)
def test_a_changed_byte_is_named_with_what_to_do(read, tmp_path):
    names = (f"toy/{fields(Film)[0].name}", "robots", "images", "0000/toy/seed")  # something of what each reads
    np.savez_compressed(tmp_path / "a.npz", **{name: np.arange(64) for name in names})
    content = bytearray((tmp_path / "a.npz").read_bytes())
    at = 0
    for _ in names:
        at = content.index(b"PK\x03\x04", at)
        name, extra = np.frombuffer(content[at + 26 : at + 30], "<u2").tolist()
        at += 30 + name + extra
        content[at] = 0xFF  # where an array begins, packed: zlib finds it
    (tmp_path / "a.npz").write_bytes(content)
    with pytest.raises(ConfigError, match="a.npz .*(invalid|Error).*; (make|remove|record|train)"):
        read(tmp_path / "a.npz")
