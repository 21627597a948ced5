"""One benchmark's record: JSON with everything needed to check or repeat it."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import jax

from experiments.bench.timing import Compiled, Timing, peak_memory_bytes
from experiments.running.machine import describe_machine
from hma_jax.config import ConfigError
from hma_jax.config.json import from_dict, to_dict
from hma_jax.runtime.devices import peak_flops
from hma_jax.runtime.files import write_file

FORMAT = 1


@dataclass(frozen=True)
class Stage:
    """One thing that was timed. `frames` and `flops` are per call; 0 where they mean nothing."""

    name: str
    batch: int
    timing: Timing
    compile_seconds: float = 0.0
    temporary_bytes: int = 0
    frames: float = 0.0
    flops: float = 0.0  # of the model, by formula

    @property
    def frames_per_second(self) -> float:
        return self.frames / self.timing.median


def make_stages(
    rows: int,
    calls: Mapping[str, Compiled],
    timings: Mapping[str, Timing],
    *,
    frames: Mapping[str, float],
    flops: Mapping[str, float],
) -> list[Stage]:
    """A stage for every call."""
    return [
        Stage(name, rows, timings[name], c.compile_seconds, c.temporary_bytes or 0, frames[name], flops[name])
        for name, c in calls.items()
    ]


@dataclass(frozen=True)
class BenchRecord:
    """What one `hma bench` command found."""

    kind: str  # generate, rollout, train, load, tokenize, eval
    subject: str  # which model, tokenizer or data
    command: str
    date: str
    dtype: str
    seed: int
    machine: dict[str, Any]
    settings: dict[str, Any]
    stages: tuple[Stage, ...]
    ratios: dict[str, float] = field(default_factory=dict)  # ratios within this run, by what they say
    notes: tuple[str, ...] = ()
    matmul_flops_per_second: float = 0.0  # measured in the same run; 0: not measured
    peak_flops_per_second: float = 0.0  # from the data sheet, all devices; 0: unknown
    peak_memory_bytes: int = 0
    format: int = FORMAT

    def stage(self, name: str, batch: int) -> Stage:
        found = [s for s in self.stages if (s.name, s.batch) == (name, batch)]
        if not found:
            raise ConfigError(f"the record of {self.kind} has no stage {name!r} at batch {batch}")
        return found[0]


def make_record(kind: str, subject: str, command: str, **fields: Any) -> BenchRecord:
    """A record of this machine, now."""
    return BenchRecord(
        kind,
        subject,
        command,
        date=time.strftime("%Y-%m-%d"),
        machine=describe_machine(jax.devices()),
        peak_flops_per_second=peak_flops(fields["dtype"]) or 0.0,
        peak_memory_bytes=peak_memory_bytes(),
        **fields,
    )


def write_record(record: BenchRecord, directory: Path) -> Path:
    """Writes into `directory` and returns the file."""
    device = record.machine["devices"][0].split(" x ", 1)[-1].lower().replace(" ", "-")
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / f"{record.kind}-{record.subject}-{record.dtype}-{device}.json"
    write_file(path, json.dumps(to_dict(record), indent=1) + "\n")
    return path


def read_record(path: Path) -> BenchRecord:
    """Reads a record. Raises ConfigError for a file that is not a record of this format."""
    try:
        values = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not a benchmark record ({error}); run `hma bench` again") from error
    return from_dict(BenchRecord, values, where=str(path))
