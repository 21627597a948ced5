"""The table of simulated robots, one row per dataset, and its look-up.

A row defines a dataset completely: the registry entry, the record's features and the simulation follow from it. The
rows are in the order of action sizes. Imports no simulator.
"""

from __future__ import annotations

from collections.abc import Sequence

from data_pipelines.simulators.spec import SimSpec, View
from hma_jax.config import require

S = SimSpec

TABLE_TOP = View(lookat=(-0.15, 0.0, 1.0), distance=1.7)
"""robosuite, one arm: from the side and above. Its own cameras show little of the robot."""

STANDING = View(lookat=(-0.25, 0.0, 1.0), distance=2.1)
"""robosuite, two arms and humanoids."""

HAND = View("vil_camera")

LIFT = "lift the red cube"
TABLE_ARM = (("position delta", 3), ("rotation delta", 3), ("gripper", 1))

META_WORLD = (
    "door-open-v3", "drawer-close-v3", "button-press-topdown-v3", "pick-place-v3", "push-v3", "reach-v3",
    "window-open-v3", "peg-insert-side-v3", "faucet-open-v3", "hammer-v3", "coffee-pull-v3", "dial-turn-v3",
    "basketball-v3", "sweep-v3", "plate-slide-v3", "handle-press-v3", "lever-pull-v3", "shelf-place-v3",
    "stick-push-v3", "disassemble-v3", "assembly-v3", "bin-picking-v3", "box-close-v3",
    "button-press-topdown-wall-v3", "button-press-v3", "button-press-wall-v3", "coffee-button-v3",
    "coffee-push-v3", "door-close-v3", "door-lock-v3", "door-unlock-v3", "hand-insert-v3", "drawer-open-v3",
    "faucet-close-v3", "handle-press-side-v3", "handle-pull-side-v3", "handle-pull-v3",
    "peg-unplug-side-v3", "pick-out-of-hole-v3", "pick-place-wall-v3", "plate-slide-back-v3",
    "plate-slide-back-side-v3", "plate-slide-side-v3", "push-back-v3", "push-wall-v3", "reach-wall-v3",
    "soccer-v3", "stick-pull-v3", "sweep-into-v3", "window-close-v3",
)  # fmt: skip
"""All fifty tasks; those that look most different come first, since short datasets have only the first ones."""


def _lift(name: str, robot: str, package: str = "robosuite", **more) -> SimSpec:
    """An arm that lifts a cube, commanded at its hand."""
    note = "Robomimic's task with another arm"
    given = {"expert": "lift script", "note": note, "tau": 1.0, "gain": 0.35, "noise": 0.25}
    return S(
        f"robosuite_{name}_lift", package, "robosuite", ("Lift",), TABLE_ARM, hz=20, view=TABLE_TOP,
        kwargs={"robots": robot}, instruction=LIFT, success=True, **given | more,
    )  # fmt: skip


# fmt: off
EMBODIMENTS: tuple[SimSpec, ...] = (
    # --- 2 and 3 -------------------------------------------------------------------------
    S("pusht", "gym-pusht", "pusht", ("PushT",), (("target position", 2),), hz=10, view=View("top"),
      instruction="push the T onto its outline", expert="push script", success=True, gain=0.5,
      noise=0.15),
    S("pointmaze_ball", "gymnasium-robotics", "gymnasium", ("PointMaze_Open-v3",), (("force", 2),), hz=20,
      repeat=5, view=View(lookat=(0, 0, 0), distance=9.5, azimuth=90, elevation=-89),
      kwargs={"continuing_task": True}, instruction="go to the mark", expert="straight line",
      success=True),
    S("dmc_reacher", "dm-control", "dm_control", ("reacher-easy",), (("torque", 2),), hz=25, repeat=2,
      view=View("fixed"), instruction="reach the ball", tau=1.0),
    S("dmc_finger", "dm-control", "dm_control", ("finger-spin",), (("torque", 2),), hz=25, repeat=2,
      view=View("cam0"), instruction="spin the body"),
    S("dmc_ball_in_cup", "dm-control", "dm_control", ("ball_in_cup-catch",), (("force", 2),), hz=25,
      repeat=2, view=View("cam0"), instruction="catch the ball in the cup"),
    S("mujoco_swimmer", "gymnasium", "gymnasium", ("Swimmer-v5",), (("torque", 2),), hz=25,
      view=View(follow="torso", distance=4.5, azimuth=90, elevation=-60), instruction="swim", tau=1.0,
      gain=0.9),
    S("mujoco_hopper", "gymnasium", "gymnasium", ("Hopper-v5",), (("torque", 3),), hz=25, repeat=5,
      view=View("track"), instruction="hop"),
    # --- 4 -------------------------------------------------------------------------------
    S("metaworld_sawyer", "metaworld", "metaworld", META_WORLD, (("position delta", 3), ("gripper", 1)),
      hz=20, repeat=4, view=View("corner2", turned=True), expert="shipped policies", success=True,
      seconds=(9.0, 11.0), tau=0.8, note="fifty tasks; 80 Hz steps in fours"),
    S("metaworld_drawer", "metaworld", "metaworld", ("drawer-open-v3",), (("position delta", 3), ("gripper", 1)),
      hz=20, repeat=4, view=View(lookat=(0.0, 0.7, 0.12), distance=0.9, azimuth=160), expert="shipped policies",
      success=True, tau=0.8, note="one task, seen from near: policies are judged on it"),
    S("fetch", "gymnasium-robotics", "gymnasium", ("FetchReach-v4", "FetchPush-v4",
      "FetchPickAndPlace-v4"), (("position delta", 3), ("gripper", 1)), hz=25, view=View(lookat=(1.3,
      0.75, 0.55), distance=1.4, azimuth=132, elevation=-14), expert="fetch script", success=True,
      gain=0.2, noise=0.5),
    S("robosuite_panda_position", "robosuite", "robosuite", ("Lift",), (("position delta", 3), ("gripper",
      1)), hz=20, view=TABLE_TOP, kwargs={"robots": "Panda", "part": "OSC_POSITION"}, instruction=LIFT,
      expert="lift script", success=True, tau=1.0, gain=0.35, noise=0.25),
    S("so101", "lerobot-env-so101", "so101", ("SO101PickPlace",), (("position delta", 3), ("gripper", 1)),
      hz=10, view=View(lookat=(0.18, 0, 0.08), distance=0.75, azimuth=145, elevation=-28),
      instruction="put the cube onto the mark", expert="shipped script", success=True, tau=0.8,
      noise=0.25),
    S("dmc_hopper", "dm-control", "dm_control", ("hopper-hop",), (("torque", 4),), hz=25, repeat=2,
      view=View("cam0"), instruction="hop forward"),
    # --- 5 and 6 -------------------------------------------------------------------------
    S("ogbench_ur5e", "ogbench", "gymnasium", ("cube-single-v0", "cube-double-v0", "scene-v0",
      "puzzle-3x3-v0"), (("position delta", 3), ("yaw delta", 1), ("gripper delta", 1)), hz=20,
      view=View(lookat=(0.3, 0, 0.15), distance=1.35, azimuth=145, elevation=-28), kwargs={"mode":
      "data_collection", "terminate_at_goal": False, "visualize_info": False},
      instruction="bring the object where it belongs", expert="oracle", success=True, tau=0.8),
    S("dmc_manipulator", "dm-control", "dm_control", ("manipulator-bring_ball",), (("torque", 5),), hz=25,
      repeat=4, view=View("fixed"), instruction="bring the ball"),
    S("dmc_fish", "dm-control", "dm_control", ("fish-swim",), (("torque", 5),), hz=25,
      view=View("tracking_top"), instruction="swim to the ball", gain=0.9),
    S("robosuite_panda_wipe", "robosuite", "robosuite", ("Wipe",), (("position delta", 3),
      ("rotation delta", 3)), hz=20, view=TABLE_TOP, kwargs={"robots": "Panda"},
      instruction="wipe the table", success=True, tau=1.0, gain=0.35),
    S("dmc_walker", "dm-control", "dm_control", ("walker-walk",), (("torque", 6),), hz=20, repeat=2,
      view=View("side"), instruction="walk"),
    S("dmc_cheetah", "dm-control", "dm_control", ("cheetah-run",), (("torque", 6),), hz=25, repeat=4,
      view=View("side"), instruction="run"),
    # --- 7 -------------------------------------------------------------------------------
    _lift("panda", "Panda", note="Robomimic's task"),
    _lift("sawyer", "Sawyer"),
    _lift("iiwa", "IIWA"),
    _lift("kinova3", "Kinova3"),
    _lift("ur5e", "UR5e"),
    _lift("jaco", "Jaco", expert="", note="its three fingers need another script; wanders"),
    _lift("vx300s", "VX300S", expert="", package="robosuite-models", note="wanders"),
    _lift("z1", "Z1", expert="", package="robosuite-models", note="wanders"),
    # --- 8 to 11 -------------------------------------------------------------------------
    S("robosuite_panda_joint_velocity", "robosuite", "robosuite", ("Door",), (("joint velocity", 7),
      ("gripper", 1)), hz=20, view=TABLE_TOP, kwargs={"robots": "Panda", "part": "JOINT_VELOCITY"},
      instruction="open the door", success=True, tau=1.0, gain=0.5),
    S("robosuite_arx5", "robosuite-models", "robosuite", ("Lift",), (*TABLE_ARM[:2], ("fingers", 2)),
      hz=20, view=TABLE_TOP, kwargs={"robots": "Arx5"}, instruction=LIFT, success=True, tau=1.0,
      gain=0.35),
    S("mujoco_ant", "gymnasium", "gymnasium", ("Ant-v5",), (("torque", 8),), hz=20, view=View("track"),
      instruction="walk"),
    S("franka_kitchen", "gymnasium-robotics", "gymnasium", ("FrankaKitchen-v1",), (("joint velocity",
      9),), hz=12.5, view=View(lookat=(-0.2, 0.5, 2.0), distance=2.2, azimuth=70, elevation=-35),
      instruction="open and switch on what you can", success=True, tau=1.0, gain=0.7),
    S("dmc_jaco", "dm-control", "dm_control", ("manipulation/reach_site_features",), (("joint velocity",
      6), ("fingers", 3)), hz=25, view=View(lookat=(0, 0, 0.35), distance=1.9, azimuth=140,
      elevation=-25), instruction="reach the mark", tau=1.0),
    S("robosuite_spot_arm", "robosuite", "robosuite", ("Lift",), (("arm and base", 10),), hz=20,
      view=STANDING, kwargs={"robots": "SpotWithArmFloating"}, instruction=LIFT, success=True, tau=1.0,
      gain=0.35),
    S("robosuite_kinova3_mobile", "robosuite-models", "robosuite", ("Lift",), (*TABLE_ARM,
      ("base and torso", 4)), hz=20, view=STANDING, kwargs={"robots": "Kinova3Omron"}, instruction=LIFT,
      success=True, tau=1.0, gain=0.35),
    # --- 12 to 14 ------------------------------------------------------------------------
    S("robosuite_panda_dexterous", "robosuite", "robosuite", ("Lift",), (*TABLE_ARM[:2], ("fingers", 6)),
      hz=20, view=TABLE_TOP, kwargs={"robots": "PandaDexRH"}, instruction=LIFT, success=True, tau=1.0,
      gain=0.35),
    S("dmc_quadruped", "dm-control", "dm_control", ("quadruped-walk",), (("joint target", 12),), hz=25,
      repeat=2, view=View("x"), instruction="walk"),
    S("aloha", "gym-aloha", "aloha", ("transfer_cube", "insertion"), (("left joints", 6), ("left gripper",
      1), ("right joints", 6), ("right gripper", 1)), hz=25, repeat=2, view=View(lookat=(0, 0.5, 0.15),
      distance=1.7, azimuth=90, elevation=-40), success=True, tau=1.5, gain=0.8,
      note="absolute joint angles"),
    S("robosuite_baxter", "robosuite", "robosuite", ("TwoArmLift",), (("right arm delta", 6),
      ("right gripper", 1), ("left arm delta", 6), ("left gripper", 1)), hz=20, view=STANDING,
      kwargs={"robots": "Baxter"}, instruction="lift the pot", success=True, tau=1.0, gain=0.35),
    S("robosuite_two_pandas", "robosuite", "robosuite", ("TwoArmLift",), (("first arm delta", 6),
      ("first gripper", 1), ("second arm delta", 6), ("second gripper", 1)), hz=20, view=STANDING,
      kwargs={"robots": ["Panda", "Panda"]}, instruction="lift the pot", success=True, tau=1.0,
      gain=0.35),
    S("robosuite_yumi", "robosuite-models", "robosuite", ("TwoArmLift",), (("right arm delta", 6),
      ("right gripper", 1), ("left arm delta", 6), ("left gripper", 1)), hz=20, view=STANDING,
      kwargs={"robots": "Yumi"}, instruction="lift the pot", success=True, tau=1.0, gain=0.35),
    S("dmc_swimmer15", "dm-control", "dm_control", ("swimmer-swimmer15",), (("torque", 14),), hz=1 / 0.06,
      repeat=2, view=View("tracking1"), instruction="swim to the ball", tau=1.0, gain=0.9),
    # --- 17 and more ---------------------------------------------------------------------
    S("mujoco_humanoid", "gymnasium", "gymnasium", ("Humanoid-v5",), (("torque", 17),), hz=1 / 0.045,
      repeat=3, view=View("track"), instruction="walk", note="falls, and moves on the floor"),
    S("shadow_hand", "gymnasium-robotics", "gymnasium", ("HandReach-v3",), (("joint target", 20),), hz=25,
      view=View(lookat=(1.0, 0.88, 0.2), distance=0.75, azimuth=55, elevation=-25),
      instruction="touch the marks with the fingertips", success=True, gain=0.8, tau=0.8),
    S("robosuite_tiago", "robosuite", "robosuite", ("TwoArmLift",), (("arms, grippers, base", 20),),
      hz=20, view=STANDING, kwargs={"robots": "Tiago"}, instruction="lift the pot", success=True, tau=1.0,
      gain=0.35),
    S("dmc_humanoid", "dm-control", "dm_control", ("humanoid-walk",), (("torque", 21),), hz=20, repeat=2,
      view=View("side"), instruction="walk", note="falls, and moves on the floor"),
    S("adroit_pen", "gymnasium-robotics", "gymnasium", ("AdroitHandPen-v1",), (("joint target", 24),),
      hz=25, repeat=4, view=View(lookat=(0, -0.15, 0.25), distance=0.7, azimuth=-45, elevation=-40),
      instruction="turn the pen as shown", success=True, gain=0.7, tau=0.8),
    S("robosuite_gr1", "robosuite", "robosuite", ("TwoArmLift",), (("arms and hands", 24),), hz=20,
      view=STANDING, kwargs={"robots": "GR1ArmsOnly", "controller": "BASIC"}, instruction="lift the pot",
      success=True, tau=1.0, gain=0.35),
    S("adroit_hammer", "gymnasium-robotics", "gymnasium", ("AdroitHandHammer-v1",), (("wrist and arm", 2),
      ("joint target", 24)), hz=25, repeat=4, view=HAND, instruction="hammer the nail in", success=True,
      gain=0.6, tau=0.8),
    S("robosuite_g1", "robosuite-models", "robosuite", ("TwoArmLift",), (("arms and hands", 26),), hz=20,
      view=View(lookat=(-0.4, 0, 1.05), distance=1.4, azimuth=165, elevation=-35),
      kwargs={"robots": "G1ArmsOnly"}, instruction="lift the pot", success=True, tau=1.0, gain=0.8),
    S("adroit_door", "gymnasium-robotics", "gymnasium", ("AdroitHandDoor-v1",), (("arm", 4),
      ("joint target", 24)), hz=25, repeat=4, view=HAND, instruction="open the door", success=True,
      gain=0.6, tau=0.8),
    S("adroit_relocate", "gymnasium-robotics", "gymnasium", ("AdroitHandRelocate-v1",), (("arm", 6),
      ("joint target", 24)), hz=25, repeat=4, view=HAND, instruction="bring the ball to the mark",
      success=True, gain=0.3, tau=0.8),
    S("dmc_dog", "dm-control", "dm_control", ("dog-walk",), (("muscle", 38),), hz=1 / 0.045, repeat=3,
      view=View("y-axis"), instruction="walk", note="falls, and moves on the floor"),
    S("dmc_humanoid_cmu", "dm-control", "dm_control", ("humanoid_CMU-walk",), (("torque", 56),), hz=25,
      repeat=2, view=View("side"), instruction="walk", note="falls, and moves on the floor"),
)
# fmt: on

_BY_NAME = {spec.name: spec for spec in EMBODIMENTS}


def select(names: Sequence[str] | None) -> tuple[SimSpec, ...]:
    """Rows by name, in the given order; all of them for None. Raises ConfigError for unknown names."""
    if names is None:
        return EMBODIMENTS
    unknown = [name for name in names if name not in _BY_NAME]
    require(not unknown, f"unknown simulator(s) {', '.join(unknown)}; the table has {', '.join(_BY_NAME)}")
    return tuple(_BY_NAME[name] for name in names)


def get_embodiment(name: str) -> SimSpec:
    """The row called `name`. Raises ConfigError if there is none."""
    (spec,) = select([name])
    return spec
