"""Writes one simulator dataset from the records of its episodes.

Owns the shards and the metadata; the dataset appears atomically. stats.json lies beside it, not in it: speed, lengths
and success of the episodes.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

from data_pipelines.errors import DataError
from data_pipelines.publishing.files import publish
from data_pipelines.publishing.output_lock import OutputLock
from data_pipelines.simulators.record import build_features
from data_pipelines.simulators.spec import SimSpec
from data_pipelines.simulators.worker import facts_path, record_path
from data_pipelines.sources.rlds.writer import VERSION, write_info, write_shards
from hma_jax.runtime.files import write_file

STATS = "stats.json"


def write_dataset(
    spec: SimSpec, home: Path, lock: OutputLock, staging: Path, *, episodes: int, size: int, metadata: dict
) -> None:
    """`<home>/<version>/` from the episodes in `staging`, which are then removed.

    `lock` is that of the dataset in `home`: its holder may remove the staging directories of other settings. Raises
    DataError for episodes whose states have different widths: a dataset has only one.
    """
    facts = [json.loads(facts_path(staging, i).read_text()) for i in range(episodes)]
    examples = {f["states"]: f["env"] for f in facts}
    if len(examples) > 1:
        found = ", ".join(f"{width} in {env}" for width, env in examples.items())
        raise DataError(
            f"{spec.name}: states have different numbers of values ({found}), but those of a dataset have one. The "
            "backend's `vector` must give as many in every environment of the robot"
        )

    def records(first: int, end: int) -> Iterator[bytes]:
        return (record_path(staging, i).read_bytes() for i in range(first, end))

    frames = sum(f["frames"] for f in facts)
    train = write_shards(lock.scratch, spec.name, "train", range(episodes), frames, records)
    layout = ", ".join(f"{what} {dim}" for what, dim in spec.layout)
    write_info(
        lock.scratch,
        spec.name,
        build_features(spec, size, facts[0]["states"]),
        {"train": train},
        f"Simulated by {spec.package}: {', '.join(spec.envs)}; actions at {spec.hz:g} Hz: {layout}.",
        metadata,
        module="data_pipelines.simulators",
    )
    _write_stats(home / STATS, spec, size, facts)
    publish(lock.scratch, home / VERSION)
    for left in home.glob(f".{VERSION}.episodes.*"):
        shutil.rmtree(left)


def _write_stats(path: Path, spec: SimSpec, size: int, facts: list[dict]) -> None:
    stats = {
        "name": spec.name,
        "size": size,
        "frames": [f["frames"] for f in facts],
        "seconds": [f["seconds"] for f in facts],
        "success": [f["success"] for f in facts] if spec.success else None,
        "machine": _machine(),
        "date": time.strftime("%Y-%m-%d"),
    }
    write_file(path, json.dumps(stats))


def _machine() -> str:
    """CPU and cores, for people to read."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:  # not Linux
        lines = []
    model = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "")
    return f"{model or platform.machine()}, {os.cpu_count()} cores"
