"""Shared by tests of experiments: programs that are compiled once, pages without the time that drawing takes."""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from hma_jax.evaluation import evaluate as evaluation
from hma_jax.tokenizers.base import Tokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


def leave_unrendered(patch: pytest.MonkeyPatch) -> None:
    """Figures are made as ever, with all that they show, and their files hold one pixel: laying them out and painting
    them takes most of the time of a page."""
    patch.setattr("matplotlib.figure.Figure.savefig", lambda figure, file, **_: file.write(PIXEL))


@pytest.fixture
def unrendered(monkeypatch):
    leave_unrendered(monkeypatch)


COMPILED: dict[Any, Callable] = {}


def once(key: Any, make: Callable[..., Callable], *arguments: Any) -> Callable:
    if key not in COMPILED:
        COMPILED[key] = make(*arguments)
    return COMPILED[key]


@pytest.fixture(scope="module", autouse=True)
def compiled_once() -> Iterator[None]:
    """Every command reads its tokenizer anew, whose functions are then others, and with them all that they are traced
    in. No test here replaces a part of them."""
    make_evaluator, over_devices = evaluation.make_evaluator, Tokenizer._jit_over_devices

    def evaluator(*settings: Any) -> Callable:
        *others, decode, piece = settings
        of = getattr(decode, "__self__", None)
        return once((*others, getattr(of, "identity", decode), piece), make_evaluator, *settings)

    def jitted(tokenizer: Tokenizer, function: Callable) -> Callable:
        if type(tokenizer) is not LfqTokenizer or tokenizer._mesh.size > 1:  # others may hold what was measured
            return over_devices(tokenizer, function)
        return once((tokenizer.config, function.__name__), over_devices, tokenizer, function)

    with pytest.MonkeyPatch.context() as patch:  # unlike the fixture, it leaves steps that were traced
        patch.setattr(evaluation, "make_evaluator", evaluator)
        patch.setattr(Tokenizer, "_jit_over_devices", jitted)
        yield
