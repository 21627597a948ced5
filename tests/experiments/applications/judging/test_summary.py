"""What a summary compares with what, from outcomes that are known."""

from types import SimpleNamespace

import numpy as np
import pytest

from experiments.applications.judging.outcomes import HEAD, LEARNED, SHUFFLED, STATE, TRUE, Outcome
from experiments.applications.judging.real import Count
from experiments.applications.judging.summary import REAL, REFERENCE, summarise
from experiments.applications.policies import find_task

POLICIES, STARTS = tuple("abcde"), 20


def judgement(rates: dict[tuple[str, str], list[float]]) -> SimpleNamespace:
    """As many starts succeed, the first ones, as the rates of POLICIES say, by world and judge."""
    outcomes = [
        Outcome(policy, start, start, start, world, judge, start < rate * STARTS)
        for (world, judge), each in rates.items()
        for policy, rate in zip(POLICIES, each, strict=True)
        for start in range(STARTS)
    ]
    config = SimpleNamespace(task=find_task("gripper_wood"), starts=STARTS)
    worlds = tuple(dict.fromkeys(world for world, _ in rates))
    return SimpleNamespace(
        config=config, policies=POLICIES, outcomes=outcomes, worlds=worlds, user_policies=(), clipped={}, seconds={},
        head=SimpleNamespace(measured={}),
    )  # fmt: skip


MODEL, CONTROL = [0.1, 0.5, 0.3, 0.9, 0.7], [0.2, 0.1, 0.2, 0.1, 0.2]


def test_the_model_is_compared_with_the_true_world_and_with_the_control(few_draws):
    true = [0.0, 0.4, 0.3, 0.8, 0.5]
    found = summarise(
        judgement({(TRUE, STATE): true, (TRUE, HEAD): true, (LEARNED, HEAD): MODEL, (SHUFFLED, HEAD): CONTROL})
    )
    assert found["compared with"] == REFERENCE
    agreed = {name: of["starts"]["bias"]["mean"] for name, of in found["agreement"].items()}
    expected = {"learned model": 0.1, "the head alone, on true frames": 0, "control: actions of other episodes": -0.24}
    assert agreed == pytest.approx(expected)
    assert found["above the control"]["mean"] == pytest.approx(np.mean(MODEL) - np.mean(CONTROL))
    # Whatever succeeds truly succeeds in the model; a tenth of all episodes succeed there alone.
    alike = {kind: of["mean"] for kind, of in found["episodes alike"].items()}
    expected = {"all episodes": 0.9, "those that truly succeed": 1, "those that truly fail": 1 - 0.1 / 0.6}
    assert alike == pytest.approx(expected, abs=1e-4)


def test_a_policy_is_compared_with_its_own_count_on_the_real_robot(few_draws):
    """Counts are of some policies, in any order."""
    real = {"e": Count(7, 10), "b": Count(5, 10), "d": Count(9, 10)}
    found = summarise(judgement({(LEARNED, HEAD): MODEL, (SHUFFLED, HEAD): CONTROL}), real)
    assert found["compared with"] == REAL
    agreed = found["agreement"]["learned model"]["policies and starts"]
    assert (agreed["pearson"]["mean"], agreed["rank violation"]["mean"], agreed["bias"]["mean"]) == (1, 0, 0)
    assert [of[REAL]["mean"] for of in found["policies"].values()] == [None, 0.5, None, 0.9, 0.7]
