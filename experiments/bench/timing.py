"""Timing of compiled calls: compilation timed separately, warmed up, alternately, with median and p90."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

WARM_UP = 2
"""Untimed calls of each stage before the first timed one."""


@dataclass(frozen=True)
class Timing:
    """Seconds per call over `repeats` timed calls."""

    median: float
    p90: float
    best: float
    repeats: int

    def scaled(self, factor: float) -> Timing:
        """The timing of `factor` times as many calls."""
        return Timing(self.median * factor, self.p90 * factor, self.best * factor, self.repeats)


@dataclass(frozen=True)
class Compiled:
    """A call compiled ahead of time, and what that took."""

    call: Callable[..., Any]
    compile_seconds: float
    temporary_bytes: int | None  # what XLA sets aside besides arguments and results

    def __call__(self, *args: Any) -> Any:
        return self.call(*args)


def compile_call(function: Callable[..., Any], *args: Any, donate: tuple[int, ...] = ()) -> Compiled:
    """Compiles `function` for arguments like `args`."""
    call, seconds = time_once(lambda: jax.jit(function, donate_argnums=donate).lower(*args).compile())
    memory = call.memory_analysis()
    return Compiled(call, seconds, None if memory is None else int(memory.temp_size_in_bytes))


def time_once(call: Callable[[], Any]) -> tuple[Any, float]:
    """(result, seconds)."""
    began = time.perf_counter()
    result = jax.block_until_ready(call())
    return result, time.perf_counter() - began


def time_by_turns(calls: Mapping[str, Callable[[], Any]], repeats: int, warm_up: int = WARM_UP) -> dict[str, Timing]:
    """Every call once per round, so that a slow spell of the machine hits all of them."""
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(warm_up):
        for call in calls.values():
            jax.block_until_ready(call())
    for _ in range(repeats):
        for name, call in calls.items():
            seconds[name].append(time_once(call)[1])
    return {name: summarise(values) for name, values in seconds.items()}


def summarise(seconds: list[float]) -> Timing:
    return Timing(float(np.median(seconds)), float(np.percentile(seconds, 90)), float(np.min(seconds)), len(seconds))


def matmul_rate(dtype: str) -> float:
    """FLOP/s of a square matrix product: what this machine can do, to compare with."""
    size = 2048
    a = jax.random.normal(jax.random.key(0), (size, size)).astype(dtype)
    call = compile_call(lambda x: x @ x, a)
    timing = time_by_turns({"matmul": lambda: call(a)}, 10)["matmul"]
    return 2.0 * size**3 / timing.best


def peak_memory_bytes() -> int:
    """Peak memory of the device where it reports one, otherwise the largest resident size of this process."""
    stats = jax.devices()[0].memory_stats() or {}
    if "peak_bytes_in_use" in stats:
        return int(stats["peak_bytes_in_use"])
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
