"""Families with grippers: on a gantry, on an arm, on two arms, and on a driving base (unseen)."""

from __future__ import annotations

import math

from data_pipelines.suite.bodies import Body, attach
from data_pipelines.suite.controls import Drive, JointRate, JointTarget
from data_pipelines.suite.families.table import DEGREE, METRE, PIXEL, TICK, Row, family, joints
from data_pipelines.suite.palettes import CHALK, CLAY, MINT, NIGHT, PLUM, ROAD, SAND, SKY, SLATE, WOOD
from data_pipelines.suite.robots import arm, gantry, gripper, rover, two_arms
from data_pipelines.suite.spec import Camera, Physics
from data_pipelines.suite.tasks import Carry

# fmt: off


def head(size: float, fingers: float, rail: bool = False) -> Body:
    return attach(gantry(turns=True, size=size, reach=0.62, rail=rail, touches=False), gripper(fingers, 0.1))


def pose(unit: float, offset: float = 0.0, turn: float = 1.0, grip: float = 1.0) -> tuple[JointTarget, ...]:
    return (JointTarget("xy", joints(0, 2), unit, offset), JointTarget("turn", (2,), turn), JointTarget("grip", (3,), grip))


GRIPPER = family("gripper",  # a head on two rails that turns and grips: where to be
    Row(WOOD, 4, 360, (4, 14), head(0.24, 0.40), pose(METRE)),
    Row(NIGHT, 6, 120, (3, 14), head(0.22, 0.44, rail=True), pose(0.62, turn=math.pi / 2), Camera(zoom=0.95)),
    Row(SKY, 2, 44, (8, 40), head(0.26, 0.38), pose(PIXEL, -1.0, DEGREE), Camera(rotate=8), dict(video_only=True)),
    Row(MINT, 10, 18, (2, 12), head(0.23, 0.42), pose(METRE / 100, -1.0, grip=0.08), Camera(tilt=0.9)),
    Row(ROAD, 20, 9, (6, 30), head(0.25, 0.42, rail=True), pose(METRE / 1000, 0.0, DEGREE, 0.01), Camera(rotate=-8, zoom=1.05), dict(delay=2)),
    task=Carry(objects=2, size=0.23), instruction="carry the puck to the mark",
    physics=Physics(inertia=0.05, friction=3.0, bounce=0.1))


def claw_arm(lengths: tuple[float, ...], radius: float, fingers: float, x: float, **shape: float) -> Body:
    return attach(arm(lengths, base=(x, -0.85), radius=radius, **shape), gripper(fingers, 0.1))


def deltas(unit: float, grip: float = 1.0) -> tuple[JointRate | JointTarget, ...]:
    return JointRate("joints", joints(0, 3), unit, "delta"), JointTarget("grip", (3,), grip)


PICKER = family("picker",  # three links and a gripper: how far to turn each joint per step
    Row(SLATE, 4, 240, (4, 14), claw_arm((0.6, 0.5, 0.14), 0.18, 0.34, 0.0, swing=60, bend=95), deltas(1.0)),
    Row(CHALK, 6, 90, (2, 12), claw_arm((0.56, 0.52, 0.18), 0.17, 0.36, 0.1, swing=56, bend=92), deltas(DEGREE), Camera(zoom=0.95)),
    Row(CLAY, 8, 36, (4, 20), claw_arm((0.64, 0.46, 0.12), 0.19, 0.32, -0.1, swing=60, bend=95), deltas(0.1, 0.08), Camera(rotate=9), dict(delay=1)),
    Row(PLUM, 2, 14, (10, 60), claw_arm((0.58, 0.48, 0.2), 0.16, 0.34, 0.05, swing=62, bend=98), deltas(TICK, 0.01), Camera(rotate=-7, zoom=0.92)),
    Row(SAND, 16, 8, (1, 15), claw_arm((0.62, 0.5, 0.16), 0.18, 0.36, -0.05, swing=56, bend=92), deltas(2 * math.pi), Camera(tilt=0.92)),
    task=Carry(objects=1, size=0.23), instruction="bring the puck to the mark",
    physics=Physics(inertia=0.07, friction=3.0, bounce=0.1))


def pair(lengths: tuple[float, ...], x: float, radius: float, fingers: float) -> Body:
    return two_arms(lengths, tip=gripper(fingers, 0.09), base=(x, -0.8), radius=radius, swing=55, bend=85, taper=0.88)


def targets(unit: float, offset: float = 0.0) -> tuple[JointTarget]:
    return (JointTarget("joints", joints(0, 8), unit, offset),)


BIMANUAL = family("bimanual",  # two arms of three joints, each with a gripper: where each joint is to be
    Row(SKY, 4, 200, (4, 14), pair((0.5, 0.42, 0.14), 0.55, 0.16, 0.32), targets(1.0)),
    Row(PLUM, 6, 80, (3, 14), pair((0.46, 0.44, 0.12), 0.6, 0.17, 0.34), targets(DEGREE), Camera(zoom=0.95)),
    Row(ROAD, 2, 30, (8, 40), pair((0.54, 0.4, 0.14), 0.5, 0.15, 0.34), targets(TICK, -2048 * TICK), Camera(tilt=0.92), dict(video_only=True)),
    Row(SAND, 10, 12, (4, 16), pair((0.52, 0.38, 0.18), 0.58, 0.16, 0.3), targets(0.5), Camera(rotate=8), dict(delay=1)),
    Row(SLATE, 20, 8, (5, 25), pair((0.48, 0.44, 0.16), 0.52, 0.17, 0.32), targets(2 * math.pi), Camera(rotate=-6, zoom=1.05)),
    task=Carry(objects=2, size=0.23), instruction="put the puck on the mark",
    physics=Physics(inertia=0.06, friction=3.0, bounce=0.1))


def cart(base: float, lengths: tuple[float, ...], radius: float, fingers: float) -> Body:
    drive = rover(size=(base, base), reach=0.42, round_=True, speed=0.9, turn=1.8)
    return attach(drive, attach(arm(lengths, heading=0, radius=radius, swing=70, bend=70, paint=1), gripper(fingers, 0.09)), at=2)


def split(unit: float, turn: float, arm_unit: float = 1.0, grip: float = 1.0) -> tuple[Drive | JointTarget, ...]:
    return (Drive("base", "holonomic", unit, turn), JointTarget("arm", joints(3, 4), arm_unit), JointTarget("gripper", (7,), grip))


MOBILE = family("mobile",  # a base that drives in any direction, an arm of four joints, a gripper
    Row(ROAD, 4, 150, (4, 14), cart(0.28, (0.24, 0.22, 0.2, 0.1), 0.14, 0.28), split(1.0, 1.0)),
    Row(WOOD, 6, 120, (2, 14), cart(0.26, (0.26, 0.22, 0.18, 0.12), 0.13, 0.28), split(METRE, 1.0, DEGREE), Camera(zoom=0.95)),
    Row(PLUM, 2, 90, (6, 30), cart(0.30, (0.22, 0.22, 0.2, 0.1), 0.15, 0.3), split(0.5, 1.5, grip=0.08), Camera(rotate=10)),
    Row(SLATE, 8, 72, (4, 12), cart(0.27, (0.28, 0.2, 0.18, 0.1), 0.14, 0.3), split(METRE / 1000, DEGREE, 1.4), Camera(tilt=0.9), dict(delay=1)),
    Row(SKY, 10, 64, (1, 20), cart(0.29, (0.24, 0.24, 0.2, 0.08), 0.13, 0.3), split(0.01, 0.01, TICK), Camera(rotate=-9, zoom=0.92)),
    task=Carry(objects=1, size=0.23), instruction="fetch the puck and take it to the mark", dict_actions=True,
    physics=Physics(inertia=0.1, friction=3.0, bounce=0.1))
