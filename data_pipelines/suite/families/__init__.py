"""The ten families of five siblings: a family is one table of five rows.

Siblings share body plan, action convention, task and contact physics; they differ in geometry,
camera, unit, rate, size of the dataset and palette. Every number of action values is shared by two families, so each
robot has siblings and strangers with the same number.
"""

from data_pipelines.suite.families.carrying import BIMANUAL, GRIPPER, MOBILE, PICKER
from data_pipelines.suite.families.many_joints import HUMANOID, TENTACLES
from data_pipelines.suite.families.pushing import ARM, OMNI, PUSHER, ROVER

FAMILIES = (PUSHER, ROVER, ARM, GRIPPER, PICKER, BIMANUAL, HUMANOID, TENTACLES)
"""Families that studies train on by default."""

UNSEEN_FAMILIES = (OMNI, MOBILE)
"""Families that they do not train on: the new robots of `hma adapt`."""

__all__ = ["FAMILIES", "UNSEEN_FAMILIES"]
