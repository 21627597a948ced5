"""Open X-Embodiment: the datasets that are published as RLDS.

Sources: keys, dimensions, versions and the meaning of values are those of the public features (the tfds catalog's
pages, features.json of the published directories); rates are the control frequencies of the Open X-Embodiment dataset
sheet. What neither confirms is `unverified`.

The official release (reference sections 5.1 and 5.4) takes the first camera by name, all action fields
in sorted order, and a rate from a table of its own; where that goes wrong, `DIFFERS:` says how.
Flags that end an episode are not part of the action here; in the release they are, wherever they exist.

Left out of the tfds catalogue are datasets whose camera and action cannot be read together step by step: tidybot (its
action is text), vima (pictures of varying number), robot_vqa (questions and answers) and robo_ai_u_r5e (nothing says
what its action is). Left out of the release's table of rates are names that are not published RLDS datasets:
1x_humanoid, frodobot, epic_kitchen_originalres and the variants of robomimic.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from data_pipelines.registry.spec import DatasetSpec

BASE = {"action/base_displacement_vector": 2, "action/base_displacement_vertical_rotation": 1}
DELTA_POSE = {"action/world_vector": 3, "action/rotation_delta": 3}
CLOSEDNESS = DELTA_POSE | {"action/gripper_closedness_action": 1}
CLOSEDNESS_ONLY = {"action/world_vector": 3, "action/gripper_closedness_action": 1}

NO_PICTURE = "its pictures are placeholders: actions only"

LONG = "_converted_externally_to_rlds"

EPISODES: dict[str, int] = {
    "aloha_mobile": 276, f"asu_table_top{LONG}": 110, f"austin_buds_dataset{LONG}": 50,
    f"austin_sailor_dataset{LONG}": 240, f"austin_sirius_dataset{LONG}": 559, "bc_z": 39_350,
    "berkeley_autolab_ur5": 896, "berkeley_cable_routing": 1_482, "berkeley_fanuc_manipulation": 415,
    "berkeley_gnm_cory_hall": 7_331, "berkeley_gnm_recon": 11_834, "berkeley_gnm_sac_son": 2_955,
    f"berkeley_mvp{LONG}": 480, f"berkeley_rpt{LONG}": 908, "bridge": 25_460, "bridge_data_msr": 822,
    f"cmu_franka_exploration_dataset{LONG}": 199, "cmu_play_fusion": 576, "cmu_playing_with_food": 4_200,
    "cmu_stretch": 135, "columbia_cairlab_pusht_real": 122, "conq_hose_manipulation": 113,
    f"dlr_edan_shared_control{LONG}": 104, f"dlr_sara_grid_clamp{LONG}": 107, f"dlr_sara_pour{LONG}": 100,
    "dobbe": 5_208, "droid": 95_658, "eth_agent_affordances": 118, "fmb": 8_611, "fractal20220817_data": 87_212,
    f"furniture_bench_dataset{LONG}": 5_100, f"iamlab_cmu_pickup_insert{LONG}": 631,
    "imperialcollege_sawyer_wrist_cam": 170, "io_ai_tech": 3_847, "jaco_play": 976,
    f"kaist_nonprehensile{LONG}": 201, "kuka": 580_392, "language_table": 442_226,
    f"maniskill_dataset{LONG}": 30_213, "mimic_play": 378, "nyu_door_opening_surprising_effectiveness": 435,
    f"nyu_franka_play_dataset{LONG}": 365, f"nyu_rot_dataset{LONG}": 14, "plex_robosuite": 402,
    "qut_dexterous_manpulation": 200, "robo_net": 82_775, "robo_set": 18_250, "roboturk": 1_796,
    "spoc": 212_043, "spoc_robot": 212_043, f"stanford_hydra_dataset{LONG}": 570,
    f"stanford_kuka_multimodal_dataset{LONG}": 3_000, f"stanford_mask_vit{LONG}": 9_109,
    f"stanford_robocook{LONG}": 2_460, "taco_play": 3_242, f"tokyo_u_lsmo{LONG}": 50, "toto": 902,
    f"ucsd_kitchen_dataset{LONG}": 150, f"ucsd_pick_and_place_dataset{LONG}": 1_355, "uiuc_d3field": 192,
    f"usc_cloth_sim{LONG}": 800, "utaustin_mutex": 1_500, f"utokyo_pr2_opening_fridge{LONG}": 64,
    f"utokyo_pr2_tabletop_manipulation{LONG}": 192, f"utokyo_saytap{LONG}": 20,
    f"utokyo_xarm_bimanual{LONG}": 64, f"utokyo_xarm_pick_and_place{LONG}": 92, "viola": 135,
}  # fmt: skip
"""Number of episodes of the split `train`, by the dataset_info.json of the published directories, as the tfds catalogue
shows it too. No public file says how long the episodes are."""

STEPS: dict[str, int] = {"fractal20220817_data": 3_786_400, "language_table": 7_045_476}
"""Number of steps of all episodes together, where that is published."""


def openx(
    name: str,
    hz: float,
    action: Mapping[str, int],
    note: str,
    *,
    image: str = "image",
    camera: str = "fixed",
    version: str = "0.1.0",
    unverified: str = "",
    angles: tuple[int, ...] = (),
) -> DatasetSpec:
    """An entry in short form: `action` maps keys to dimensions, `image` is a field of the observation.

    `angles`, in radians, are given as sine and cosine.
    """
    return DatasetSpec(
        name,
        image_key=f"observation/{image}",
        action_keys=tuple(action),
        action_dims=tuple(action.values()),
        hz=hz,
        camera=camera,
        note=note,
        version=version,
        unverified=unverified,
        angles=angles,
        angle_form="sine_cosine" if angles else "as_recorded",
        episodes=EPISODES.get(name, 0),
        mean_steps=round(STEPS[name] / EPISODES[name], 1) if name in STEPS else 0.0,
    )


SPOC = openx(
    # DIFFERS: the release has no rate for it (native 10 Hz).
    "spoc", 10, {"action": 9}, "Stretch in simulated houses: navigation and arm", camera="head",
    version="0.0.1",
)  # fmt: skip

OPENX = (
    # --- the paper's mixture ----------------------------------------------------------------------
    # DIFFERS: the release's rate table calls it "bridge", so it runs at native 5 Hz there.
    openx("bridge_data_v2", 5, {"action": 7},
          "WidowX: end-effector deltas and gripper; image_1..3 can be blank",
          image="image_0", version="0.0.1"),
    # DIFFERS: the release appends the three flags of terminate_episode (13 values).
    openx("fractal20220817_data", 3, BASE | CLOSEDNESS,
          "Google robot (RT-1): base, end-effector deltas, gripper; the base hardly moves", camera="head"),
    # DIFFERS: the release's table says 2 Hz, so that every native 10 Hz frame is used.
    openx("language_table", 10, {"action": 2}, "xArm pushing blocks: planar deltas; text as code points",
          image="rgb"),
    openx(f"ucsd_pick_and_place_dataset{LONG}", 3, {"action": 4}, "xArm: gripper velocity and torque"),
    openx(f"kaist_nonprehensile{LONG}", 10, {"action": 20},
          "Franka pushing: pose residuals (6), joint gains (7), damping ratios (7)"),
    # DIFFERS: wherever [:n] follows a field, the release keeps the rest too: a termination flag.
    openx(f"ucsd_kitchen_dataset{LONG}", 2, {"action[:7]": 7}, "xArm: absolute pose and gripper"),
    # DIFFERS: the release has no rate for it (native 10 Hz).
    openx(f"utokyo_xarm_bimanual{LONG}", 10, {"action": 14}, "two xArms: absolute poses and grippers"),
    openx(f"stanford_hydra_dataset{LONG}", 10, {"action": 7}, "Franka: end-effector deltas and gripper"),
    openx(f"austin_sirius_dataset{LONG}", 20, {"action": 7},
          "Franka: relative pose and gripper; 84x84 images"),
    # DIFFERS: the release has no rate for it (native 10 Hz).
    openx("berkeley_fanuc_manipulation", 10, {"action": 6}, "Fanuc Mate: end-effector deltas, no gripper"),
    openx(f"berkeley_mvp{LONG}", 5, {"action": 8}, "xArm: joint deltas and binary gripper",
          image="hand_image", camera="wrist, the only one"),
    openx(f"berkeley_rpt{LONG}", 30, {"action": 8}, "Franka: joint deltas and binary gripper",
          image="hand_image", camera="wrist, the only one"),
    openx("cmu_play_fusion", 5, {"action[:8]": 8}, "Franka: delta pose (quaternion) and gripper"),
    openx(f"iamlab_cmu_pickup_insert{LONG}", 20, {"action": 8},
          "Franka: absolute pose (quaternion) and gripper"),
    # DIFFERS: the release has no rate for it (native 30 Hz).
    openx("qut_dexterous_manpulation", 30, {"action": 8}, "Franka tabletop tasks (the name is spelt so)",
          unverified="meaning of the 8 action values"),
    openx("robo_net", 1, {"action": 5},
          "seven robots: gripper deltas; slower than 2 Hz, every frame is used"),
    openx(f"furniture_bench_dataset{LONG}", 10, {"action": 8}, "Franka: delta pose (quaternion) and gripper"),
    # DIFFERS: the release has no rate for it (native 10 Hz).
    openx(f"dlr_sara_grid_clamp{LONG}", 10, {"action": 7}, "SARA arm: absolute pose; zxy Euler angles",
          unverified="meaning of the 7th action value"),
    # DIFFERS: the release has no rate for it (native 10 Hz).
    openx("cmu_stretch", 10, {"action[:7]": 7}, "Stretch: end-effector pose and binary gripper"),
    SPOC,
    # DIFFERS: the release appends terminate_episode (8 values).
    openx("columbia_cairlab_pusht_real", 10, CLOSEDNESS,
          "UR5 pushing a T: planar, so four values never move"),
    # DIFFERS: the release takes `action` and floors 15 / 2 (2.14 Hz). Roll lies about ±π, where it jumps.
    openx("droid", 15, {"action_dict/cartesian_position": 6, "action_dict/gripper_position": 1},
          "Franka in many places: absolute end-effector pose and gripper", image="exterior_image_1_left",
          camera="exterior, fixed", version="1.0.1", angles=(3, 5)),
    # DIFFERS: the release appends terminate_episode (8 values).
    openx("toto", 30, DELTA_POSE | {"action/open_gripper": 1},
          "Franka scooping and pouring: pose and gripper"),
    # DIFFERS: the release has no rate for it (native rate).
    openx("io_ai_tech", 30, {"action": 7}, "a human hand picking and placing: pose", version="0.0.1",
          unverified="hz (the sheet says 30, converters of others 3); meaning of the 7 action values"),
    openx("conq_hose_manipulation", 30, {"action": 7}, "Spot dragging a hose: hand pose and gripper",
          image="frontleft_fisheye_image", camera="body, fisheye", version="0.0.1",
          unverified="meaning of the 7 action values"),
    # DIFFERS: the release has no rate for it (native rate).
    openx("dobbe", 3.75, {"action": 7}, "Stretch and a hand-held stick in homes: deltas and gripper",
          image="wrist_image", camera="wrist, the only one", version="0.0.1",
          unverified="hz (recorded at 30, thinned to 3.75 by its authors)"),
    # DIFFERS: the release has no rate for it (native 5 Hz).
    openx("berkeley_gnm_cory_hall", 5, {"action": 2}, "RC car in corridors: next position",
          camera="on the car"),
    # DIFFERS: the release has no rate for it (native 20 Hz).
    openx("plex_robosuite", 20, {"action": 7}, "simulated Panda: pose deltas and gripper", version="0.0.1"),
    openx(f"usc_cloth_sim{LONG}", 10, {"action": 4},
          "simulated cloth: picker goal and command; 32x32 images"),
    # DIFFERS: the release appends terminate_episode (7 values).
    openx("berkeley_cable_routing", 10, DELTA_POSE, "Franka: velocities; of the rotation only z moves"),
    # DIFFERS: the release takes the next 10 actions of each of three fields (30 + 10 + 30 values), and so gives every
    # step its future actions; the action of a step is the first of each field.
    openx("bc_z", 10,
          {"action/future/xyz_residual[:3]": 3, "action/future/axis_angle_residual[:3]": 3,
           "action/future/target_close[:1]": 1},
          "Google robot (BC-Z): pose residuals, absolute gripper target", camera="head"),
    # DIFFERS: the release's table says 2 Hz, so that every native 10 Hz frame is used; it also keeps the
    # three flags of terminate_episode and three values of a base that the robot does not have.
    openx("kuka", 10, CLOSEDNESS, "Kuka iiwa (QT-Opt), mostly failed grasps: `success` marks the others"),
    # DIFFERS: the release appends terminate_episode (8 values).
    openx("roboturk", 10, CLOSEDNESS, "Sawyer by remote hands: end-effector deltas and gripper",
          image="front_rgb"),
    # DIFFERS: the release appends terminate_episode (8 values).
    openx("nyu_door_opening_surprising_effectiveness", 3, CLOSEDNESS,
          "hand-held reacher and Stretch at doors: velocities and gripper", camera="wrist, the only one"),
    # In the release's list of thirty, not in its forty.
    openx(f"cmu_franka_exploration_dataset{LONG}", 10, {"action[:7]": 7}, "Franka: pose and gripper",
          image="highres_image"),
    # tfds calls it so.
    replace(SPOC, name="spoc_robot"),
    # --- outside it, with a rate in the release's table -------------------------------------------
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
    # --- the rest of the tfds catalogue -----------------------------------------------------------
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
