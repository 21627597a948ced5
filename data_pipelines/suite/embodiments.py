"""The forty embodiments of the suite: the one table from which everything else follows.

The order matters: scaling over datasets takes the first 5, 10, 20, 40, so each prefix is
diverse, and the first five (the common evaluation set) have much data and strong actions.
Parts used more than once come first; angles of bodies are degrees, of controls radians.
"""

from __future__ import annotations

import math

from data_pipelines.suite.bodies import Body, attach, join
from data_pipelines.suite.controls import Drive, JointRate, JointTarget, ToolRate, ToolTarget
from data_pipelines.suite.robots import arm, finger, gantry, gripper, hand, rover
from data_pipelines.suite.spec import Camera, EmbodimentSpec, Look
from data_pipelines.suite.tasks import Carry, Push, Reach

PIXEL = 1 / 32  # world units per pixel of a 64-pixel image
DEGREE = math.pi / 180
MILLIMETRE = 1 / 500  # where a table is 1 m wide
TICK = 2 * math.pi / 4096  # one encoder step of a hobby servo, radians


def _j(first: int, count: int) -> tuple[int, ...]:
    return tuple(range(first, first + count))


def _pair(*lengths: float, tip: Body | None = None, tips: int = 1, radius: float = 0.13, **kw) -> Body:
    """Two arms from the lower corners, each with `tips` copies of `tip` as its hand."""
    arms = []
    for side in (-1, 1):
        one = arm(lengths, base=(0.55 * side, -0.7), heading=90 + 12 * side, radius=radius, swing=55, **kw)
        arms.append(one if tip is None else attach(one, *(tip,) * tips))
    return join(*arms)


def _claw(fingers: int, phalanges: int, length: float = 0.16) -> Body:
    """Fingers that fan out from a wrist."""
    palm = Body((), (), (), ())
    spread = [(i / (fingers - 1) * 2 - 1) for i in range(fingers)]
    parts = [
        finger(phalanges, angle=0.7 * s, length=length, radius=0.055, curl=(-0.7, 0.7), tool=False, paint=2)
        for s in spread
    ]
    return join(palm, *parts)


SAND = Look(floor=(196, 188, 172), robot=((52, 84, 150), (226, 122, 52), (70, 70, 80)))
SLATE = Look(floor=(84, 98, 108), outside=(60, 66, 72), robot=((238, 208, 88), (240, 226, 150), (220, 90, 70)))
MINT = Look(floor=(168, 198, 180), robot=((110, 52, 110), (60, 60, 72), (240, 232, 210)))
NIGHT = Look(floor=(50, 54, 66), outside=(34, 36, 44), robot=((206, 92, 84), (232, 166, 96), (232, 228, 220)))
CHALK = Look(floor=(222, 222, 218), outside=(190, 190, 190), robot=((44, 48, 54), (190, 56, 50), (236, 170, 60)))
WOOD = Look(
    floor=(186, 146, 106), outside=(214, 210, 204), robot=((62, 68, 76), (52, 116, 170), (240, 240, 236)),
    pattern="table",
)
SKY = Look(floor=(150, 180, 206), outside=(226, 228, 224), robot=((236, 120, 60), (70, 76, 96), (250, 236, 200)), pattern="slope")
ROAD = Look(floor=(118, 146, 96), outside=(108, 108, 112), robot=((222, 66, 62), (250, 236, 160), (36, 36, 40)), pattern="stripe")


def _with(look: Look, **changes) -> Look:
    from dataclasses import replace

    return replace(look, **changes)


E = EmbodimentSpec

EMBODIMENTS: tuple[EmbodimentSpec, ...] = (
    E("two_link_arm_joint_targets", "arm", hz=5, episodes=280, look=SAND,
      body=arm((0.52, 0.42), radius=0.19, bend=150, swing=170),
      controls=(JointTarget("joints", _j(0, 2)),),
      task=Reach(radius=0.15), instruction="touch the mark"),
    E("disc_pusher_delta_pixels", "pusher", hz=4, episodes=320, look=SLATE,
      body=gantry(size=0.28, speed=0.95),
      controls=(JointRate("xy", _j(0, 2), unit=PIXEL, convention="delta"),),
      task=Push(objects=2), instruction="push the disc onto the mark"),
    E("rover_wheel_speeds", "rover", hz=3, episodes=200, look=_with(MINT, distractors=1),
      body=rover(size=(0.32, 0.26), speed=1.0),
      controls=(Drive("wheels", "wheels"),),
      task=Reach(radius=0.2), instruction="drive to the mark", cameras=(Camera(rotate=20),)),
    E("two_grippers_joint_targets", "bimanual", hz=6, episodes=140, look=WOOD,
      body=_pair(0.45, 0.35, 0.12, tip=gripper(0.22), radius=0.15),
      controls=(JointTarget("joints", _j(0, 8), unit=DEGREE * 30),),
      task=Carry(size=0.16, objects=2), instruction="put the disc on the mark"),
    E("gantry_gripper_normalised", "gripper", hz=8, episodes=120, look=NIGHT,
      body=attach(gantry(turns=True, size=0.24, bar=0.3, reach=0.65), gripper(0.34, 0.08)),
      controls=(JointTarget("pose", _j(0, 2), unit=0.65), JointTarget("turn", (2,), unit=math.pi / 2), JointTarget("grip", (3,))),
      task=Carry(size=0.17, objects=2), instruction="carry the disc to the mark",
      cameras=(Camera(), Camera("wrist_image", zoom=1.4, follow=1))),
    E("three_link_arm_tool_delta_mm", "arm", hz=5, episodes=90, look=CHALK,
      body=attach(arm((0.55, 0.45, 0.15), base=(0, -0.75), radius=0.17, swing=80), gripper(0.26, 0.07)),
      controls=(ToolRate("xy", unit=MILLIMETRE, speed=1.0), JointTarget("grip", (3,))),
      task=Carry(objects=3, size=0.16), instruction="bring the disc to the mark", cameras=(Camera(flip=True, zoom=0.95),)),
    E("five_finger_hand_tendons", "hand", hz=10, episodes=60, look=SKY,
      body=hand(5, 2, length=0.42, radius=0.12, coupled=True),
      controls=(JointTarget("tendons", _j(0, 5), unit=0.8),),
      task=Reach(radius=0.22), instruction="make the shown grasp"),
    E("holonomic_base_velocity", "rover", hz=4, episodes=80, look=_with(ROAD, distractors=2),
      body=rover(size=(0.3, 0.3), speed=1.0, round_=True),
      controls=(Drive("velocity", "holonomic", unit=0.5, turn_unit=1.5),),
      task=Push(objects=2), instruction="shove the disc onto the mark", cameras=(Camera(rotate=-90),)),
    E("mobile_arm_twist_and_joints", "mobile_arm", hz=10, episodes=48, dict_actions=True, look=_with(SAND, floor=(150, 140, 170)),
      body=attach(rover(size=(0.3, 0.24), reach=0.5), attach(arm((0.4, 0.3), heading=0, radius=0.13, swing=100), gripper(0.22)), at=2),
      controls=(Drive("base_twist", "twist", turn_unit=0.5), JointTarget("arm_joints", _j(3, 2)), JointTarget("gripper", (5,), unit=0.1)),
      task=Carry(size=0.16), instruction="fetch the disc and take it to the mark",
      cameras=(Camera(zoom=0.9), Camera("base_image", zoom=0.8, follow=2))),
    E("humanoid_hands_joint_targets", "bimanual", hz=10, episodes=40, look=MINT,
      body=_pair(0.2, 0.18, 0.16, 0.14, 0.13, 0.12, 0.1, tip=_claw(4, 2, 0.17), radius=0.14, taper=0.95, bend=40),
      controls=(JointTarget("joints", _j(0, 30)),),
      task=Reach(radius=0.35), instruction="reach both marks"),
)
