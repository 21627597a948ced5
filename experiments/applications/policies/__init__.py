"""Policies that see images: what they are, what they are trained on, and how they are kept.

`policy` says what a policy is, `tasks` what it should do, `demonstrations` are recorded episodes of the scripted
expert, `cloning` and `diffusion` train networks on them, `kinds` is the table of these, `files` saves and loads them;
`own_head` is HMA as a policy, `scripted` the expert itself, which sees the true state instead of images.
"""

from experiments.applications.policies.demonstrations import Demonstrations, record
from experiments.applications.policies.files import load_policy, save_policy
from experiments.applications.policies.policy import Policy, RandomPolicy
from experiments.applications.policies.tasks import Task, find_task

__all__ = ["Demonstrations", "Policy", "RandomPolicy", "Task", "find_task", "load_policy", "record", "save_policy"]
