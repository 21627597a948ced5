"""Several real processes as one program: what each learns of the others, and the rows that each loads."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import pytest
from jax._src.lib import _jax

from hma_jax.config import ConfigError
from hma_jax.runtime import processes
from hma_jax.runtime.exits import Exit, Terminated, sigterm_as_interrupt
from hma_jax.runtime.processes import ALL_DEVICES, Processes, own_devices
from hma_jax.runtime.watchdog import DONE, FAILED, Heartbeats, HeartbeatServer, Watchdog, send_heartbeat
from tests.multihost.processes import by_address, by_slurm, free_port, run

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("said", [by_address, pytest.param(by_slurm, marks=pytest.mark.slow)])
def test_two_processes_meet(said, tmp_path: Path):
    ended = run("tests.multihost.meet", [str(tmp_path / "file")], processes=2, said=said)
    first, second = (json.loads(text.splitlines()[-1]) for text in ended)
    assert first["rows"] == {"(-1, 1, 1)": [0, 1, 2, 3], "(1, 2, 1)": [0, 1, 2, 3], "(1, 1, 2)": [*range(8)]}
    assert second["rows"] == {"(-1, 1, 1)": [4, 5, 6, 7], "(1, 2, 1)": [4, 5, 6, 7], "(1, 1, 2)": [*range(8)]}
    for report in (first, second):
        assert report["seen"] == "here" and report["told"] == ["p0", "p1"] and report["from_writer"] == "p0"
        assert report["agreed"] == [0, 0, 1, 2]  # of each step the largest request, a step later
        assert report["sum"] == 5.0 and report["gpus"] == "all"


@pytest.mark.parametrize(
    ("given", "environment", "message"),
    [
        ({"processes": 2}, {}, "several processes need --coordinator"),
        ({}, {"HMA_PROCESSES": "2"}, "several processes need --coordinator"),
        ({"coordinator": "a:1", "processes": 2, "process": 2}, {}, "--process counts from 0 to 1"),
        ({"coordinator": "a", "processes": 2, "process": 0}, {}, "must be HOST:PORT"),
        ({}, {"HMA_PROCESSES": "two"}, "HMA_PROCESSES must be a number"),
        ({"lost_after": 1.0}, {}, "--lost-after must be at least 5"),
    ],
)
def test_what_cannot_be_started_is_refused(given, environment, message):
    with pytest.raises(ConfigError, match=message):
        Processes(**given).or_from(environment)


def test_what_is_given_goes_before_the_environment():
    environment = {"HMA_COORDINATOR": "b:2", "HMA_PROCESSES": "2", "HMA_PROCESS": "1"}
    asked = Processes(coordinator="a:1").or_from(environment)
    assert (asked.coordinator, asked.processes, asked.process, asked.several) == ("a:1", 2, 1, True)
    assert not Processes().or_from({}).several


SLURM = {"SLURM_LOCALID": "3", "SLURM_NODEID": "2", "SLURM_STEP_TASKS_PER_NODE": "8(x2),4,1"}
EIGHT = {"CUDA_VISIBLE_DEVICES": "0,1,2,3,4,5,6,7"}
MPI = {"OMPI_COMM_WORLD_LOCAL_RANK": "1"}


@pytest.mark.parametrize(
    ("environment", "devices"),
    [
        (SLURM | EIGHT, None),  # srun --ntasks-per-node 4 --gpus-per-node 8
        (SLURM | {"CUDA_VISIBLE_DEVICES": "0"}, ALL_DEVICES),  # --gpus-per-task 1
        (SLURM | {"CUDA_VISIBLE_DEVICES": "6,7"}, ALL_DEVICES),  # --gpus-per-task 2
        # --ntasks-per-node 4 --gpus-per-task h100:4, and --gpus-per-task 2 --gpu-bind none
        (SLURM | {"SLURM_GPUS_PER_TASK": "h100:4", "CUDA_VISIBLE_DEVICES": "0,1,2,3"}, ALL_DEVICES),
        (SLURM | {"SLURM_GPUS_PER_TASK": "2"} | EIGHT, None),
        (SLURM | {"SLURM_NODEID": "3"} | EIGHT, ALL_DEVICES),  # --ntasks-per-node 1 --gpus-per-node 8
        (SLURM | {"SLURM_NODEID": "1", "CUDA_VISIBLE_DEVICES": "0,1,2,3"}, ALL_DEVICES),
        (SLURM | {"SLURM_NODEID": "3", "JAX_LOCAL_DEVICE_IDS": "5"} | EIGHT, None),
        (SLURM, None),
        (SLURM | {"SLURM_NODEID": "4"} | EIGHT, None),  # of which the list says nothing
        (MPI | {"OMPI_COMM_WORLD_LOCAL_SIZE": "1"}, ALL_DEVICES),
        (MPI | {"OMPI_COMM_WORLD_LOCAL_SIZE": "8"} | EIGHT, None),
        ({}, None),
    ],
)
def test_a_process_takes_all_devices_that_are_its_own(environment, devices):
    """JAX would take the one with the number of the process on its node."""
    assert own_devices(environment) == devices


class Left(Exception):
    """In place of the end of this process."""


@pytest.mark.parametrize(
    ("meanwhile", "code", "message"),
    [
        (lambda: None, 2, "error: .* could not connect within 1 s at a:1 .not all have started"),
        (lambda: os.kill(os.getpid(), signal.SIGTERM), 143, "stopped while waiting"),
    ],
)
def test_a_process_that_waits_in_vain_or_is_stopped_says_so(meanwhile, code, message, monkeypatch):
    """JAX waits in C++, deaf to signals, and aborts in the end."""
    ended = threading.Event()

    def initialize(*_, initialization_timeout, **__):
        meanwhile()
        ended.wait(initialization_timeout)

    def leave(said, how):
        ended.set()
        raise Left(f"{how}: {said}")

    monkeypatch.setattr(processes.jax.distributed, "initialize", initialize)
    monkeypatch.setattr(processes, "_exit_now", leave)
    asked = Processes("a:1", 2, 0, start_timeout=1.0)
    with pytest.raises(Left, match=f"{code}: {message}"), sigterm_as_interrupt():
        processes.start(asked)


class Client:
    """Of a coordination service with the key that process 1 of two sets after a while."""

    def __init__(self):
        self.asked, self.there = [], threading.Event()

    def key_value_set(self, key: str, value: str) -> None:
        del key, value

    def blocking_key_value_get(self, key: str, timeout: int) -> str:
        if key.endswith("1"):
            self.asked.append(key)
            if not self.there.wait(min(timeout / 1000, 60)):
                raise jax.errors.JaxRuntimeError("DEADLINE_EXCEEDED: it timed out")
        return "=here"


@pytest.fixture
def of_two(monkeypatch):
    """Makes this process the first of two, whose coordination service has the given client."""

    def be(client: Any) -> None:
        monkeypatch.setattr(processes, "_state", lambda: SimpleNamespace(client=client))
        monkeypatch.setattr(processes.jax, "process_count", lambda: 2)

    return be


def test_a_process_that_waits_for_another_one_asks_for_its_text_once(of_two):
    """JAX keeps each request that timed out in the memory of both processes: in hours they would fill it."""
    of_two(client := Client())
    threading.Timer(1.5, client.there.set).start()
    assert processes.all_gather("late", "here") == ["here", "here"] and len(client.asked) == 1


def test_a_process_that_waits_for_another_one_stops_when_it_is_asked(of_two):
    """Its wait is a call of JAX that no signal interrupts."""
    address = f"127.0.0.1:{free_port()}"
    service = _jax.get_distributed_runtime_service(address, 1)
    client = _jax.get_distributed_runtime_client(address, 0)
    client.connect()
    of_two(client)
    request = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGTERM))
    began = time.monotonic()
    with pytest.raises(Terminated), sigterm_as_interrupt():
        request.start()
        processes.all_gather("nobody else calls it", "")
    assert time.monotonic() - began < 5
    client.shutdown()
    service.shutdown()


def test_no_process_runs_a_program_before_all_have_compiled_it(monkeypatch):
    """On CPUs its collectives wait for 30 seconds only."""
    done = []
    program = SimpleNamespace(compile=lambda: done.append("compiled") or "program")
    jitted = SimpleNamespace(lower=lambda *arguments: done.append(arguments) or program)
    assert processes.compiled_by_all("it", jitted, 1, 2) is jitted and not done
    monkeypatch.setattr(processes.jax, "process_count", lambda: 2)
    monkeypatch.setattr(processes, "barrier", done.append)
    assert processes.compiled_by_all("it", jitted, 1, 2) == "program"
    assert done == [(1, 2), "compiled", "compiled/it"]


class World:
    """Heartbeats of process `me` of three, and a clock that stands until it is told."""

    def __init__(self, me: int):
        self.now = 0.0
        self.heartbeats = Heartbeats(me, ["a", "b", "c"], "a:1", lost_after=90.0, clock=lambda: self.now)

    def after(self, seconds: float, heard: dict[int, list] | None = None) -> str | None:
        self.now += seconds
        if heard is not None:
            self.heartbeats.receive(heard)
        failure = self.heartbeats.failure()
        self.code = failure and failure[1]
        return failure and failure[0]


def test_a_silent_process_is_lost_by_name_when_its_time_is_over():
    world = World(0)
    assert world.after(1, {0: [1], 1: [1], 2: [1]}) is None
    assert world.after(89, {0: [2], 1: [2], 2: [1]}) is None
    assert "lost process 2 of 3 on host c: no sign of life for 91 s" in world.after(2, {0: [3], 1: [3], 2: [1]})


def test_one_that_never_gave_a_sign_is_lost_too():
    assert "process 1 of 3 on host b" in World(0).after(91, {0: [1], 2: [1]})


def test_a_silent_coordinator_is_lost_and_nobody_else_is_blamed_for_its_silence():
    world = World(1)
    assert world.after(1, {0: [1], 1: [1], 2: [1]}) is None
    assert world.after(90) is None
    assert "process 0 of 3 on host a, the coordinator at a:1: it has not answered for 91 s" in world.after(1)


def test_a_coordinator_that_refuses_connections_is_lost_at_once():
    world = World(1)
    world.heartbeats.refused = True
    assert "the coordinator at a:1: it has ended" in world.after(1)


def test_after_a_cut_the_others_have_their_time_again():
    world = World(1)
    assert world.after(60) is None
    assert world.after(0, {0: [60], 1: [1], 2: [1]}) is None
    assert world.after(89, {0: [149], 1: [1], 2: [1]}) is None


def test_a_process_that_stood_still_itself_blames_nobody():
    world = World(1)
    assert world.after(1, {0: [1], 1: [1], 2: [1]}) is None
    world.now += 200
    world.heartbeats.extend_deadlines(200)
    assert world.after(80) is None
    assert "lost process 0" in world.after(20)


def test_whoever_is_done_is_not_missed():
    world = World(1)
    assert world.after(1, {0: [DONE], 1: [1], 2: [DONE]}) is None
    assert world.after(500) is None
    world.heartbeats.refused = True
    assert world.after(1) is None


def test_an_error_elsewhere_is_told_unless_this_process_has_it_too():
    world = World(1)
    assert world.after(1, {0: [1], 1: [1], 2: [FAILED, "disk full", 1]}) is None  # it may be about to say so itself
    assert world.after(3, {0: [4]}) == "process 2 of 3 on host c ended with an error: disk full"
    assert World(2).after(9, {2: [FAILED, "disk full", 1], 0: [1], 1: [1]}) is None


@pytest.mark.parametrize(("code", "own"), [(1, 75), (2, 2), (3, 3), (130, 75)])
def test_what_would_fail_again_has_the_same_code_everywhere(code, own):
    """A scheduler that sees one code of many must not start it again for ever."""
    world = World(1)
    world.after(1, {0: [FAILED, "why", code], 1: [1], 2: [1]})
    assert world.after(3, {2: [4]}) and world.code == own


@pytest.mark.parametrize("code", [0, 1, 2, 3, 75, 130, 134, 137, 139, 143, 253])
def test_the_slurm_script_of_the_page_puts_lost_jobs_back_into_the_queue(code):
    page = (ROOT / "docs" / "hosts.md").read_text()
    script = page[page.index("    srun --kill-on-bad-exit") :].split("\n\n")[0]
    slurm = f"srun() {{ return {code}; }}; scontrol() {{ echo $1 $2; }}; SLURM_JOB_ID=7"
    start = lambda count: subprocess.run(
        ["sh", "-c", f"{slurm}; SLURM_RESTART_COUNT={count}\n{script}"], capture_output=True, text=True
    )
    again = code in (75, 134, 137, 139, 253)
    assert start("").stdout == start(3).stdout == ("requeue 7\n" if again else "") and start("").stderr == ""
    assert start(20).stdout == ""


def has_address(host: str) -> bool:
    try:
        socket.create_server((host, 0), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError:
        return False
    return True


@pytest.mark.parametrize(
    "host", ["127.0.0.1", pytest.param("::1", marks=pytest.mark.skipif(not has_address("::1"), reason="no IPv6"))]
)
def test_heartbeats_are_sent_to_the_server_and_those_of_all_come_back(host):
    server = HeartbeatServer("word")
    assert server.exchange(0, [1]) == {0: [1]}
    assert send_heartbeat(host, server.port, "word", 1, [7]) == {0: [1], 1: [7]}
    with pytest.raises(ConnectionResetError):
        send_heartbeat(host, server.port, "of another program", 1, [8])
    with socket.create_connection((host, server.port)) as stranger:
        stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
    assert send_heartbeat(host, server.port, "word", 2, [1]) == {0: [1], 1: [7], 2: [1]}
    server.shutdown()
    server.server_close()
    with pytest.raises(ConnectionRefusedError):
        send_heartbeat(host, server.port, "word", 1, [9])


def test_a_watchdog_ends_its_process_with_the_failure_and_not_after_its_own_end():
    heard, left = {1: [1]}, threading.Event()
    verdicts: list[str] = []

    def leave(verdict: str, code: int) -> None:
        assert code == Exit.LOST
        verdicts.append(verdict)
        left.set()

    def exchange(process: int, sign: list) -> dict[int, list]:
        return heard | {process: sign}

    dog = Watchdog(Heartbeats(0, ["a", "b"], "a:1", lost_after=0.5), exchange, leave)
    assert left.wait(10) and "lost process 1 of 2 on host b" in verdicts[0]
    dog.end([DONE])
    seen = len(verdicts)
    assert not threading.Event().wait(1.5) and len(verdicts) == seen
