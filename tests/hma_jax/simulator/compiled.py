"""Simulators of equal models share what they compile: it is a function of their settings, and takes weights as
arguments."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from typing import Any

import pytest

from hma_jax.config import DecodeConfig
from hma_jax.simulator import simulator as module
from hma_jax.simulator.programs import ProgramParams, Programs
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.training.runs import Model

COMPILED: dict[Any, Programs] = {}


def programs(model: Model, tokenizer: Tokenizer, episodes: int, decode: DecodeConfig) -> Programs:
    """In place of `Programs`: those that another simulator has compiled, if its settings were the same."""
    setting = model.run.train.masking.setting
    key = model.config, model.table, model.execution, setting, tokenizer.identity, episodes, decode
    if key not in COMPILED:
        COMPILED[key] = Programs(model, tokenizer, episodes, decode)
    shared = copy(COMPILED[key])
    shared.weights = ProgramParams(model.params, tokenizer.params)
    return shared


def forget(episodes: int) -> None:
    """Simulators of so many episodes compile anew what they run: for tests of when that is."""
    for key in [key for key in COMPILED if key[5] == episodes]:
        del COMPILED[key]


@pytest.fixture(autouse=True)
def shared_programs() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:  # unlike the fixture, it leaves steps that were traced
        patch.setattr(module, "Programs", programs)
        yield
