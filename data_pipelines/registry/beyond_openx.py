"""Datasets of the paper's mixture that are not in Open X-Embodiment: human videos and simulators.

Nobody published these as RLDS, so the entries describe what `hma data convert` writes: one camera, and one
field `action`.
"""

from __future__ import annotations

from data_pipelines.registry.openx import openx

CONVERTED = "layout: nobody published it as RLDS"

BEYOND_OPENX = (
    # DIFFERS: in the release imperial_wrist_dataset has no rate (native 10 Hz), because its table knows the
    # name imperialcollege_sawyer_wrist_cam only; and the termination flag is part of the action.
    openx("imperial_wrist_dataset", 10, {"action[:7]": 7}, "Sawyer: deltas in the hand's frame and gripper",
          image="wrist_image", camera="wrist, the only one",
          unverified="layout: taken from imperialcollege_sawyer_wrist_cam, which it seems to be"),
    # DIFFERS: the release says 6 Hz; one simulator step is 1/80 s.
    openx("metaworld", 80, {"action": 4}, "Meta-World, Sawyer: hand displacement and gripper", version="",
          unverified=CONVERTED),
    # DIFFERS: the release says 6 Hz; robosuite's control rate, at which the demonstrations lie, is 20 Hz.
    openx("robomimic", 20, {"action": 7}, "Robomimic, simulated Panda: pose deltas and gripper",
          image="agentview", version="", unverified=CONVERTED),
    # DIFFERS: the release says 30 Hz; videos have 50 or 60, and a conversion thins both to the same 10.
    openx("epic_kitchen", 10, {"action": 4}, "EPIC-KITCHENS: how both hands' box centres move",
          camera="head", version="", unverified=CONVERTED),
    # DIFFERS: the release says 1 Hz; annotated frames are half a second apart.
    openx("ego4d", 2, {"action": 4}, "Ego4D: where both hands' centres are next", camera="head", version="",
          unverified=f"{CONVERTED}; annotated frames are not quite even"),
    openx("exoego4d", 30, {"action": 4}, "Ego-Exo4D: where both wrists are next, in an outer camera",
          version="", unverified=CONVERTED),
)  # fmt: skip
