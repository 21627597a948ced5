"""The table of a generated simulator suite: sizes, speed, success. Reads stats.json files only."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from data_pipelines.errors import DataError
from data_pipelines.json_file import read_object
from data_pipelines.simulators.embodiments import EMBODIMENTS
from data_pipelines.simulators.spec import SimSpec
from data_pipelines.simulators.write import STATS

HEADER = "| dataset | package | dims | Hz | expert | episodes | frames | seconds | frames/s | success |"


def stats_table(root: Path) -> str:
    """Markdown, one row per dataset of the suite under `root`, in the order of the table.

    Episode lengths are shortest to longest, in seconds of the robot's time; frames/s is what one process simulated and
    drew, including the start of the first episode. Raises DataError if there is no dataset, or a stats.json cannot be
    read.
    """
    rows, machines, sizes, dates = [], set(), set(), set()
    for spec in EMBODIMENTS:
        path = root / spec.name / STATS
        if not path.is_file():
            continue
        advice = f"Remove the file to leave {spec.name} out of the table, or the whole directory to simulate it again."
        stats = read_object(path, if_missing=advice, advice=advice)
        try:
            rows.append(_row(spec, stats))
            machines.add(stats["machine"])
            sizes.add(f"{stats['size']} px")
            dates.add(stats["date"])
        except (KeyError, TypeError, ValueError) as error:
            raise DataError(f"{path} lacks what a run writes there ({error!r}). {advice}") from error
    if not rows:
        raise DataError(f"{root}: no simulator datasets; make them with `hma data sim --out {root}`.")
    made = f"{len(rows)} datasets, {', '.join(sorted(sizes))}, made on {', '.join(sorted(machines))}, "
    rule = "|---|---|" + "--:|" * 2 + "---|" + "--:|" * 5
    return "\n".join([made + " and ".join(sorted(dates)) + ".", "", HEADER, rule, *rows])


def _row(spec: SimSpec, stats: dict[str, Any]) -> str:
    frames, success = stats["frames"], stats["success"]
    lengths = f"{min(frames) / spec.hz:.1f} to {max(frames) / spec.hz:.1f}"
    rate = "" if success is None else f"{sum(success)}/{len(success)}"
    speed = f"{np.sum(frames) / np.sum(stats['seconds']):.0f}"
    what = [f"`{spec.name}`", spec.package, f"{spec.action_dim}", f"{spec.hz:.3g}"]
    how = [spec.expert or "wanders", f"{len(frames)}", f"{np.sum(frames)}", lengths, speed, rate]
    return f"| {' | '.join(what + how)} |"
