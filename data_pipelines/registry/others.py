"""What the paper's mixture adds to Open X-Embodiment: human videos and simulators.

Nobody published these as RLDS, so the entries describe what a conversion writes: one camera
`image` and one field `action`.
"""

from __future__ import annotations

from data_pipelines.registry.openx import openx

CONVERTED = "layout: nobody published it as RLDS"

OTHERS = (
    # DIFFERS: in the release imperial_wrist_dataset has no rate (native 10 Hz), because its table knows the
    # name imperialcollege_sawyer_wrist_cam only; and the termination flag is part of the action.
    openx("imperial_wrist_dataset", 10, {"action[:7]": 7}, "Sawyer: deltas in the hand's frame and gripper",
          image="wrist_image", camera="wrist, the only one",
          unverified="layout: taken from imperialcollege_sawyer_wrist_cam, which it seems to be"),
    # DIFFERS: the release says 6 Hz; one simulator step is 1/80 s.
    openx("metaworld", 80, {"action": 4}, "Meta-World, Sawyer: hand displacement and gripper", version="",
          unverified=CONVERTED),
    # DIFFERS: the release says 6 Hz; robosuite's control rate, at which the demonstrations lie, is 20 Hz.
    openx("robomimic", 20, {"action": 7}, "Robomimic, simulated Panda: pose deltas and gripper", version="",
          unverified=CONVERTED),
    openx("epic_kitchen", 30, {"action": 4}, "EPIC-KITCHENS: both hands' box centres",
          camera="head", version="",
          unverified=f"{CONVERTED}; hz (frames as extracted)"),
    openx("ego4d", 1, {"action": 4}, "Ego4D: both hands' centres in annotated frames",
          camera="head", version="",
          unverified=f"{CONVERTED}; hz (annotated frames are irregular)"),
    openx("exoego4d", 30, {"action": 4}, "Ego-Exo4D: both wrists in an outer camera", version="",
          unverified=CONVERTED),
)  # fmt: skip
