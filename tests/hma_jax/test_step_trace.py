"""Profiles of some steps of a run."""

import gzip
import json
from pathlib import Path

import pytest

from hma_jax.config import ConfigError
from hma_jax.training.loop import LoopOptions
from tests.toy import fit_toy


def recorded(run: Path) -> list[set[int]]:
    """The steps in each profile of a run, oldest first, which XProf's file lies beside."""
    found = []
    for folder in sorted((run / "profile" / "plugins" / "profile").iterdir()):
        assert len(list(folder.glob("*.xplane.pb"))) == 1
        trace = json.loads(gzip.decompress((folder / "perfetto_trace.json.gz").read_bytes()))
        events = [event for event in trace["traceEvents"] if event.get("name") == "train"]
        found.append({int(event["args"]["step_num"]) for event in events})
    return found


def test_steps_after_a_start_are_profiled_and_nothing_else_changes(tmp_path: Path):
    fit_toy(tmp_path / "traced", 16, options=LoopOptions(trace_steps=3))
    fit_toy(tmp_path / "plain", 16)
    assert recorded(tmp_path / "traced") == [{11, 12, 13}]
    assert not (tmp_path / "plain" / "profile").exists()
    metrics = [(tmp_path / name / "metrics.jsonl").read_bytes() for name in ("traced", "plain")]
    assert metrics[0] == metrics[1]


def test_a_run_with_few_steps_left_profiles_the_last_ones(tmp_path: Path):
    fit_toy(tmp_path, 3, options=LoopOptions(trace_steps=8))
    assert recorded(tmp_path) == [{1, 2, 3}]


def test_a_run_that_fails_meanwhile_leaves_the_profiler_to_the_next(tmp_path: Path):
    def stop(step: int, *_: object) -> None:
        if step == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_toy(tmp_path / "stopped", 4, options=LoopOptions(trace_steps=4), progress=stop)
    fit_toy(tmp_path / "next", 4, options=LoopOptions(trace_steps=1))
    assert recorded(tmp_path / "next") == [{4}]


def test_a_number_of_steps_that_is_none_is_refused():
    with pytest.raises(ConfigError, match=r"LoopOptions\.trace_steps must not be negative, got -1"):
        LoopOptions(trace_steps=-1)
