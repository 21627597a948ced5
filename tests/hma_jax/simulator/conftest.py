"""Simulators of the same tiny model share what they compile."""

from typing import Any

import pytest

from hma_jax.simulator import simulator as module
from hma_jax.simulator.programs import Programs

COMPILED: dict[Any, Programs] = {}


def programs(model, tokenizer, episodes, decode) -> Programs:
    """In place of `Programs`: those that another simulator has compiled, if they are the same."""
    key = id(model), episodes, decode
    if key not in COMPILED:
        COMPILED[key] = Programs(model, tokenizer, episodes, decode)
    return COMPILED[key]


@pytest.fixture(autouse=True)
def shared_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "Programs", programs)
