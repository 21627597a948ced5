"""Families of 28 action values: two arms with hands, and two tentacles."""

from __future__ import annotations

import math

from data_pipelines.suite.bodies import Body
from data_pipelines.suite.controls import JointRate, JointTarget
from data_pipelines.suite.families.table import DEGREE, TICK, Row, family, joints
from data_pipelines.suite.palettes import CHALK, CLAY, MINT, NIGHT, ROAD, SAND, SKY, SLATE, WOOD
from data_pipelines.suite.robots import claw, two_arms
from data_pipelines.suite.spec import Camera, Physics
from data_pipelines.suite.tasks import Push, Reach

# fmt: off


def torso(lengths: tuple[float, ...], x: float, radius: float, fingers: float) -> Body:
    """Arms of six joints with hands of four fingers, two joints each."""
    return two_arms(lengths, tip=claw(4, 2, length=fingers, radius=0.075), base=(x, -0.85), radius=radius, taper=0.95,
                    swing=60, bend=50, stripe=3)


def by_side(unit: float, offset: float = 0.0) -> tuple[JointTarget, ...]:
    return tuple(JointTarget(key, joints(first, count), unit, offset) for key, first, count in (
        ("left_arm", 0, 6), ("left_hand", 6, 8), ("right_arm", 14, 6), ("right_hand", 20, 8)))


HUMANOID = family("humanoid",  # where each joint is to be
    Row(SAND, 4, 100, (4, 14), torso((0.26, 0.22, 0.2, 0.16, 0.14, 0.1), 0.42, 0.17, 0.19), by_side(1.0)),
    Row(NIGHT, 6, 50, (3, 14), torso((0.24, 0.24, 0.18, 0.18, 0.12, 0.1), 0.46, 0.18, 0.18), by_side(DEGREE), Camera(zoom=0.95)),
    Row(SLATE, 2, 26, (8, 40), torso((0.28, 0.2, 0.2, 0.16, 0.14, 0.12), 0.38, 0.16, 0.2), by_side(TICK, -2048 * TICK), Camera(rotate=7)),
    Row(WOOD, 10, 12, (2, 12), torso((0.25, 0.22, 0.2, 0.18, 0.14, 0.08), 0.44, 0.17, 0.2), by_side(0.5), Camera(tilt=0.92), dict(delay=1)),
    Row(SKY, 16, 8, (6, 20), torso((0.27, 0.23, 0.18, 0.16, 0.12, 0.12), 0.40, 0.18, 0.19), by_side(math.pi), Camera(rotate=-7, zoom=1.05)),
    task=Reach(radius=0.3, objects=1), instruction="reach both marks", dict_actions=True,
    physics=Physics(inertia=0.06, friction=2.5, bounce=0.2))


def trunks(link: float, x: float, radius: float, taper: float, bend: float) -> Body:
    """Two chains of fourteen joints; their last five links push."""
    return two_arms((link,) * 14, base=(x, -0.95), heading=95, radius=radius, taper=taper, swing=45, bend=bend, speed=1.6,
                    pushers=5, stripe=5)


def rates(unit: float) -> tuple[JointRate]:
    return (JointRate("joints", joints(0, 28), unit),)


TENTACLES = family("tentacles",  # how fast each joint turns
    Row(MINT, 4, 90, (4, 14), trunks(0.105, 0.45, 0.17, 0.96, 26), rates(1.0)),
    Row(CLAY, 6, 44, (2, 12), trunks(0.11, 0.5, 0.16, 0.965, 24), rates(DEGREE), Camera(rotate=8), dict(delay=1)),
    Row(CHALK, 2, 22, (8, 60), trunks(0.1, 0.4, 0.18, 0.955, 27), rates(2.0), Camera(zoom=0.93)),
    Row(ROAD, 8, 11, (4, 20), trunks(0.11, 0.42, 0.165, 0.96, 25), rates(0.5), Camera(tilt=0.92), dict(video_only=True)),
    Row(WOOD, 12, 8, (5, 15), trunks(0.1, 0.48, 0.175, 0.96, 28), rates(TICK), Camera(rotate=-8, zoom=1.05)),
    task=Push(objects=1, size=0.27), instruction="push the puck onto the mark",
    physics=Physics(inertia=0.07, friction=2.0, bounce=0.3))
