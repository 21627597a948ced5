"""Families that push: heads on rails, rovers, arms, and the holonomic bases (unseen)."""

from __future__ import annotations

from data_pipelines.suite.controls import Drive, JointRate
from data_pipelines.suite.families.table import DEGREE, INCH, METRE, PIXEL, TICK, Row, family, joints
from data_pipelines.suite.palettes import CHALK, CLAY, MINT, NIGHT, PLUM, ROAD, SAND, SKY, SLATE, WOOD
from data_pipelines.suite.robots import arm, gantry, rover
from data_pipelines.suite.spec import Camera, Physics
from data_pipelines.suite.tasks import Push

# fmt: off


def xy(unit: float) -> tuple[JointRate]:
    return (JointRate("xy", joints(0, 2), unit, "delta"),)


PUSHER = family("pusher",  # a head on two rails, moved by so much per step
    Row(SAND, 4, 500, (4, 12), gantry(size=0.30), xy(PIXEL)),
    Row(SLATE, 2, 160, (6, 30), gantry(size=0.28, rail=True), xy(METRE / 1000), Camera(rotate=-8, zoom=0.95)),
    Row(MINT, 6, 60, (1, 12), gantry(size=0.34, speed=1.2), xy(0.1), Camera(zoom=1.05, tilt=0.9), dict(delay=1)),
    Row(WOOD, 10, 24, (5, 16), gantry(size=0.27, rail=True), xy(METRE), Camera(rotate=10, zoom=0.9)),
    Row(NIGHT, 20, 8, (10, 60), gantry(size=0.32, speed=1.0), xy(INCH), Camera(centre=(0.05, -0.05), zoom=0.9)),
    task=Push(objects=2, size=0.27), instruction="push the puck onto the mark",
    physics=Physics(inertia=0.06, friction=2.0, bounce=0.3))


def wheels(unit: float, track: float) -> tuple[Drive]:
    return (Drive("wheels", "wheels", unit, track=track),)


ROVER = family("rover",  # a box on two driven wheels
    Row(ROAD, 4, 400, (4, 12), rover(), wheels(METRE, 0.5)),
    Row(CLAY, 2, 130, (6, 30), rover(size=(0.28, 0.28), speed=0.9), wheels(0.01, 0.56), Camera(zoom=0.95, tilt=0.92)),
    Row(SLATE, 8, 48, (2, 12), rover(size=(0.36, 0.24), turn=2.2), wheels(0.12, 0.5), Camera(rotate=12), dict(video_only=True)),
    Row(SKY, 10, 20, (4, 20), rover(size=(0.30, 0.24), speed=1.1), wheels(1 / 300, 0.46), Camera(zoom=1.05), dict(delay=2)),
    Row(PLUM, 16, 10, (10, 40), rover(size=(0.34, 0.30)), wheels(1.0, 0.6), Camera(rotate=-10, zoom=0.92)),
    task=Push(objects=1, size=0.27), instruction="shove the puck onto the mark",
    physics=Physics(inertia=0.12, friction=1.5, bounce=0.2))


def rates(unit: float, count: int) -> tuple[JointRate]:
    return (JointRate("joints", joints(0, count), unit),)


ARM = family("arm",  # three links; the fist pushes, the rest passes above
    Row(CHALK, 4, 300, (4, 14), arm((0.55, 0.45, 0.3), base=(0, -0.8), radius=0.17, fist=0.24, swing=60, bend=95), rates(1.0, 3)),
    Row(SAND, 6, 110, (3, 16), arm((0.5, 0.5, 0.25), base=(-0.1, -0.85), radius=0.16, fist=0.26, swing=58, bend=92), rates(DEGREE, 3), Camera(rotate=8)),
    Row(PLUM, 2, 40, (8, 40), arm((0.6, 0.42, 0.32), base=(0.1, -0.85), radius=0.18, fist=0.23, swing=55, bend=96), rates(2.4, 3), Camera(zoom=0.92)),
    Row(SKY, 12, 16, (2, 10), arm((0.52, 0.4, 0.34), base=(0, -0.75), radius=0.15, fist=0.25, swing=62, bend=90), rates(0.5, 3), Camera(rotate=-9, zoom=1.05), dict(delay=2)),
    Row(NIGHT, 30, 8, (6, 20), arm((0.58, 0.48, 0.26), base=(0.05, -0.9), radius=0.17, fist=0.25, swing=58, bend=98), rates(TICK, 3), Camera(tilt=0.9, zoom=0.96)),
    task=Push(objects=1, size=0.27), instruction="knock the puck onto the mark",
    physics=Physics(inertia=0.07, friction=2.5, bounce=0.4))


def body_frame(unit: float, turn_unit: float) -> tuple[Drive]:
    return (Drive("velocity", "holonomic", unit, turn_unit),)


OMNI = family("omni",  # a disc with a blade that drives in any direction
    Row(MINT, 4, 160, (4, 12), rover(size=(0.28, 0.28), round_=True, blade=0.3), body_frame(1.0, 1.0)),
    Row(CHALK, 6, 128, (2, 12), rover(size=(0.26, 0.26), round_=True, blade=0.26), body_frame(METRE, 1.0), Camera(rotate=10, zoom=0.95)),
    Row(CLAY, 2, 100, (6, 30), rover(size=(0.30, 0.30), round_=True, blade=0.34), body_frame(0.5, 1.5), Camera(tilt=0.9)),
    Row(NIGHT, 10, 80, (4, 14), rover(size=(0.27, 0.27), round_=True, blade=0.32, speed=1.1), body_frame(METRE / 1000, DEGREE), Camera(rotate=-8), dict(delay=1)),
    Row(WOOD, 8, 64, (1, 20), rover(size=(0.29, 0.29), round_=True, blade=0.28), body_frame(0.01, 0.01), Camera(zoom=0.92)),
    task=Push(objects=1, size=0.27), instruction="shove the puck onto the mark",
    physics=Physics(inertia=0.12, friction=1.5, bounce=0.2))
