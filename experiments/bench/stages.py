"""A process that runs stages of our base models on request: `python -m experiments.bench.stages ROWS DTYPE`.

Reads a stage's name per line, runs it once and answers with the seconds it took; the first time includes
compilation. `experiments.bench.against_release` lets it take turns with another program.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

from experiments.bench.models import EXECUTION, make_subject
from experiments.bench.programs import RELEASE_SAMPLER, repeatable
from experiments.bench.timing import time_once
from hma_jax.config.execution import Dtype

FEW_STEPS = ("dpm++", 10)


def stages(rows: int, dtype: Dtype) -> dict[str, Callable[[], Any]]:
    """Name -> a call of it, of `rows` examples computed in `dtype`."""
    return {name: lambda made=made: _call(*made, rows, dtype)() for name, made in PROGRAMS.items()}


PROGRAMS = {
    "forward": ("base", "forward", RELEASE_SAMPLER),
    "fill": ("base", "fill", RELEASE_SAMPLER),
    "slide": ("base", "slide", RELEASE_SAMPLER),
    "step": ("base", "step", RELEASE_SAMPLER),
    "continuous fill": ("base-continuous", "fill", RELEASE_SAMPLER),
    "continuous slide": ("base-continuous", "slide", RELEASE_SAMPLER),
    "continuous few": ("base-continuous", "fill", FEW_STEPS),
}
"""Model, program, and how latents are sampled, of every stage."""


@cache
def _call(model: str, program: str, sampler: tuple[str, int], rows: int, dtype: Dtype) -> Callable[[], Any]:
    return repeatable(make_subject(model, replace(EXECUTION, dtype=dtype)), program, sampler, rows)


def serve(calls: dict[str, Callable[[], Any]]) -> None:
    """Answers on what was standard output; whatever else is printed goes to standard error."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    for line in sys.stdin:
        print(time_once(calls[line.strip()])[1], file=answers, flush=True)


if __name__ == "__main__":
    serve(stages(int(sys.argv[1]), sys.argv[2]))
