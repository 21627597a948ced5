"""The runner survives crashes, interruptions and its own death, and repeats nothing."""

import os
import platform
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.running.children import child_environment
from experiments.running.ledger import Ledger
from experiments.running.runner import Job, Monitor, read_states, run_missing
from hma_jax.runtime.host_memory import KEPT_PAGES
from tests.experiments import fake_trial


def job(id: str, end: str = "result", steps: int = 1) -> Job:
    return Job(id, f"trial {id}", {"steps": steps, "seconds": 0.0, "end": end})


def run(root: Path, jobs, **options):
    ledger = Ledger(root / "ledger.jsonl")
    return run_missing(jobs, root / "trials", ledger, command=fake_trial.command, poll_seconds=0.01, **options)


def starts(root: Path, id: str) -> list[int]:
    """The count at which each process of this trial began."""
    return [int(line) for line in (root / "trials" / id / "starts.txt").read_text().split()]


def wait_for(condition, seconds: float = 20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.01)


def start_sweep(root: Path) -> subprocess.Popen:
    def listen() -> None:  # tests run in a shell's background inherit that SIGINT is ignored
        signal.signal(signal.SIGINT, signal.SIG_DFL)

    command = [sys.executable, fake_trial.__file__, "--sweep", str(root)]
    return subprocess.Popen(command, preexec_fn=listen)


def test_second_run_starts_nothing(tmp_path):
    jobs = [job("a"), job("b")]
    run(tmp_path, jobs)
    states = run(tmp_path, jobs)
    assert [states[j.id].event for j in jobs] == ["finished", "finished"]
    assert starts(tmp_path, "a") == starts(tmp_path, "b") == [0]


def test_failures_are_recorded_and_the_sweep_goes_on(tmp_path):
    jobs = [job("crash", "crash"), job("nan", "diverge"), job("oom", "killed"), job("silent", "none"), job("good")]
    states = run(tmp_path, jobs, workers=2)
    assert {k: s.event for k, s in states.items()} == {
        "crash": "failed", "nan": "diverged", "oom": "failed", "silent": "failed", "good": "finished",
    }  # fmt: skip
    assert states["nan"].message == "loss is nan"
    assert "SIGKILL" in states["oom"].message and "output.txt" in states["oom"].message
    assert "exit code 1" in states["crash"].message
    assert "no such luck" in (tmp_path / "trials/crash/output.txt").read_text()


def test_failed_trials_run_again_only_on_request(tmp_path):
    run(tmp_path, [job("a", "crash")])
    assert run(tmp_path, [job("a")])["a"].event == "failed"
    assert run(tmp_path, [job("a")], retry_failed=True)["a"].event == "finished"


def test_deleted_trial_directory_is_run_again(tmp_path):
    run(tmp_path, [job("a")])
    (tmp_path / "trials/a/result.json").unlink()
    assert run(tmp_path, [job("a")])["a"].event == "finished"


@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGINT])
def test_killed_inside_a_trial_resumes_it(tmp_path, kill):
    runner = start_sweep(tmp_path)
    count = tmp_path / "trials/t1/count.txt"
    wait_for(lambda: count.exists() and int(count.read_text()) >= 3)
    runner.send_signal(kill)
    assert runner.wait(20) != 0
    reached = int(count.read_text())
    time.sleep(0.3)
    assert int(count.read_text()) <= reached + 1, "the trial outlived its runner"
    states = read_states(["t1"], tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"))
    assert states["t1"].event == "interrupted"

    assert start_sweep(tmp_path).wait(30) == 0
    assert starts(tmp_path, "t0") == [0], "a finished trial ran again"
    assert len(starts(tmp_path, "t1")) == 2 and starts(tmp_path, "t1")[1] >= 3, "not resumed"
    assert all((tmp_path / f"trials/t{i}/result.json").exists() for i in range(3))


def test_killed_between_result_and_ledger_line(tmp_path):
    run(tmp_path, [job("a"), job("b")])
    ledger = tmp_path / "ledger.jsonl"
    lines = ledger.read_text().splitlines(keepends=True)
    ledger.write_text("".join(lines[:-1]) + lines[-1][:10])  # killed while it wrote the last line
    states = run(tmp_path, [job("a"), job("b")])
    assert {s.event for s in states.values()} == {"finished"}
    assert starts(tmp_path, "b") == [0]
    assert Ledger(ledger).states()["b"]["event"] == "finished"


def test_monitor_hears_starts_and_ends(tmp_path):
    heard = []

    class Listener(Monitor):
        def started(self, job, resumed):
            heard.append(("started", job.id, resumed))

        def ended(self, job, state, seconds):
            heard.append(("ended", job.id, state.event))

    run(tmp_path, [job("a")], monitor=Listener())
    assert heard == [("started", "a", False), ("ended", "a", "finished")]


def test_workers_share_the_cores():
    cores = set(os.sched_getaffinity(0))
    shares = [set(map(int, child_environment(i, 2)["HMA_CORES"].split(","))) for i in range(2)]
    assert shares[0] | shares[1] == cores
    if len(cores) > 1:
        assert not shares[0] & shares[1]
    assert "HMA_CORES" not in child_environment(0, 1)


def test_a_child_uses_huge_pages_unless_the_user_said_otherwise(monkeypatch):
    assert child_environment(0, 1)["GLIBC_TUNABLES"] == KEPT_PAGES["GLIBC_TUNABLES"]
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.hugetlb=0")
    assert child_environment(0, 1)["GLIBC_TUNABLES"] == "glibc.malloc.hugetlb=0"


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the setting is glibc's")
@pytest.mark.parametrize("asked", [None, "glibc.malloc.hugetlb=0"])
def test_the_program_starts_again_with_huge_pages_unless_the_user_said_otherwise(asked, tmp_path):
    program = tmp_path / "program.py"
    program.write_text(
        "import os, sys\n"
        "from hma_jax.runtime.host_memory import restart_keeping_pages\n"
        "print('started', flush=True)\n"
        "restart_keeping_pages()\n"
        "print(os.environ['GLIBC_TUNABLES'], *sys.argv[1:])\n"
    )
    environment = {k: v for k, v in os.environ.items() if k != "GLIBC_TUNABLES"}
    environment |= {"GLIBC_TUNABLES": asked} if asked else {}
    command = [sys.executable, "-u", program, "--set", "a b"]
    lines = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()
    assert lines == ["started"] * (1 if asked else 2) + [f"{asked or KEPT_PAGES['GLIBC_TUNABLES']} --set a b"]
