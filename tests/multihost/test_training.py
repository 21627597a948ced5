"""Training in 1, 2 and 4 real processes: the same batches and numbers, one log, checkpoints that move, one end."""

from __future__ import annotations

import json
import re
import shutil
import signal
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from hma_jax.runtime.exits import Exit
from hma_jax.training.hashes import verify
from hma_jax.training.reading import list_steps
from hma_jax.training.runs import load_run
from tests.conftest import FAST_COMPILATION
from tests.multihost.processes import Started, launch, run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
MODULE = "tests.multihost.train_together"
FLAGS = " ".join(FAST_COMPILATION)


def train(run_dir: Path, processes: int, devices: int, **asked) -> list[dict]:
    said = run(MODULE, [str(run_dir), json.dumps(asked)], processes=processes, devices=devices, flags=FLAGS)
    return [json.loads(text.splitlines()[-1]) for text in said]


def begin(run_dir: Path, processes: int, **asked) -> list[Started]:
    return launch(MODULE, [str(run_dir), json.dumps(asked)], processes=processes, flags=FLAGS)


def global_batches(reports: list[dict]) -> list[list[str]]:
    """A digest per step and row; processes that load the same row must load the same."""
    steps = []
    for step in range(len(reports[0]["batches"])):
        rows: dict[int, str] = {}
        for report in reports:
            for row, digest in zip(report["rows"], report["batches"][step], strict=True):
                assert rows.setdefault(row, digest) == digest
        assert sorted(rows) == list(range(8))
        steps.append([rows[row] for row in range(8)])
    return steps


def read(run_dir: Path, name: str = "metrics.jsonl") -> list[dict]:
    return [json.loads(line) for line in (run_dir / name).read_text().splitlines()]


@pytest.fixture(scope="module")
def alone(tmp_path_factory) -> tuple[Path, dict]:
    """One process with four devices."""
    run_dir = tmp_path_factory.mktemp("alone")
    return run_dir, train(run_dir, 1, 4, steps=20, every=10, validate=True, ema=0.9)[0]


@pytest.mark.parametrize(("processes", "devices"), [(2, 2), (4, 1)])
def test_processes_train_as_one_does_and_write_one_log(processes: int, devices: int, alone, tmp_path: Path):
    one_dir, one = alone
    reports = train(tmp_path, processes, devices, steps=20, every=10, validate=True, ema=0.9)
    assert global_batches(reports) == global_batches([one])
    for report in reports:
        np.testing.assert_allclose(report["losses"], one["losses"], rtol=1e-6)  # a few units of float32
    assert [record["step"] for record in read(tmp_path)] == list(range(1, 21))
    assert [record["step"] for record in read(tmp_path, "validation.jsonl")] == list(range(2, 21, 2))
    for name in ("metrics.jsonl", "validation.jsonl"):
        for a, b in zip(read(tmp_path, name), read(one_dir, name), strict=True):
            np.testing.assert_allclose([*a.values()], [*b.values()], rtol=1e-5)
    assert len(list((tmp_path / "tensorboard").iterdir())) == 1 and len(read(tmp_path, "execution.jsonl")) == 1
    assert list_steps(tmp_path / "checkpoints") == [10, 20]
    for step in (10, 20):
        verify(tmp_path / "checkpoints" / str(step))
    for p, report in enumerate(reports):  # each its own shards, the first one what is left
        own = [f"/ocdbt.process_{p}/" in name for name in report["hashed"]]
        others = [re.search(r"/ocdbt.process_[0-9]+/", name) for name in report["hashed"]]
        assert any(own) and (all(own) if p else not any(found and "_0/" not in found[0] for found in others))


def test_in_float64_the_losses_of_twenty_steps_are_those_of_one_process(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("HMA_TESTS_FLOAT64", "1")
    one, two, four = (train(tmp_path / str(n), n, 4 // n, steps=20)[0]["losses"] for n in (1, 2, 4))
    assert len(one) == 20 and one != [float(np.float32(x)) for x in one]
    np.testing.assert_allclose(two, one, rtol=1e-9)
    np.testing.assert_allclose(four, one, rtol=1e-9)


@pytest.mark.parametrize("mesh", [[1, 4, 1], [1, 2, 2]])
def test_any_mesh_over_four_processes(mesh: list[int], alone, tmp_path: Path):
    """With `tensor` across processes several of them load the same rows."""
    reports = train(tmp_path, 4, 1, steps=5, mesh=mesh)
    assert global_batches(reports) == global_batches([alone[1]])[:5]
    np.testing.assert_allclose(reports[0]["losses"], alone[1]["losses"][:5], rtol=1e-5)


def test_a_checkpoint_of_four_processes_goes_on_in_one_and_in_two(tmp_path: Path):
    asked = {"steps": 4, "mesh": [1, -1, 1], "ema": 0.9}
    train(tmp_path / "four", 4, 1, **asked)
    for other in ("one", "two"):
        shutil.copytree(tmp_path / "four", tmp_path / other)
    straight = train(tmp_path / "four", 4, 1, **asked | {"steps": 8})
    one = train(tmp_path / "one", 1, 1, **asked | {"steps": 8})
    two = train(tmp_path / "two", 2, 2, **asked | {"steps": 8})
    assert {report["resumed_from"] for report in (*straight, *one, *two)} == {4}
    assert straight[1]["losses"] == straight[0]["losses"][4:]
    for reports in (one, two):
        np.testing.assert_allclose(reports[0]["losses"], straight[0]["losses"], rtol=1e-5)
    a, b = (load_run(tmp_path / name, "ema").params for name in ("four", "one"))
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(np.asarray(x), np.asarray(y), rtol=1e-4, atol=1e-6)


def test_a_damaged_file_is_refused_by_all_whoever_read_it(tmp_path: Path):
    train(tmp_path, 2, 1, steps=2)
    files = [p for p in (tmp_path / "checkpoints" / "2" / "params").rglob("*") if p.is_file() and p.stat().st_size]
    file = max(files, key=lambda path: path.stat().st_size)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)
    for code, said in [one.wait() for one in begin(tmp_path, 2, steps=4)]:
        assert code == 1 and file.name in said and "is damaged" in said


def wait_for(started: Started, text: str, seconds: float = 600) -> None:
    deadline = time.monotonic() + seconds
    while text not in started.output.read_text():
        assert time.monotonic() < deadline and started.process.poll() is None, started.output.read_text()[-2000:]
        time.sleep(0.05)


@pytest.mark.parametrize("asked", [0, 1])
def test_a_stop_that_one_is_asked_for_is_one_of_all(asked: int, tmp_path: Path):
    started = begin(tmp_path, 2, steps=200, pause=0.1)
    wait_for(started[1], "step 3\n")
    started[asked].process.send_signal(signal.SIGTERM)
    ended = [one.wait() for one in started]
    assert [code for code, _ in ended] == [Exit.STOPPED, Exit.STOPPED], ended
    [step] = list_steps(tmp_path / "checkpoints")
    assert 3 <= step < 30 and all(f"stopped at step {step} of 200" in said for _, said in ended)
    assert train(tmp_path, 2, 1, steps=step + 1)[0]["resumed_from"] == step


@pytest.mark.parametrize("killed", [0, 1])
def test_when_one_is_killed_the_other_ends_and_names_it(killed: int, tmp_path: Path):
    """The job that is started again loses nothing of what was saved."""
    started = begin(tmp_path, 2, steps=200, pause=0.1, every=5, lost_after=20)
    wait_for(started[1], "step 16\n")  # a save waits for the one before it: step 10 is saved
    started[killed].process.send_signal(signal.SIGKILL)
    began = time.monotonic()
    code, said = started[1 - killed].wait()
    assert code == Exit.LOST, said[-2000:]
    assert time.monotonic() - began < 60
    assert f"error: lost process {killed} of 2 on host " in said and "start all processes again" in said
    started[killed].process.wait()
    assert train(tmp_path, 2, 1, steps=25)[0]["resumed_from"] >= 10
    assert [record["step"] for record in read(tmp_path)] == list(range(1, 26))
