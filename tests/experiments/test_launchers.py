"""Every launcher brings the same trials to the same ends; what engines say of their jobs becomes the right state.

The engines are fakes that run attempts in threads; `tests.stress.slurm_sweep` and `ray_sweep` use real ones.
"""

import errno
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from experiments.cli.main import main
from experiments.running.attempts import OUTPUT, AttemptEnd, outcome
from experiments.running.launchers import base, ray, slurm
from experiments.running.launchers.local import LocalLauncher
from experiments.running.launchers.ray import RayLauncher, RaySettings
from experiments.running.launchers.registry import LAUNCHERS, LauncherOptions, launcher_class
from experiments.running.launchers.remote import Attempt
from experiments.running.launchers.slurm import SlurmAttempt, SlurmLauncher, SlurmSettings
from experiments.running.ledger import Ledger
from experiments.running.runner import run_missing
from hma_jax.config import ConfigError
from hma_jax.runtime.exits import Exit
from tests.experiments import fake_trial
from tests.experiments.test_runner import job, starts


class FakeSlurm:
    """What the launcher uses of submitit, squeue and scancel."""

    def __init__(self, folder: Path, monkeypatch):
        self.folder, self.arrays, self.states, self.cancelled, self.most = folder, [], {}, [], 0
        folder.mkdir()
        monkeypatch.setattr(slurm, "ask_states", lambda: dict(self.states))
        monkeypatch.setattr(slurm.subprocess, "run", lambda words, **_: self.cancelled.append(words))

    def submit_array(self, attempts):
        self.arrays.append(len(attempts))
        self.most = max(self.most, sum(state == "RUNNING" for state in self.states.values()) + len(attempts))
        return [self.submit(attempt, f"{len(self.arrays)}_{i}") for i, attempt in enumerate(attempts)]

    def submit(self, attempt, id):
        paths = SimpleNamespace(result_pickle=self.folder / f"{id}.pkl", stdout=self.folder / f"{id}.out")
        self.states[id] = "RUNNING"

        def work():
            result = pickle.loads(pickle.dumps(attempt))()
            aside = paths.result_pickle.with_suffix(".tmp")
            aside.write_bytes(pickle.dumps(("success", result)))
            aside.rename(paths.result_pickle)
            self.states[id] = "COMPLETED"

        if isinstance(attempt, Attempt):
            threading.Thread(target=work).start()
        return SimpleNamespace(job_id=id, paths=paths)


class FakeRay:
    """What the launcher uses of Ray."""

    class exceptions:
        class RayError(Exception): ...

        class TaskCancelledError(RayError): ...

    def __init__(self):
        self.options, self.left = {}, False

    def remote(self, **options):
        self.options = options

        def decorate(function):
            def start(attempt):
                future = Future()
                copy = pickle.loads(pickle.dumps(attempt))
                threading.Thread(target=lambda: future.set_result(function(copy))).start()
                return future

            return SimpleNamespace(remote=start)

        return decorate

    def wait(self, futures, timeout):
        return [f for f in futures if f.done()], [f for f in futures if not f.done()]

    def get(self, future):
        return future.result()

    def shutdown(self):
        self.left = True


@pytest.fixture
def places(tmp_path, monkeypatch):
    pytest.importorskip("submitit", reason="needs the extra `slurm`")

    options = {
        "local": lambda root: {},
        "slurm": lambda root: {"executor": FakeSlurm(root / "slurm", monkeypatch)},
        "ray": lambda root: {"engine": FakeRay()},
    }

    def make(name: str, root: Path, workers: int | None = 2):
        assert name in options, f"add to the fixture `places` what the launcher {name} needs here"
        place = launcher_class(name)(root, workers, command=fake_trial.command, **options[name](root))
        place.pause = 0.01
        return place

    return make


@pytest.mark.parametrize("workers", [None, 2])
@pytest.mark.parametrize("name", list(LAUNCHERS))
def test_how_many_trials_a_launcher_takes_at_a_time_is_known_without_it(name, workers, places, tmp_path):
    known = LauncherOptions(name, workers).at_once
    assert places(name, tmp_path, workers).at_once == (sys.maxsize if known is None else known)


@pytest.mark.parametrize("name", list(LAUNCHERS))
def test_trials_come_to_the_same_ends_everywhere(name, places, tmp_path):
    jobs = [job("good", steps=2), job("killed", "SIGKILL", steps=2), job("nan", "diverge"), job("crash", "crash")]
    with places(name, tmp_path) as place:
        states = run_missing(jobs, tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)
    assert {id: state.event for id, state in states.items()} == {
        "good": "finished", "killed": "finished", "nan": "diverged", "crash": "failed"
    }  # fmt: skip
    assert starts(tmp_path, "killed") == [0, 2] and "no such luck" in (tmp_path / "trials/crash/output.txt").read_text()


def test_slurm_gets_one_array_of_all_trials_and_those_that_are_lost_later(places, tmp_path):
    place = places("slurm", tmp_path, workers=None)
    jobs = [job("a"), job("b", "SIGKILL"), job("c")]
    run_missing(jobs, tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)
    assert place._executor.arrays == [3, 1]


def test_slurm_gets_no_more_jobs_at_a_time_than_there_are_workers(tmp_path, monkeypatch):
    """Neither in one array nor in those of trials that wait for others."""
    pytest.importorskip("submitit", reason="needs the extra `slurm`")
    fake = FakeSlurm(tmp_path / "slurm", monkeypatch)
    place = SlurmLauncher(tmp_path, 2, command=fake_trial.command, executor=fake)
    place.pause = 0.01
    jobs = [job("a"), job("b"), job("c"), *(replace(job(f"after {id}"), after=frozenset({id})) for id in "ab")]
    run_missing(jobs, tmp_path / "trials", Ledger(tmp_path / "ledger.jsonl"), place)
    assert place.at_once == fake.most == 2 and sum(fake.arrays) == len(jobs)
    assert SlurmLauncher(tmp_path, None, executor=fake).at_once == sys.maxsize


def test_a_job_has_nothing_of_the_job_that_submits_it(submitted, tmp_path, monkeypatch):
    place, fake, _ = submitted
    for name in ("SLURM_JOB_ID", "SLURM_MEM_PER_CPU", "SLURM_CONF", "SBATCH_ACCOUNT"):
        monkeypatch.setenv(name, "of the runner")
    seen = {}
    fake.submit_array = lambda attempts: seen.update(os.environ) or attempts
    place.launch([tmp_path])
    assert {name for name, value in seen.items() if value == "of the runner"} == {"SLURM_CONF", "SBATCH_ACCOUNT"}
    assert os.environ["SLURM_JOB_ID"] == "of the runner"


def test_a_node_that_loses_one_trial_after_another_gets_no_new_jobs(submitted, monkeypatch):
    place, fake, handle = submitted
    given = []
    fake.update_parameters = lambda **parameters: given.append(parameters)
    start = {"host": "node7.cluster", "process": 1, "token": "a", "node": "node7"}
    assert place.place(handle, start) == "node7" and place.place(handle, None) is None
    assert place.leave_out(handle, "node7") and place.leave_out(handle, "node9")
    assert given == [{"exclude": "node7"}, {"exclude": "node7,node9"}]
    assert not place.leave_out(handle, "node9"), "a job that was in its queue already"
    place = SlurmLauncher(place._root, None, SlurmSettings(sbatch=("exclude=node1",)), executor=fake)
    assert place.leave_out(handle, "node7") and given[-1] == {"exclude": "node1,node7"}


def test_nodes_that_the_user_leaves_out_are_no_option_that_hides_others(tmp_path, monkeypatch):
    submitit = pytest.importorskip("submitit", reason="needs the extra `slurm`")
    given = {}
    executor = SimpleNamespace(update_parameters=lambda **parameters: given.update(parameters))
    monkeypatch.setattr(submitit, "SlurmExecutor", lambda *_, **__: executor)
    slurm._make_executor(tmp_path, SlurmSettings(sbatch=("exclude=node1", "exclusive")))
    assert given["exclude"] == "node1" and given["additional_parameters"] == {"requeue": True, "exclusive": True}


def test_an_attempt_that_an_earlier_command_left_in_the_queue_does_not_begin(tmp_path):
    first, second = (Attempt(tmp_path, tmp_path / "compiled", lambda directory: ["true"]) for _ in range(2))
    assert first.run() == Exit.STOPPED and not (tmp_path / "output.txt").exists()
    assert second.run() == 0


def say_accelerator(directory: Path) -> list[str]:
    return ["sh", "-c", 'echo "has $HMA_ACCELERATOR."']


@pytest.mark.parametrize(
    ("settings", "kind"), [(RaySettings(), ""), (RaySettings(gpus=1), "gpu"), (RaySettings(tpus=4), "tpu")]
)
def test_a_trial_is_told_which_accelerator_it_has_on_ray(tmp_path, settings, kind):
    place = RayLauncher(tmp_path, None, settings, command=say_accelerator, engine=FakeRay())
    [task] = place.launch([tmp_path])
    assert task.reference.result(timeout=20) == 0
    assert (tmp_path / "output.txt").read_text() == f"has {kind}.\n"


@pytest.mark.parametrize("option", ["gres=gpu:h100:1", "gpus-per-node=1"])
def test_gpus_that_a_further_option_asks_for_are_expected(submitted, tmp_path, option):
    place, fake, _ = submitted
    fake.submit_array = lambda attempts: attempts
    place = SlurmLauncher(tmp_path, None, SlurmSettings(sbatch=("exclusive", option)), executor=fake)
    assert place.launch([tmp_path])[0].accelerator == "gpu"


def test_where_slurm_takes_some_jobs_but_not_all_none_stays_in_its_queue(submitted, tmp_path, monkeypatch):
    from submitit.core.utils import FailedJobError

    place, fake, _ = submitted
    monkeypatch.setattr(slurm, "LARGEST_ARRAY", 2)

    def submit_array(attempts):
        if fake.arrays:
            raise FailedJobError("QOSMaxSubmitJobPerUserLimit")
        fake.arrays.append(len(attempts))
        return [fake.submit(None, f"8_{i}") for i in range(len(attempts))]

    fake.submit_array = submit_array
    directories = [tmp_path / str(i) for i in range(3)]
    for directory in directories:
        directory.mkdir()
    with pytest.raises(ConfigError, match="take the jobs: QOSMaxSubmitJobPerUserLimit; .* with --workers N"):
        place.launch(directories)
    assert fake.cancelled == [["scancel", "8_0", "8_1"]]


def test_where_one_process_cannot_start_the_others_end(tmp_path):
    place = fake_trial.launcher(tmp_path, 2)
    started, start = [], place._start
    place._start = lambda directory: started.append(start(directory)) or started[-1]
    (tmp_path / "a").mkdir()
    (tmp_path / "a/job.json").write_text('{"steps": 2000, "seconds": 0.02, "end": "result"}')
    with pytest.raises(FileNotFoundError):
        place.launch([tmp_path / "a", tmp_path / "missing"])
    assert len(started) == 1 and started[0].process.poll() is not None


@pytest.fixture
def submitted(tmp_path, monkeypatch):
    """A Slurm launcher, its fake, and a job that only stands in the queue."""
    pytest.importorskip("submitit", reason="needs the extra `slurm`")
    fake = FakeSlurm(tmp_path / "slurm", monkeypatch)
    place = SlurmLauncher(tmp_path, None, executor=fake)
    place.pause = 0.0
    return place, fake, fake.submit(None, "7_0")


@pytest.mark.parametrize(
    ("said", "state"),
    [("PENDING", None), ("RUNNING", None), ("COMPLETING", None), ("REQUEUED", None), ("NODE_FAIL", "lost"),
     ("OUT_OF_MEMORY", "lost"), ("FAILED", "lost"), ("CANCELLED", "preempted"), ("PREEMPTED", "preempted"),
     ("TIMEOUT", "preempted")],
)  # fmt: skip
def test_what_slurm_says_of_a_job_without_a_result(submitted, tmp_path, said, state):
    place, fake, handle = submitted
    fake.states["7_0"] = said
    ended = place.ended(handle)
    assert (ended and outcome(tmp_path, ended).event) == state
    assert state is None or said in outcome(tmp_path, ended).message


def test_a_result_that_is_late_on_the_shared_disk_is_waited_for(submitted, monkeypatch):
    place, fake, handle = submitted
    fake.states["7_0"] = "COMPLETED"
    assert place.ended(handle) is None
    handle.paths.result_pickle.write_bytes(pickle.dumps(("success", 0)))
    assert place.ended(handle) == AttemptEnd(0)
    handle.paths.result_pickle.unlink()
    monkeypatch.setattr(slurm, "LINGER", 0.0)
    assert place.ended(handle).code is None


def test_a_shared_disk_that_does_not_answer_ends_no_trial(submitted, monkeypatch):
    place, fake, handle = submitted
    fake.states["7_0"] = "RUNNING"
    handle.paths.result_pickle.mkdir()  # reading it fails, as on a disk that is cut off
    assert place.ended(handle) is None


def test_a_job_that_stopped_is_not_brought_back_by_slurm_beside_the_next_one(submitted):
    place, fake, handle = submitted
    handle.paths.result_pickle.write_bytes(pickle.dumps(("success", 130)))
    assert place.ended(handle) == AttemptEnd(130)
    assert fake.cancelled == [["scancel", "7_0"]]


def test_a_controller_that_does_not_answer_ends_no_trial(submitted, monkeypatch):
    place, fake, handle = submitted
    monkeypatch.undo()

    def run(*_, **__):
        raise subprocess.CalledProcessError(1, "squeue")

    monkeypatch.setattr(slurm.subprocess, "run", run)
    monkeypatch.setattr(slurm, "LINGER", 0.0)
    assert slurm.ask_states() is None and place.ended(handle) is None
    monkeypatch.setattr(slurm, "ask_states", lambda: {"6_0": "RUNNING"})
    assert place.ended(handle).code is None  # it answers, and knows the job no more


def start_attempt(root: Path, kind: type[Attempt] = Attempt) -> tuple[Attempt, threading.Thread, list[int]]:
    """An attempt at a trial that takes long, once it has begun to count."""
    directory = root / "trials/a"
    directory.mkdir(parents=True)
    (directory / "job.json").write_text('{"steps": 2000, "seconds": 0.02, "end": "result"}')
    attempt, codes = kind(directory, root / "compiled", fake_trial.command), []
    thread = threading.Thread(target=lambda: codes.append(attempt.run()))
    thread.start()
    deadline = time.monotonic() + 30
    while not (directory / "run/count.txt").exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return attempt, thread, codes


def test_a_trial_on_ray_stops_though_ray_forgets_to_say_so(tmp_path):
    """As it does of a task that has just begun. What asked an earlier attempt does not stop the next one."""
    attempt, thread, _ = start_attempt(tmp_path)
    engine = FakeRay()
    engine.cancel = lambda *_, **__: None
    place = RayLauncher(tmp_path, None, engine=engine, command=fake_trial.command)
    place.ask_to_stop([ray.Task(attempt.directory, None)])
    thread.join(20)
    assert not thread.is_alive() and not (attempt.directory / "trial.lock").exists()
    before = int((attempt.directory / "run/count.txt").read_text())
    [task] = place.launch([attempt.directory])
    deadline = time.monotonic() + 30
    while int((attempt.directory / "run/count.txt").read_text() or 0) < before + 10:
        assert time.monotonic() < deadline and place.ended(task) is None
        time.sleep(0.01)
    place.ask_to_stop([task])
    assert task.reference.result(timeout=20) == 130


def test_an_announced_end_of_a_job_saves_and_hands_back_the_same_attempt(tmp_path):
    """What submitit calls on SIGUSR2, before it puts the job back into the queue."""
    pytest.importorskip("submitit", reason="needs the extra `slurm`")
    attempt, thread, codes = start_attempt(tmp_path, SlurmAttempt)
    again = attempt.checkpoint()
    thread.join(20)
    assert outcome(attempt.directory, AttemptEnd(codes[0])).event == "preempted"
    copy = pickle.loads(pickle.dumps(again.function))
    assert (copy.directory, copy.cache) == (attempt.directory, attempt.cache)


@pytest.mark.parametrize(("grace", "to_save"), [(600, 590), (12, 20), (0, 20)])
def test_a_trial_has_the_grace_of_its_job_to_save(tmp_path, monkeypatch, grace, to_save):
    pytest.importorskip("submitit", reason="needs the extra `slurm`")
    fake, submitted = FakeSlurm(tmp_path / "slurm", monkeypatch), []
    fake.submit_array = lambda attempts: submitted.extend(attempts) or attempts
    SlurmLauncher(tmp_path, None, SlurmSettings(grace=grace, gpus=1), executor=fake).launch([tmp_path])
    (attempt,) = submitted
    assert attempt.accelerator == "gpu"
    attempt._code = 130  # it has saved
    assert attempt.grace == attempt.checkpoint().function.grace == to_save


def test_a_trial_that_does_not_end_within_its_grace_is_killed(tmp_path):
    unwanted = ["sh", "-c", f"rm {tmp_path}/wanted; exec sleep 60"]
    attempt = Attempt(tmp_path, tmp_path / "compiled", lambda directory: unwanted, grace=0.2)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # which the child inherits
    try:
        assert attempt.run() == -signal.SIGKILL
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGTERM, 130), (signal.SIGUSR2, 77)])
def test_a_signal_to_the_engines_process_stops_its_trial_in_order(tmp_path, sent, code):
    """SIGTERM of scancel, and SIGUSR2, on which submitit asks for a checkpoint in the signal's handler."""
    program = (
        "import signal, sys; from pathlib import Path\n"
        "from experiments.running.launchers.remote import Attempt; from tests.experiments import fake_trial\n"
        "attempt = Attempt(Path(sys.argv[1]), Path('compiled'), fake_trial.command)\n"
        "def announced(*_): attempt.end(); sys.exit(77)\n"
        "signal.signal(signal.SIGUSR2, announced)\n"
        "signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})\n"  # as in Ray's workers; children inherit it
        "code = attempt.run()\n"
        "sys.exit(128 - code if code < 0 else code)"
    )
    directory = tmp_path / "trials/a"
    directory.mkdir(parents=True)
    (directory / "job.json").write_text('{"steps": 2000, "seconds": 0.02, "end": "result"}')
    engine = subprocess.Popen([sys.executable, "-c", program, str(directory)])
    deadline = time.monotonic() + 60
    while not (directory / "run/count.txt").exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    engine.send_signal(sent)
    assert engine.wait(50) == code
    assert not (directory / "trial.lock").exists(), "it did not leave in order"


def test_ray_is_asked_for_what_a_trial_takes(tmp_path):
    engine = FakeRay()
    settings = RaySettings(cpus=2, gpus=0.5, tpus=4, memory_gb=1.5, resources=("fast_disk=1",))
    with RayLauncher(tmp_path, None, settings, engine=engine):
        pass
    assert engine.left and engine.options == {
        "num_cpus": 2, "num_gpus": 0.5, "memory": 3 * 2**29, "max_retries": 0, "resources": {"fast_disk": 1.0, "TPU": 4}
    }  # fmt: skip


def test_a_ray_worker_that_dies_is_a_lost_trial(tmp_path):
    engine = FakeRay()
    place = RayLauncher(tmp_path, None, engine=engine)
    died = Future()
    died.set_exception(engine.exceptions.RayError("the node died\nmore"))
    ended = place.ended(ray.Task(tmp_path, died))
    assert outcome(tmp_path, ended).event == "lost" and "the node died" in ended.why


def test_a_cancelled_ray_task_has_not_ended_while_the_lock_of_its_trial_cannot_be_read(tmp_path, monkeypatch):
    """One stale handle of a shared disk ended the sweep."""
    engine = FakeRay()
    place, cancelled = RayLauncher(tmp_path, None, engine=engine), Future()
    cancelled.set_exception(engine.exceptions.TaskCancelledError())
    task, answers = ray.Task(tmp_path, cancelled), iter([OSError(errno.ESTALE, os.strerror(errno.ESTALE)), False])

    def is_alive(directory: Path) -> bool:
        answer = next(answers)
        if isinstance(answer, OSError):
            raise answer
        return answer

    monkeypatch.setattr(ray, "is_alive", is_alive)
    assert place.ended(task) is None
    assert place.ended(task).code == -signal.SIGTERM


def test_joining_a_cluster_leaves_sigterm_to_the_command(monkeypatch):
    """Ray takes it over, and would abort the command before its trials are asked to save."""
    before = signal.getsignal(signal.SIGTERM)
    engine = SimpleNamespace(init=lambda **_: signal.signal(signal.SIGTERM, signal.SIG_DFL))
    monkeypatch.setitem(sys.modules, "ray", engine)
    try:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        assert ray._join("auto") is engine and signal.getsignal(signal.SIGTERM) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        (("slurm", 1, ("partition",)), "--launcher-set partition: write it as key=value"),
        (("slurm", 1, ("part=x",)), "the slurm launcher has no such setting; it has partition, account"),
        (("slurm", 1, ("gpus=two",)), "--launcher-set gpus=two: expected a number"),
        (("slurm", 1, ("minutes=0",)), "--launcher-set minutes=0: it must be at least 1"),
        (("slurm", 1, ("minutes=2",)), "--launcher-set grace=120: must be shorter than the job's 2 minutes"),
        (("slurm", 1, ("memory_gb=-1",)), "--launcher-set memory_gb=-1: it must be positive"),
        (("ray", 1, ("gpus=-1",)), "--launcher-set gpus=-1: it must be 0 or more"),
        (("ray", 1, ("gpus=1.5",)), "--launcher-set gpus=1.5: it must be 0 or more, above 1 a whole number"),
        (("ray", 1, ("cpus=NaN",)), "--launcher-set cpus=nan: it must be 0 or more"),
        (("ray", 1, ("memory_gb=0",)), "--launcher-set memory_gb=0: it must be positive"),
        (("ray", 1, ("resources=fast_disk",)), "--launcher-set resources=fast_disk: write it as resources=NAME=AMOUNT"),
        (("slurm", 1, ("gpus=1.5",)), "gpus: expected int, got 1.5"),
        (("local", 1, ("gpus=1",)), "the local launcher has no such setting; it has none"),
        (("mpi", 1, ()), f"--launcher mpi: choose one of {', '.join(LAUNCHERS)}"),
    ],
)
def test_mistakes_in_launcher_settings_are_said_before_anything_runs(said, words):
    with pytest.raises(ConfigError) as error:
        LauncherOptions(*said)
    assert words in str(error.value)


def test_the_command_line_refuses_a_launcher_that_is_not_there(capsys):
    assert main(["study", "--preset", "smoke", "--launcher", "pbs"]) == 2
    assert f"--launcher pbs: choose one of {', '.join(LAUNCHERS)}" in capsys.readouterr().err


def test_settings_are_read_as_what_they_are():
    said = ("partition=123", "gpus=2", "memory_gb=1.5", "sbatch=gres=gpu:h100:1", "sbatch=exclusive")
    _, settings = LauncherOptions("slurm", None, said)._parsed()
    assert settings == SlurmSettings(partition="123", gpus=2, memory_gb=1.5, sbatch=("gres=gpu:h100:1", "exclusive"))


def test_without_the_engine_the_message_says_what_to_install(tmp_path, monkeypatch):
    for name, package in (("slurm", "submitit"), ("ray", "ray")):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(ConfigError, match=rf"pip install 'hma-jax\[{name}\]'"):
            LauncherOptions(name).launcher(tmp_path)


def test_without_the_engine_nothing_is_prepared(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "submitit", None)
    assert main(["sweep", "width", "--preset", "smoke", "--out", str(tmp_path / "out"), "--launcher", "slurm"]) == 2
    assert "--launcher slurm needs submitit: pip install 'hma-jax[slurm]'" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_an_attempt_that_is_killed_because_it_does_not_stop_is_not_said_to_be_out_of_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(base, "GRACE_SECONDS", 0.2)
    deaf = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(60)"
    place = LocalLauncher(tmp_path, 1, command=lambda directory: [sys.executable, "-c", deaf])
    place.pause = 0.01
    directory = tmp_path / "trial"
    directory.mkdir()
    handles = place.launch([directory])
    while not (directory / OUTPUT).exists() or not (directory / OUTPUT).read_text():
        time.sleep(0.01)
    (ended,) = place.stop(handles)
    state = outcome(directory, ended)
    assert state.event == "lost" and "memory" not in state.message
    assert "it had not saved 0.2 s after it was asked to stop, and was killed" in state.message
    again = place.launch([directory])  # its slot is free
    place.kill(again)
