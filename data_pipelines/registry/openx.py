"""Open X-Embodiment: the datasets of the paper's mixture that are published as RLDS.

Sources: keys, dimensions, versions and the meaning of values are those of the public features (the tfds catalog's
pages, features.json of the published directories); rates are the control frequencies of the Open X-Embodiment dataset
sheet. What neither confirms is `unverified`.

The official release (reference sections 5.1 and 5.4) takes the first camera by name, all action fields
in sorted order, and a rate from a table of its own; where that goes wrong, `DIFFERS:` says how.
Flags that end an episode are not part of the action here; in the release they are, wherever they exist.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from data_pipelines.registry.openx_counts import EPISODES, LONG, mean_steps
from data_pipelines.registry.spec import DatasetSpec

BASE = {"action/base_displacement_vector": 2, "action/base_displacement_vertical_rotation": 1}
DELTA_POSE = {"action/world_vector": 3, "action/rotation_delta": 3}
CLOSEDNESS = DELTA_POSE | {"action/gripper_closedness_action": 1}


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
        mean_steps=mean_steps(name),
    )


SPOC = openx(
    # DIFFERS: the release has no rate for it (native 10 Hz).
    "spoc", 10, {"action": 9}, "Stretch in simulated houses: navigation and arm", camera="head",
    version="0.0.1",
)  # fmt: skip

OPENX = (
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
)  # fmt: skip
