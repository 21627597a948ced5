"""The stress program, small; and one process killed at every single step of what it saves."""

from __future__ import annotations

import multiprocessing
import signal
from dataclasses import replace

import pytest

from data_pipelines.registry import get_spec
from tests.data_pipelines.fakes import write_rlds
from tests.files import contents
from tests.stress import tokenize_kills
from tests.stress.tokenize_process import Work, read, tokenize


@pytest.mark.slow
def test_kills_among_processes_leave_no_trace(tmp_path):
    outcome = tokenize_kills.run(tmp_path, kills=3, processes=3, datasets=1)
    assert outcome.good and outcome.kills >= 3, outcome
    assert outcome.begun == outcome.parts + outcome.again_in_flight


NAME = "pusher_mint"


@pytest.fixture(scope="module")
def start():
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["tests.stress.tokenize_process"])

    def start(work: Work, *death) -> int:
        process = context.Process(target=tokenize, args=(work, *death))
        process.start()
        process.join()
        return process.exitcode

    return start


@pytest.mark.slow
def test_a_death_at_any_step_of_a_save_leaves_no_trace(tmp_path, start):
    write_rlds(tmp_path / "suite", get_spec(NAME), [8, 9, 10, 11], shards=2)
    work = Work(tmp_path / "suite", (NAME,), tmp_path / "undisturbed", tmp_path / "log", 1500, pause=0, one_split=True)
    assert start(work) == 0
    expected, deaths = contents(work.store), 0
    assert sum("parts/" in name for name in expected) == 2
    while True:
        store = replace(work, store=tmp_path / str(deaths))
        code = start(store, deaths + 1)
        if code == 0:
            break  # it takes fewer steps
        assert code == -signal.SIGKILL
        assert start(store) == 0
        assert contents(store.store) == expected, [e for e in read(work.log) if e["what"] == "dies"][-1]
        assert [p.name for p in store.store.iterdir()] == [NAME]
        deaths += 1
    assert deaths > 20
