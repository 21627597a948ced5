"""What of a judgement comes from the true simulator."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from experiments.applications.judging.ground_truth import describe_rare_success
from experiments.applications.policies.tasks import find_task


def test_an_expert_that_hardly_does_its_own_task_is_told():
    seldom, often = (SimpleNamespace(successes=np.arange(10) < n) for n in (2, 6))
    task = replace(find_task("pusher_sand"), frames=12)
    told = "The scripted expert of pusher_sand succeeds in only 20% of the demonstrations (12 frames each), so"
    assert describe_rare_success(seldom, task).startswith(told) and describe_rare_success(often, task) == ""
    assert describe_rare_success(seldom, find_task("pusher_sand", "reach")) == ""
