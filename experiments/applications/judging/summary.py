"""The summary of a judgement as JSON: success rates and agreement with intervals, episodes per second."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from experiments.analysis.intervals import Interval
from experiments.applications.judging.agreement import (
    Agreement,
    agree,
    agree_with_counts,
    count_interval,
    mean_above,
    rate_interval,
    share,
)
from experiments.applications.judging.judge import Judgement
from experiments.applications.judging.outcomes import HEAD, LEARNED, SHUFFLED, STATE, TRUE, successes
from experiments.applications.judging.real import Count
from experiments.applications.judging.user_success import UserSuccess
from hma_jax.runtime.files import write_file

REFERENCE, REAL, MODEL, CONTROL = "true, by state", "real robot", "learned, by head", "shuffled, by head"

COLUMNS = {
    REFERENCE: (TRUE, STATE),
    "true, by head": (TRUE, HEAD),
    MODEL: (LEARNED, HEAD),
    CONTROL: (SHUFFLED, HEAD),
}
"""What is shown of every policy: (world, judge)."""

COMPARED = {
    "learned model": MODEL,
    "the head alone, on true frames": "true, by head",
    "control: actions of other episodes": CONTROL,
}
"""What is compared with the reference: success in the true world by state, or success of the real robot."""

UNKNOWN = {"mean": None, "low": None, "high": None}


def summarise(judged: Judgement, real: Mapping[str, Count] | None = None) -> dict[str, Any]:
    """The content of agreement.json: every number with its interval. `real`: the counts of some policies on the real
    robot."""
    columns = {name: where for name, where in COLUMNS.items() if where[0] in judged.worlds}
    each = {name: successes(judged.outcomes, judged.policies, *where) for name, where in columns.items()}
    rates = {
        name: {column: _plain(rate_interval(succeeded[i])) for column, succeeded in each.items()}
        for i, name in enumerate(judged.policies)
    }
    if real:
        counted = {name: _plain(count_interval(*real[name])) if name in real else UNKNOWN for name in judged.policies}
        rates = {name: {REAL: counted[name], **succeeded} for name, succeeded in rates.items()}
    return {
        "robot": judged.config.task.robot,
        "task": judged.config.task.goal,
        "frames": judged.config.task.frames,
        "hold": judged.config.task.hold,
        "starts": judged.config.starts,
        "policies": rates,
        "own": list(judged.user_policies),
        "own success": isinstance(judged.head, UserSuccess),
        "actions beyond the range": {name: round(share, 4) for name, share in judged.clipped.items()},
        "compared with": REAL if real else REFERENCE if REFERENCE in each else None,
        "agreement": {
            name: {
                "policies and starts": {m: _plain(x) for m, x in succeeded.measures.items()},
                "starts": {m: _plain(x) for m, x in succeeded.over_starts.items()},
            }
            for name, succeeded in _compare(judged, each, real).items()
        },
        "above the control": _plain(mean_above(each[MODEL], each[CONTROL])),
        "episodes alike": _alike(each[MODEL], each[REFERENCE]) if REFERENCE in each else {},
        "head": judged.head.measured,
        "episodes per second": {world: round(1 / s, 3) for world, s in judged.seconds.items()},
    }


def _compare(
    judged: Judgement, each: Mapping[str, np.ndarray], real: Mapping[str, Count] | None
) -> dict[str, Agreement]:
    compared = {name: column for name, column in COMPARED.items() if column in each}
    if REFERENCE in each:
        return {name: agree(each[REFERENCE], each[column]) for name, column in compared.items()}
    if not real:
        return {}
    rows = [judged.policies.index(name) for name in real]
    counts = np.array(list(real.values())).T
    return {name: agree_with_counts(*counts, each[column][rows]) for name, column in compared.items()}


def _alike(learned: np.ndarray, true: np.ndarray) -> dict[str, dict[str, float | None]]:
    same = learned == true
    among = {"all episodes": np.ones_like(same), "those that truly succeed": true, "those that truly fail": ~true}
    return {name: _plain(share(same, some)) for name, some in among.items() if some.any()}


def _plain(interval: Interval) -> dict[str, float | None]:
    """The interval, rounded; None where it is unknown."""
    values = dataclasses.asdict(interval)
    kept = {key: values[key] for key in ("mean", "low", "high")}
    return {key: None if not math.isfinite(x) else round(x, 4) for key, x in kept.items()}


def write_summary(summary: dict[str, Any], path: Path) -> None:
    write_file(path, json.dumps(summary, indent=1) + "\n")


def shown(value: dict[str, float | None]) -> str:
    """'0.93 (0.71 to 0.99)'."""
    if value["mean"] is None:
        return "–"
    text = f"{value['mean']:.2f}"
    return text if value["low"] is None else f"{text} ({value['low']:.2f} to {value['high']:.2f})"
