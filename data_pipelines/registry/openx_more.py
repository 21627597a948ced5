"""Open X-Embodiment: the datasets outside the paper's mixture for which the release knows a rate.

Sources as in `openx`. Names in the release's table (reference section 5.4) that are not published RLDS datasets are
left out: 1x_humanoid, frodobot, epic_kitchen_originalres and the variants of robomimic.
"""

from __future__ import annotations

from data_pipelines.registry.openx import CLOSEDNESS, DELTA_POSE, LONG, openx

OPENX_MORE = (
    openx("bridge", 5, DELTA_POSE | {"action/open_gripper": 1},
          "WidowX, the mixture's own copy: deltas and gripper (tfds now gives this name to bridge_data_v2)"),
    openx(f"austin_sailor_dataset{LONG}", 20, {"action": 7}, "Franka: relative pose and gripper"),
    openx(f"austin_buds_dataset{LONG}", 20, {"action": 7}, "Franka: delta pose and gripper"),
    openx("utaustin_mutex", 20, {"action": 7}, "Franka: delta pose and gripper"),
    openx("imperialcollege_sawyer_wrist_cam", 10, {"action[:7]": 7},
          "Sawyer: deltas in the hand's frame and gripper; `image` is the same picture", image="wrist_image",
          camera="wrist, the only one"),
    openx(f"dlr_sara_pour{LONG}", 10, {"action": 7}, "SARA arm: absolute pose; zxy Euler angles",
          unverified="meaning of the 7th action value"),
    openx(f"dlr_edan_shared_control{LONG}", 5, {"action": 7}, "EDAN wheelchair arm: pose; zxy Euler angles",
          unverified="meaning of the 7th action value"),
    openx(f"stanford_robocook{LONG}", 5, {"action": 7}, "Franka shaping dough: velocities", image="image_1"),
    openx(f"stanford_kuka_multimodal_dataset{LONG}", 20, {"action": 4},
          "Kuka inserting pegs: position and gripper"),
    # DIFFERS: the release rounds 12.5 Hz to 12.
    openx(f"asu_table_top{LONG}", 12.5, {"action": 7}, "UR5: joint velocities and gripper"),
    openx(f"utokyo_xarm_pick_and_place{LONG}", 10, {"action": 7}, "xArm: absolute pose and gripper"),
    openx("uiuc_d3field", 1, {"action": 3}, "Kinova: displacement; slower than 2 Hz, every frame is used",
          image="image_1"),
    openx("robo_set", 5, {"action": 8}, "Franka (RoboAgent): joint targets and gripper", image="image_left",
          version="0.0.1"),
    # DIFFERS: the release keeps the 15th value, a termination flag.
    openx(f"nyu_franka_play_dataset{LONG}", 3, {"action[:14]": 14},
          "Franka: joint velocities (7), end-effector deltas (6), gripper"),
    openx("mimic_play", 15, {"action": 7}, "Franka: pose and gripper; cameras lie one level deeper",
          image="image/front_image_1", version="0.0.1"),
    openx(f"maniskill_dataset{LONG}", 20, {"action": 7},
          "simulated Panda: deltas in units of 0.1 m and 0.1 rad"),
    openx("berkeley_gnm_sac_son", 10, {"action": 2}, "TurtleBot among people: next position",
          camera="on the robot"),
    openx("berkeley_autolab_ur5", 5, CLOSEDNESS, "UR5: deltas; the gripper says -1, 0 or 1 for a change"),
    # DIFFERS: the release's table says 30 Hz.
    openx("aloha_mobile", 50, {"action": 16}, "Mobile ALOHA: two arms' joint targets (14), base (2)",
          image="cam_high", camera="head", version="0.0.1"),
)  # fmt: skip
