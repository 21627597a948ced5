"""Open X-Embodiment: the datasets of the tfds catalogue that the paper's mixture and the release's rates leave out.

Sources as in `openx`. Left out are datasets whose camera and action cannot be read together step by step: tidybot (its
action is text), vima (pictures of varying number), robot_vqa (questions and answers) and robo_ai_u_r5e (nothing says
what its action is).
"""

from __future__ import annotations

from dataclasses import replace

from data_pipelines.registry.openx import CLOSEDNESS, LONG, openx

CLOSEDNESS_ONLY = {"action/world_vector": 3, "action/gripper_closedness_action": 1}

NO_PICTURE = "its pictures are placeholders: actions only"

OPENX_REST = (
    openx("taco_play", 15, {"action/rel_actions_world": 7}, "Franka playing in a kitchen: pose deltas and gripper",
          image="rgb_static"),
    openx("jaco_play", 10, CLOSEDNESS_ONLY, "Jaco 2: end-effector velocity and gripper",
          unverified="that the action is a velocity"),
    openx("viola", 20, CLOSEDNESS, "Franka in a toy kitchen: end-effector deltas and gripper", image="agentview_rgb"),
    openx(f"nyu_rot_dataset{LONG}", 3, {"action": 7}, "xArm: end-effector deltas, rotation and gripper; 84x84 images"),
    # The eighth value says that the episode ends.
    openx(f"utokyo_pr2_opening_fridge{LONG}", 10, {"action[:7]": 7}, "PR2: end-effector pose and gripper"),
    openx(f"utokyo_pr2_tabletop_manipulation{LONG}", 10, {"action[:7]": 7}, "PR2: end-effector pose and gripper"),
    openx(f"tokyo_u_lsmo{LONG}", 10, {"action": 7}, "Cobotta: end-effector position, Euler angles and gripper"),
    openx("berkeley_gnm_recon", 3, {"action": 2}, "Jackal off the road: next position", camera="on the robot"),
    openx(f"stanford_mask_vit{LONG}", 1, {"action": 5}, "Sawyer in a bin: displacement, yaw and gripper",
          unverified="hz: there is none, each step lasts until the arm rests"),
    openx("fmb", 10, {"action": 7}, "Franka assembling pegs", image="image_side_1", version="0.0.1",
          unverified="meaning of the 7 action values"),
    openx("cmu_playing_with_food", 10, {"action": 8}, "Franka cutting and picking food", version="1.0.0",
          unverified="meaning of the 8 action values"),
    openx("bridge_data_msr", 5, {"action": 7}, "WidowX, recorded as Bridge V2 is: deltas and gripper",
          image="image_0", version="0.0.1", unverified="hz and meaning of the action: those of Bridge V2"),
    replace(openx(f"utokyo_saytap{LONG}", 50, {"action": 12}, f"A1 walking: joint positions; {NO_PICTURE}",
                  camera="none", unverified="hz: five columns of its pattern are 0.1 s"), video_targets=False),
    replace(openx("eth_agent_affordances", 66.6, {"action": 6},
                  f"Franka opening ovens: end-effector velocity; {NO_PICTURE}", camera="none", unverified="hz"),
            video_targets=False),
)  # fmt: skip
