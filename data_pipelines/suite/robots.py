"""Builders of the robots that `families` lists: arms, gantries, rovers, grippers, claws.

Each returns a `Body`; `attach` and `join` combine them. Lengths in world units (the image is
2 wide), angles in radians, speeds per second.
"""

from __future__ import annotations

import math

from data_pipelines.suite.bodies import Body, Joint, Link, attach, join


def arm(
    lengths: tuple[float, ...],
    *,
    base: tuple[float, float] = (0.0, 0.0),
    heading: float = 90.0,
    radius: float = 0.15,
    taper: float = 0.85,
    bend: float = 120.0,
    swing: float | None = None,
    speed: float = 2.4,
    paint: int = 0,
    fist: float = 0.0,
    pushers: int = 1,
    stripe: int = 1,
) -> Body:
    """A chain of revolute links. `heading` (degrees) is straight out; the first joint swings by +-`swing`, the others
    by +-`bend` degrees. Each link is `taper` times as thick as the one before, and the colour
    changes after every `stripe` links.

    The last `pushers` links push objects; with a `fist` (its radius) only that does, and the
    arm passes above them.
    """
    swing = bend if swing is None else swing
    links, joints = [], []
    for i, length in enumerate(lengths):
        links.append(
            Link(
                parent=i - 1,
                joint=i,
                angle=math.radians(heading) if i == 0 else 0.0,
                mount=base if i == 0 else (0.0, 0.0),
                length=length,
                radius=radius * taper**i,
                paint=(paint + i // stripe) % 3,
                touches=i >= len(lengths) - pushers and not fist,
            )
        )
        limit = math.radians(swing if i == 0 else bend)
        joints.append(Joint(-limit, limit, speed))
    if fist:
        links.append(Link(parent=len(links) - 1, radius=fist, paint=2, touches=True))
    return Body(tuple(links), tuple(joints), (len(links) - 1,), (-1,))


def gripper(size: float, radius: float) -> Body:
    """Two fingers on one joint: 0 closed, 1 open. The tool is the point between them."""
    links = [Link(length=0.6 * size)]
    for side in (1, -1):
        links.append(
            Link(
                joint=0,
                gain=0.75 * side,
                angle=0.12 * side,
                mount=(0.0, 0.35 * size * side),
                length=size,
                radius=radius,
                paint=2,
            )
        )
    return Body(tuple(links), (Joint(0.0, 1.0, 4.0),), (0,), (0,))


def gantry(
    *,
    reach: float = 0.68,
    speed: float = 1.1,
    size: float = 0.3,
    rail: bool = False,
    turns: bool = False,
    touches: bool = True,
) -> Body:
    """A head that slides along x and y, drawn as a disc; with `rail` also its moving beam; with
    `turns` it ends in a joint that turns what is attached to it."""
    links = [Link(joint=0, kind="slide_x")]
    if rail:
        links.append(Link(parent=0, mount=(0.0, -1.2), angle=math.pi / 2, length=2.4, radius=0.08))
    links.append(Link(parent=0, joint=1, kind="slide_y", radius=size, paint=1, touches=touches))
    links.append(Link(parent=len(links) - 1, radius=0.45 * size, paint=2))  # a cap: unlike a puck
    joints = [Joint(-reach, reach, speed)] * 2
    if turns:
        links.append(Link(parent=len(links) - 2, joint=2))
        joints.append(Joint(-math.pi / 2, math.pi / 2, 2.4))
    return Body(tuple(links), tuple(joints), (len(links) - 1,), (-1,))


def rover(
    *,
    reach: float = 0.66,
    size: tuple[float, float] = (0.32, 0.26),
    speed: float = 1.0,
    turn: float = 2.6,
    round_: bool = False,
    blade: float = 0.0,
) -> Body:
    """A base free in x, y and heading: a box with wheels, or a disc, with a nose that shows the
    heading, and a `blade` of that half width in front of it."""
    length, width = size
    links = [
        Link(joint=0, kind="slide_x"),
        Link(parent=0, joint=1, kind="slide_y"),
        Link(parent=1, joint=2),
    ]
    if round_:
        links.append(Link(parent=2, radius=length, touches=True))
    else:
        for side in (1, -1):  # wheels
            links.append(Link(parent=2, mount=(-0.8 * length, side * width), length=1.6 * length, radius=0.07, paint=2))
        links.append(
            Link(
                parent=2,
                mount=(-length + 0.05, 0.0),
                length=2 * length - 0.1,
                half_width=width - 0.05,
                radius=0.05,
                touches=True,
            )
        )
    links.append(Link(parent=2, mount=(0.4 * length, 0.0), length=0.3 * length, radius=0.11, paint=1))
    if blade:
        links.append(
            Link(parent=2, mount=(length + 0.05, -blade), angle=math.pi / 2, length=2 * blade, radius=0.08, paint=2,
                 touches=True)
        )  # fmt: skip
    slide, heading = Joint(-reach, reach, speed), Joint(-math.pi, math.pi, turn, wraps=True)
    return Body(tuple(links), (slide, slide, heading), (2,), (-1,))


def claw(fingers: int, phalanges: int, *, length: float, radius: float) -> Body:
    """Fingers that fan out from a wrist and curl; they carry no tool of their own."""

    def finger(angle: float) -> Body:
        links = [
            Link(parent=i - 1, joint=i, angle=0.0 if i else angle, length=length * 0.9**i, radius=radius * 0.92**i,
                 paint=2, touches=True)
            for i in range(phalanges)
        ]  # fmt: skip
        return Body(tuple(links), (Joint(-0.7, 0.7, 3.5),) * phalanges, (), ())

    return join(*(finger(0.8 * (2 * i / (fingers - 1) - 1)) for i in range(fingers)))


def two_arms(
    lengths: tuple[float, ...],
    *,
    tip: Body | None = None,
    base: tuple[float, float] = (0.5, -0.8),
    heading: float = 102.0,
    **shape: float,
) -> Body:
    """Two mirrored arms, left first, each with `tip` as its hand. Joints: arm, tip, arm, tip."""
    arms = []
    for side in (-1, 1):
        one = arm(lengths, base=(base[0] * side, base[1]), heading=90 + (heading - 90) * side, **shape)
        arms.append(one if tip is None else attach(one, tip))
    return join(*arms)
