"""The runner survives crashes, interruptions and its own death, and repeats nothing."""

import errno
import gc
import json
import os
import platform
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import jax
import pytest
from jax.errors import JaxRuntimeError

from experiments.running import attempts, ledger, runner, shared_disk, trial_main
from experiments.running.attempts import EVALUATING, AttemptEnd, attempt, outcome, reached, read_states
from experiments.running.children import child_environment, require_accelerator
from experiments.running.launchers import local
from experiments.running.launchers.base import Launcher
from experiments.running.launchers.local import LocalLauncher
from experiments.running.ledger import Ledger
from experiments.running.runner import TRIES, Job, Monitor, run_missing
from experiments.running.slots import Accelerators
from hma_jax.config import ConfigError
from hma_jax.runtime import locks
from hma_jax.runtime.exits import Exit
from hma_jax.runtime.host_memory import KEPT_PAGES, collect_rarely
from hma_jax.runtime.user_code import called_from_program
from tests.experiments import fake_trial


def job(id: str, end: str = "result", steps: int = 1, **more) -> Job:
    return Job(id, f"trial {id}", {"steps": steps, "seconds": 0.0, "end": end, **more})


def run(root: Path, jobs, workers: int = 1, **options):
    place = fake_trial.launcher(root, workers)
    return run_missing(jobs, root / "trials", Ledger(root / "ledger.jsonl"), place, **options)


def events(root: Path, id: str) -> list[str]:
    return [line["event"] for line in Ledger(root / "ledger.jsonl").records() if line["trial"] == id]


def starts(root: Path, id: str) -> list[int]:
    """The count at which each process of this trial began."""
    return [int(line) for line in (root / "trials" / id / "starts.txt").read_text().split()]


def wait_for(condition, seconds: float = 20.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "timed out"
        time.sleep(0.01)


def start_sweep(root: Path) -> subprocess.Popen:
    return subprocess.Popen([sys.executable, fake_trial.__file__, "--sweep", str(root)])


def test_second_run_starts_nothing(tmp_path):
    jobs = [job("a"), job("b")]
    run(tmp_path, jobs)
    states = run(tmp_path, jobs)
    assert [states[j.id].event for j in jobs] == ["finished", "finished"]
    assert starts(tmp_path, "a") == starts(tmp_path, "b") == [0]


def test_failures_are_recorded_and_the_sweep_goes_on(tmp_path):
    jobs = [job("crash", "crash"), job("nan", "diverge"), job("trap", "SIGILL"), job("silent", "none"), job("good")]
    states = run(tmp_path, jobs, workers=2)
    assert {k: s.event for k, s in states.items()} == {
        "crash": "failed", "nan": "diverged", "trap": "failed", "silent": "failed", "good": "finished",
    }  # fmt: skip
    assert states["nan"].message == "loss is nan"
    assert "SIGILL" in states["trap"].message and "output.txt" in states["trap"].message
    (said,) = tmp_path.rglob("trap/output.txt")
    assert "Fatal Python error: Illegal instruction" in said.read_text()  # and what its threads did
    assert "exit code 1" in states["crash"].message
    assert "no such luck" in (tmp_path / "trials/crash/output.txt").read_text()


@pytest.mark.parametrize(
    ("end", "state"), [("SIGKILL", "lost"), ("SIGTERM", "preempted"), ("full disk", "lost"), ("SIGABRT", "lost")]
)
def test_a_trial_that_is_killed_goes_on_from_where_it_was(tmp_path, end, state):
    """The kernel's out-of-memory killer, a machine that is taken away, a disk that is full, a driver that aborts:
    nothing is wrong with the trial."""
    assert run(tmp_path, [job("a", end, steps=3)])["a"].event == "finished"
    assert starts(tmp_path, "a") == [0, 3]
    assert events(tmp_path, "a") == ["running", state, "running", "finished"]


def test_what_kills_a_trial_every_time_is_not_tried_for_ever(tmp_path):
    state = run(tmp_path, [job("big", "SIGKILL", times=99), job("good")])["big"]
    assert state.event == "lost" and "out of memory?" in state.message
    assert len(starts(tmp_path, "big")) == TRIES and starts(tmp_path, "good") == [0]
    run(tmp_path, [job("big", "SIGKILL", times=99)])  # the next command tries as often
    assert len(starts(tmp_path, "big")) == 2 * TRIES


def test_what_is_stopped_every_time_before_it_gets_further_is_not_tried_for_ever(tmp_path):
    """A job that is too short, or something that sends SIGTERM to what needs too much memory."""
    state = run(tmp_path, [job("slow", "SIGTERM", times=99)])["slow"]
    assert state.event == "preempted" and state.message.startswith(
        f"stopped {TRIES} times in a row before it got further"
    )
    assert events(tmp_path, "slow") == ["running", "preempted"] * TRIES


@pytest.mark.parametrize("end", ["SIGKILL", "SIGTERM"])
def test_a_trial_that_gets_further_each_time_is_never_given_up(tmp_path, end):
    """A long one on machines that are taken away every few hours."""
    state = run(tmp_path, [job("long", end, times=TRIES + 1, checkpoints=True)])["long"]
    assert state.event == "finished" and len(starts(tmp_path, "long")) == TRIES + 2


def test_windows_that_were_measured_are_progress_too(tmp_path):
    """An evaluation may take longer than a job."""
    before = reached(tmp_path)
    (tmp_path / EVALUATING).mkdir()
    (tmp_path / EVALUATING / "0.npz").touch()
    assert reached(tmp_path) > before


class Requeueing(Launcher):
    """An engine that starts what it has preempted again by itself, until it is asked to stop. `further`: each time
    after another checkpoint; it then finishes at last."""

    pause = 0.0
    share = kill = None

    def __init__(self, further: bool):
        self.further, self.starts, self.cancelled = further, 0, False

    def launch(self, directories):
        return list(directories)

    def ended(self, directory):
        if self.cancelled or self.starts > 10:
            return AttemptEnd(-signal.SIGTERM, "cancelled")
        self.starts += 1
        (directory / "started.json").write_text(json.dumps({"host": "far", "process": 1, "token": self.starts}))
        if self.further:
            (directory / "run/checkpoints" / str(self.starts)).mkdir(parents=True)
        if self.starts > 10:
            (directory / "result.json").write_text("{}")
        return None

    def ask_to_stop(self, handles):
        self.cancelled = True


@pytest.mark.parametrize("further", [False, True])
def test_nor_is_one_that_the_engine_itself_starts_again(tmp_path, further):
    place = Requeueing(further)
    state = run_missing([job("a")], tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)["a"]
    assert (state.event, place.starts) == (("finished", 11) if further else ("preempted", TRIES + 1))


def test_one_bad_gpu_does_not_eat_the_queue(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(local, "find_accelerators", lambda: Accelerators("gpu", ("0", "1", "2")))
    trial = "[ $CUDA_VISIBLE_DEVICES = 1 ] && kill -SEGV $$; sleep 0.5; touch $0/result.json"
    place = LocalLauncher(tmp_path, 3, command=lambda directory: ["sh", "-c", trial, str(directory)])
    place.pause = 0.01
    jobs = [job(str(i)) for i in range(8)]
    states = run_missing(jobs, tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)
    assert {state.event for state in states.values()} == {"finished"}
    lost = [line["trial"] for line in Ledger(tmp_path / "ledger.jsonl").records() if line["event"] == "lost"]
    assert len(lost) == len(set(lost)) == runner.BAD_PLACE
    assert (
        "lost on slot 1 (gpu 1) before their first step, which gets no more of them; the last one: its" in caplog.text
    )


def test_what_all_places_share_is_no_fault_of_one(tmp_path, monkeypatch, caplog):
    """A disk that is full, or JAX without CUDA: Slurm had no node left that trials might run on."""
    place = LocalLauncher(tmp_path, 2, command=lambda directory: ["sh", "-c", "sleep 0.2; kill -SEGV $$"])
    place.pause, place.leave_out = 0.01, lambda handle, place: pytest.fail(f"left {place} out")
    jobs = [job(str(i)) for i in range(8)]
    states = run_missing(jobs, tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)
    assert {state.event for state in states.values()} == {"lost"}
    assert caplog.text.count("lost on slot 0 before") == caplog.text.count("lost on slot 1 before") == 1


def test_the_only_place_there_is_goes_on(tmp_path):
    jobs = [job(str(i), "SIGSEGV") for i in range(runner.BAD_PLACE)]
    assert {state.event for state in run(tmp_path, jobs).values()} == {"finished"}


def test_a_trial_that_makes_no_progress_is_named_once(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(runner, "STALL_SECONDS", 0.1)
    run(tmp_path, [job("a", steps=8, seconds=0.1)])
    assert caplog.text.count("trial a makes no progress") == 1


def test_a_study_that_another_command_has_taken_over_is_left_to_it(tmp_path):
    place = fake_trial.launcher(tmp_path, 1)
    place.launch = lambda directories: pytest.fail("it launched")
    with pytest.raises(ConfigError, match=f"another command has taken over {tmp_path}"):
        run_missing([job("a")], tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place, lost=lambda: True)


def test_a_trial_that_another_process_turns_out_to_run_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.05)
    place = LocalLauncher(tmp_path, 1, command=lambda directory: ["sh", "-c", f"exit {Exit.STOPPED}"])
    launch, launched = place.launch, []
    with ExitStack() as stack:

        def late(directories):  # a job that an earlier command left in the queue has begun
            launched.extend(directories)
            held = stack.enter_context(attempt(directories[0]))
            threading.Timer(0.5, lambda: (directories[0] / "result.json").touch() or stack.close()).start()
            return launch(directories) if held else []

        place.launch = late
        states = run_missing([job("a")], tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)
    assert states["a"].event == "finished" and len(launched) == 1


@pytest.fixture
def in_this_process(monkeypatch):
    """The process of a trial is that of the test."""
    monkeypatch.setattr(trial_main, "enter_child", lambda: None)


def test_an_attempt_does_not_keep_its_machine_while_another_one_runs(tmp_path, monkeypatch, in_this_process, capsys):
    monkeypatch.setattr(attempts, "EXPIRES", 0.1)
    monkeypatch.setattr(attempts, "RENEWED_EVERY", 0.1)
    with attempt(tmp_path):
        (tmp_path / "started.json").unlink()
        assert trial_main.main(tmp_path) == Exit.STOPPED
    assert (
        not (tmp_path / "started.json").exists()
        and "another attempt at this trial is running" in capsys.readouterr().err
    )


def test_what_failed_while_an_attempt_waited_is_not_run_again(tmp_path, in_this_process):
    with ExitStack() as stack:
        stack.enter_context(attempt(tmp_path))
        threading.Timer(0.3, lambda: (tmp_path / "failure.json").write_text("{}") and stack.close()).start()
        assert trial_main.main(tmp_path) == Exit.FAILED  # there is no job.json to read


def test_a_trial_that_should_have_a_gpu_does_not_run_without(tmp_path, monkeypatch, in_this_process):
    monkeypatch.setenv("HMA_ACCELERATOR", "gpu")
    require_accelerator()  # the tests' JAX_PLATFORMS=cpu does without
    monkeypatch.delenv("JAX_PLATFORMS")
    (tmp_path / "job.json").write_text("{}")
    assert trial_main.main(tmp_path) == Exit.LOST
    state = outcome(tmp_path, AttemptEnd(Exit.LOST))
    assert state.event == "lost" and "a GPU is expected, but JAX computes on cpu" in state.message
    assert f"{socket.gethostname()}: " in state.message and "pip install 'hma-jax[cuda]'" in state.message


@pytest.mark.parametrize(
    ("says", "of_device"), [("INTERNAL: CUDA error", True), ("RESOURCE_EXHAUSTED: no room", False)]
)
def test_a_device_that_fails_is_no_fault_of_the_trial(says, of_device):
    assert trial_main._is_of_device(JaxRuntimeError(says)) == of_device and not trial_main._is_of_device(
        ValueError(says)
    )


def test_a_user_s_code_that_fails_within_a_compiled_program_is_no_fault_of_a_device(
    tmp_path, monkeypatch, in_this_process
):
    """The trial was tried again, on one place after another."""

    def fail(_):
        with called_from_program():
            raise ConfigError("no number")

    program = lambda: jax.block_until_ready(jax.pure_callback(fail, jax.ShapeDtypeStruct((), "float32"), 1.0))
    monkeypatch.setattr(trial_main, "require_accelerator", program)
    (tmp_path / "job.json").write_text("{}")
    assert trial_main.main(tmp_path) == Exit.FAILED
    state = outcome(tmp_path, AttemptEnd(Exit.FAILED))
    assert (state.event, state.message) == ("failed", "no number")


def test_the_reason_is_kept_of_a_trial_that_is_lost_before_it_has_begun(tmp_path):
    """Such as one that the kernel ends while it imports: it leaves no started.json."""
    place = LocalLauncher(tmp_path, 1, command=lambda directory: ["/bin/sh", "-c", "kill -KILL $$"])
    ledger = Ledger(tmp_path / "ledger.jsonl")
    state = run_missing([job("a")], tmp_path / "trials", ledger, place)["a"]
    assert state.event == "lost" and "out of memory?" in state.message
    assert events(tmp_path, "a") == ["lost"] * TRIES


@pytest.mark.parametrize("error", [ConfigError("not now"), OSError(errno.ESTALE, "not now")])
def test_trials_that_are_not_taken_again_at_first_end_no_sweep(tmp_path, monkeypatch, caplog, error):
    """Slurm's controller restarts, a limit is reached, or a shared disk does not answer, while other trials run."""
    monkeypatch.setattr(runner, "RELAUNCH_SECONDS", 0.05)
    place = fake_trial.launcher(tmp_path, 2)
    launch, refused = place.launch, iter([False, True, True])

    def sometimes(directories):
        if next(refused, False):
            raise error
        return launch(directories)

    place.launch = sometimes
    jobs = [job("lost", "SIGKILL"), job("other", steps=3)]
    states = run_missing(jobs, tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)
    assert {state.event for state in states.values()} == {"finished"}
    assert events(tmp_path, "lost") == ["running", "lost", "running", "finished"]
    assert caplog.text.count("not now; trying again") == 2


def test_a_trial_that_could_not_be_started_keeps_no_slot(tmp_path):
    place = fake_trial.launcher(tmp_path, 1)
    with pytest.raises(FileNotFoundError):
        place.launch([tmp_path / "gone"])
    assert (
        run_missing([job("a")], tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)["a"].event == "finished"
    )


def test_trials_that_are_never_taken_end_the_sweep(tmp_path):
    place = fake_trial.launcher(tmp_path, 1)
    place.launch = lambda directories: (_ for _ in ()).throw(ConfigError("no such partition"))
    with pytest.raises(ConfigError, match="no such partition"):
        run_missing([job("a")], tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)


@pytest.mark.parametrize("name", ["started.json", "progress.json", "failure.json"])
def test_a_shared_disk_that_does_not_answer_once_stops_no_sweep(tmp_path, monkeypatch, name):
    read, failed = Path.read_text, []

    def sometimes(path, *arguments, **options):
        if path.name == name and not failed:
            failed.append(path)
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE), str(path))
        return read(path, *arguments, **options)

    monkeypatch.setattr(Path, "read_text", sometimes)
    states = run(tmp_path, [job("a", "full disk"), job("b")], workers=2)
    assert failed and {state.event for state in states.values()} == {"finished"}


@pytest.mark.parametrize(("module", "name"), [(ledger, "append_line"), (runner, "write_file"), (attempts, "is_alive")])
def test_nor_does_one_that_takes_no_line_job_or_lock_once(tmp_path, monkeypatch, module, name):
    act, failed = getattr(module, name), []

    def sometimes(*arguments):
        if not failed:
            failed.append(name)
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
        return act(*arguments)

    monkeypatch.setattr(shared_disk, "WAITS", (0.01,))
    monkeypatch.setattr(module, name, sometimes)
    assert run(tmp_path, [job("a")])["a"].event == "finished" and failed
    assert events(tmp_path, "a") == ["running", "finished"]


def test_progress_that_cannot_be_written_ends_no_trial(tmp_path):
    report = trial_main._ProgressFile(tmp_path / "gone/progress.json", lambda: False)
    report("training", 1, 2)
    assert not (tmp_path / "gone").exists()


def test_failed_trials_run_again_only_on_request_and_keep_their_checkpoint(tmp_path):
    run(tmp_path, [job("a", "crash", steps=3)])
    assert run(tmp_path, [job("a")])["a"].event == "failed"
    assert run(tmp_path, [job("a", steps=4)], retry_failed=True)["a"].event == "finished"
    assert starts(tmp_path, "a") == [0, 3]


def test_a_diverged_trial_is_left_as_it_is(tmp_path):
    """It would diverge again, and what it left is the evidence."""
    run(tmp_path, [job("a", "diverge", steps=3)])
    assert run(tmp_path, [job("a", steps=3)], retry_failed=True)["a"].event == "diverged"
    assert starts(tmp_path, "a") == [0]


@pytest.mark.parametrize("end", ["result", "crash", "diverge"])
def test_deleted_trial_directory_is_run_again(tmp_path, end):
    run(tmp_path, [job("a", end)])
    shutil.rmtree(tmp_path / "trials/a")
    assert run(tmp_path, [job("a")])["a"].event == "finished"
    assert events(tmp_path, "a")[-2:] == ["running", "finished"]


@pytest.mark.parametrize("kill", [signal.SIGKILL, signal.SIGINT])
def test_killed_inside_a_trial_resumes_it(tmp_path, kill):
    sweep = start_sweep(tmp_path)
    count = tmp_path / "trials/t1/run/count.txt"
    wait_for(lambda: count.exists() and int(count.read_text()) >= 3)
    sweep.send_signal(kill)
    assert sweep.wait(20) != 0
    reached = int(count.read_text())
    time.sleep(0.3)
    assert int(count.read_text()) <= reached + 1, "the trial outlived its runner"
    states = read_states(["t1"], tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"))
    assert states["t1"].event == ("lost" if kill == signal.SIGKILL else "preempted")

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
        def launched(self, job, resumed):
            heard.append(("launched", job.id, resumed))

        def ended(self, job, state, seconds, again):
            heard.append((state.event, job.id, again))

    run(tmp_path, [job("a", "SIGKILL")], monitor=Listener())
    assert heard == [("launched", "a", False), ("lost", "a", True), ("launched", "a", True), ("finished", "a", False)]


def test_a_trial_that_another_runner_left_running_is_waited_for(tmp_path, monkeypatch):
    """On another machine a trial outlives the runner that started it: it is neither started twice nor lost."""
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.05)
    directory = tmp_path / "trials/a"
    directory.mkdir(parents=True)
    Ledger(tmp_path / "ledger.jsonl").append("a", "running", title="trial a")
    polls, alive = [], runner.is_alive

    def sometimes(directory):
        polls.append(directory)
        if len(polls) == 1:  # a shared disk that does not answer once
            raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
        return alive(directory)

    monkeypatch.setattr(runner, "is_alive", sometimes)
    with attempt(directory):
        assert read_states(["a"], tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"))["a"].event == "running"
        ended = threading.Timer(0.5, lambda: (directory / "result.json").write_text("{}"))
        waits = threading.Thread(target=run, args=(tmp_path, [job("a"), job("b")]))
        ended.start(), waits.start()
        wait_for(lambda: (directory / "result.json").exists())
        assert waits.is_alive()
    waits.join(20)
    assert not (directory / "starts.txt").exists() and starts(tmp_path, "b") == [0]
    assert events(tmp_path, "a") == ["running", "finished"]


def test_a_lease_that_ran_out_lets_another_take_the_trial(tmp_path, monkeypatch):
    """A worker on another machine died: its lock file stays, unrenewed, and no lock of this kernel's is behind it."""
    monkeypatch.setattr(runner, "POLL_SECONDS", 0.05)
    directory = tmp_path / "trials/a"
    directory.mkdir(parents=True)
    Ledger(tmp_path / "ledger.jsonl").append("a", "running", title="trial a")
    lock = directory / "trial.lock"
    lock.write_text(json.dumps({"process": 1, "host": "far", "since": "noon", "machine": "far", "token": "x"}))
    states = lambda: read_states(["a"], tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"))["a"].event
    assert states() == "running"
    renewed = time.time() - locks.EXPIRES - 1
    os.utime(lock, (renewed, renewed))
    assert run(tmp_path, [job("a")])["a"].event == "finished"
    assert events(tmp_path, "a") == ["running", "lost", "running", "finished"]


def test_a_child_uses_huge_pages_unless_the_user_said_otherwise(monkeypatch):
    assert child_environment(Path("compiled"))["GLIBC_TUNABLES"] == KEPT_PAGES["GLIBC_TUNABLES"]
    monkeypatch.setenv("GLIBC_TUNABLES", "glibc.malloc.hugetlb=0")
    assert child_environment(Path("compiled"))["GLIBC_TUNABLES"] == "glibc.malloc.hugetlb=0"


def test_a_trial_that_lost_its_lease_stops_for_the_one_that_took_over(tmp_path, monkeypatch):
    """A machine that was cut off for longer than its lease finds out when it is back."""
    monkeypatch.setattr(trial_main, "POLL_SECONDS", 0.0)
    with attempt(tmp_path) as held:
        report = trial_main._ProgressFile(tmp_path / "progress.json", held.lost)
        report("training", 1, 2)
        (tmp_path / "trial.lock").unlink()
        with attempt(tmp_path), pytest.raises(trial_main.TakenOver, match="another attempt"):
            report("training", 2, 2)
    assert json.loads((tmp_path / "progress.json").read_text())["done"] == 1


@pytest.mark.parametrize(("asked", "kept"), [(700, 10_000), (50_000, 50_000), (0, 0)])
def test_garbage_is_looked_for_rarely_or_as_the_user_said(asked, kept):
    before = gc.get_threshold()
    try:
        gc.set_threshold(asked)
        collect_rarely()
        assert gc.get_threshold()[0] == kept
    finally:
        gc.set_threshold(*before)


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
