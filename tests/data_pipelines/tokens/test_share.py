from __future__ import annotations

import pytest

from data_pipelines.tokens.dataset_writer import cut_parts
from data_pipelines.tokens.share import Share, find_share
from hma_jax.config import ConfigError


def array(task: int, count: int, first: int = 0) -> dict[str, str]:
    values = {"ID": task, "COUNT": count, "MIN": first, "MAX": first + count - 1}
    return {f"SLURM_ARRAY_TASK_{k}": str(v) for k, v in values.items()}


def srun(task: int, tasks: int) -> dict[str, str]:
    return {"SLURM_PROCID": str(task), "SLURM_STEP_NUM_TASKS": str(tasks)}


@pytest.mark.parametrize(
    "environ, expected",
    [
        ({}, (0, 1)),
        (array(3, 8), (3, 8)),
        (srun(2, 4), (2, 4)),
        (array(3, 8) | srun(2, 4), (14, 32)),
        (array(0, 1), (0, 1)),
        ({"OMPI_COMM_WORLD_RANK": "1", "OMPI_COMM_WORLD_SIZE": "2"}, (1, 2)),
        # a batch script runs once, whatever its job may start with srun later
        ({"SLURM_PROCID": "0", "SLURM_NTASKS": "8"}, (0, 1)),
    ],
)
def test_share_is_read_from_what_started_the_process(environ, expected):
    share = find_share(None, None, environ)
    assert (share.process, share.processes) == expected
    assert bool(share.told_by) == (expected[1] > 1)


def test_what_is_given_comes_first():
    assert find_share(1, 5, array(3, 8)) == Share(1, 5)
    assert find_share(None, 1, array(3, 8)) == Share(0, 1)


@pytest.mark.parametrize(
    "environ, given",
    [
        (array(3, 2, first=3), (None, None)),  # two lost tasks started again: 3 and 4 of what?
        ({**array(7, 2), "SLURM_ARRAY_TASK_MAX": "7"}, (None, None)),
        ({**array(1, 2), "SLURM_ARRAY_TASK_COUNT": "two"}, (None, None)),
        ({}, (0, None)),
        ({}, (None, 4)),
        ({}, (4, 4)),
    ],
)
def test_half_an_answer_is_refused(environ, given):
    with pytest.raises(ConfigError, match="process"):
        find_share(*given, environ)


@pytest.mark.parametrize("processes", [1, 3, 8])
def test_shares_are_all_the_work_once(processes):
    parts = cut_parts([1] * 20, 2, 100)
    shares = [Share(i, processes).of(parts, "toy") for i in range(processes)]
    assert sorted((p.number for share in shares for p in share)) == list(range(len(parts)))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1


def test_small_datasets_are_spread_over_processes():
    (part,) = cut_parts([1], 2, 100)
    owners = {i for i in range(4) for d in range(40) if Share(i, 4).of([part], f"dataset {d}")}
    assert owners == {0, 1, 2, 3}
