"""What a judgement comes to: rates with intervals, agreement with intervals, seconds per episode; as JSON."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from experiments.analysis.intervals import Interval
from experiments.applications.judging.agreement import agree, rate_interval, share
from experiments.applications.judging.judge import Judged
from experiments.applications.judging.outcomes import HEAD, LEARNED, SHUFFLED, STATE, TRUE, successes
from hma_jax.runtime.files import write_file

COLUMNS = {
    "true, by state": (TRUE, STATE),
    "true, by head": (TRUE, HEAD),
    "learned, by head": (LEARNED, HEAD),
    "shuffled, by head": (SHUFFLED, HEAD),
}
"""What is shown of every policy: (world, judge)."""

REFERENCE = "true, by state"

COMPARED = {
    "learned model": "learned, by head",
    "the head alone, on true frames": "true, by head",
    "control: actions of other episodes": "shuffled, by head",
}
"""What is compared with the reference."""


def summarise(judged: Judged) -> dict[str, Any]:
    """What agreement.json says; every number with its interval."""
    columns = {name: where for name, where in COLUMNS.items() if where[0] in judged.worlds}
    each = {name: successes(judged.outcomes, judged.policies, *where) for name, where in columns.items()}
    reference = each[REFERENCE]
    compared = {name: agree(reference, each[column]) for name, column in COMPARED.items()}
    same = each["learned, by head"] == reference
    alike = {
        "all episodes": np.ones_like(same),
        "those that truly succeed": reference,
        "those that truly fail": ~reference,
    }
    return {
        "robot": judged.config.task.robot,
        "task": judged.config.task.goal,
        "frames": judged.config.task.frames,
        "hold": judged.config.task.hold,
        "starts": judged.config.starts,
        "policies": {
            name: {column: _plain(rate_interval(found[i])) for column, found in each.items()}
            for i, name in enumerate(judged.policies)
        },
        "own": list(judged.own),
        "actions beyond the range": {name: round(share, 4) for name, share in judged.beyond.items()},
        "agreement": {
            name: {
                "policies and starts": {m: _plain(x) for m, x in found.measures.items()},
                "starts": {m: _plain(x) for m, x in found.over_starts.items()},
            }
            for name, found in compared.items()
        },
        "episodes alike": {name: _plain(share(same, among)) for name, among in alike.items() if among.any()},
        "head": judged.head.measured,
        "episodes per second": {world: round(1 / s, 3) for world, s in judged.seconds.items()},
    }


def _plain(interval: Interval) -> dict[str, float | None]:
    """Rounded; None where there is no telling."""
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
