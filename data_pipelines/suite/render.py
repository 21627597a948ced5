"""The renderer: rounded boxes on a floor, antialiased and shaded, many frames at once.

Every shape is a rounded box: a disc has no extent but its corner radius, a capsule is a
segment with one. Coverage and shading come from the signed distance, computed in a window just
large enough for the shape, so the cost follows the painted area. Pictures are [frames, channels, H, W] until they are
done: numpy is several times slower over rows of three.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from data_pipelines.suite.appearance import Appearance
from data_pipelines.suite.bodies import Pose
from data_pipelines.suite.spec import IMAGE_SIZE, Camera, EmbodimentSpec

CHUNK = 128
"""Frames drawn together: enough that numpy's work outweighs its calls, and few enough for the cache."""

LIGHT = np.array([-0.6, 0.8])
"""Direction on the floor from which the light comes."""

SOFTNESS = 3.0
"""Pixels over which an edge fades, as through a lens: half as many at the image size of the studies."""

DARK = 60.0
"""Grey levels that a shadow subtracts."""

CAP = 0.7
"""Share of an object's contrast to mid-grey in the flat cap on its middle."""

SHADOW = 0.06
"""Distance between shadows and what casts them, world units."""


class View:
    """World to pixel, for one camera."""

    def __init__(self, camera: Camera):
        turn = np.radians(camera.rotate)
        cos, sin = np.cos(turn), np.sin(turn)
        self.size, self.turn = IMAGE_SIZE, turn
        self.rotation = np.array([[cos, -sin], [sin, cos]])
        self.centre = np.array(camera.centre)
        self.scale = camera.zoom * IMAGE_SIZE / 2 * np.array([1.0, camera.tilt])
        """Pixels per world unit, across and down the image."""

    def points(self, point: np.ndarray) -> np.ndarray:
        """[..., 2] pixel (column, row), (0, 0) the middle of the first; the world's y points up."""
        away = (point - self.centre) @ self.rotation.T
        return self.size / 2 - 0.5 + self.scale * away * [1, -1]

    def angles(self, angle: np.ndarray) -> np.ndarray:
        """[...] in pixel axes (rows point down)."""
        return -(angle + self.turn)

    def world(self) -> np.ndarray:
        """World (x, y) of every pixel, [H, W, 2]."""
        row, column = np.mgrid[: self.size, : self.size]
        seen = (np.stack([column, row], -1) - (self.size / 2 - 0.5)) / self.scale * [1, -1]
        return seen @ self.rotation + self.centre


@dataclass(frozen=True)
class Shapes:
    """P rounded boxes in F frames, painted in order. World units, radians, colours 0..255.

    centre [F, P, 2], angle [F, P], half [P, 2] (extent without the corners), radius [P],
    colour float32 [F, P, 3], relief [P] (0: flat, 1: round as a ball or a pipe).
    """

    centre: np.ndarray
    angle: np.ndarray
    half: np.ndarray
    radius: np.ndarray
    colour: np.ndarray
    relief: np.ndarray


def render_frames(
    spec: EmbodimentSpec,
    looks: Appearance,
    goals: np.ndarray,
    q: np.ndarray,
    objects: np.ndarray,
    episode: np.ndarray,
) -> np.ndarray:
    """uint8 [F, H, W, 3] of configurations q [F, C] and objects [F, K, 2].

    `episode` [F]: which of the n episodes of `looks` and `goals` [n, M, 2] each frame belongs to.
    """
    view = View(spec.camera)
    ids, which = np.unique(episode, return_inverse=True)
    still = _still(spec, view, looks, goals, ids)
    images = np.empty((len(q), view.size, view.size, 3), np.uint8)
    for start in range(0, len(q), CHUNK):
        part = slice(start, start + CHUNK)
        shapes = _scene(spec, looks, spec.body.pose(q[part]), objects[part], episode[part])
        canvas = _draw(view, still[which[part]], shapes)
        for channel in range(3):
            images[part, ..., channel] = canvas[:, channel]
    return images


def positions_of(spec: EmbodimentSpec, q: np.ndarray, objects: np.ndarray) -> np.ndarray:
    """float32 [F, P, 2]: true positions in each frame of the points that the spec names, in pixels (column, row).

    q [F, C], objects [F, K, 2]. (0, 0) is the middle of the first pixel; points out of view are outside the image.
    """
    tools = spec.body.tool_points(spec.body.pose(q))
    return View(spec.camera).points(np.concatenate([tools, objects], 1)).astype(np.float32)


def _draw(view: View, canvas: np.ndarray, shapes: Shapes) -> np.ndarray:
    """uint8 [F, 3, H, W]: the shapes and their shadows on `canvas`, which is used up."""
    # All shadows are painted at once, so that none is darker where two overlap.
    shade = np.zeros((len(canvas), 1, *canvas.shape[2:]), np.float32)
    dark = np.full((len(canvas), 1), DARK, np.float32)
    angle = view.angles(shapes.angle)
    for p in np.flatnonzero(shapes.relief):
        centre = view.points(shapes.centre[:, p] - SHADOW * LIGHT)
        _paint(shade, view, centre, angle[:, p], shapes.half[p], shapes.radius[p], dark, 0.0)
    canvas -= shade
    np.maximum(canvas, 0, out=canvas)
    for p, radius in enumerate(shapes.radius):
        centre = view.points(shapes.centre[:, p])
        _paint(canvas, view, centre, angle[:, p], shapes.half[p], radius, shapes.colour[:, p], shapes.relief[p])
    canvas += 0.5
    return np.clip(canvas, 0, 255, out=canvas).astype(np.uint8)


def _scene(spec, looks, pose: Pose, objects, episode) -> Shapes:
    """Objects, each with a flat cap in the middle, and the robot, back to front."""
    links = spec.body.links
    visible = [i for i, link in enumerate(links) if link.radius > 0]
    middle = (pose.origin[:, visible] + pose.tip[:, visible]) / 2
    count, size = objects.shape[1], spec.task.size
    robot = looks.robot[:, [links[i].paint for i in visible]]
    cap = looks.objects * CAP + 128 * (1 - CAP)
    colours = np.concatenate([looks.objects, cap, robot], 1)[episode]
    return Shapes(
        centre=np.concatenate([objects, objects, middle], 1),
        angle=np.concatenate([np.zeros((len(episode), 2 * count)), pose.angle[:, visible]], 1),
        half=np.array([(0, 0)] * 2 * count + [(links[i].length / 2, links[i].half_width) for i in visible]),
        radius=np.array([size] * count + [0.45 * size] * count + [links[i].radius for i in visible]),
        colour=colours,
        relief=np.array([1.0] * count + [0.0] * count + [1.0] * len(visible)),
    )


def _still(spec, view: View, looks: Appearance, goals, ids: np.ndarray) -> np.ndarray:
    """float32 canvas [episodes, 3, H, W] of what does not move: floor, light, the goals' marks."""
    xy = view.world().astype(np.float32)
    x, y = xy[..., 0], xy[..., 1]
    edge = float(view.scale[0])
    inside = np.clip((1.03 - np.maximum(np.abs(x), np.abs(y))) * edge, 0, 1)
    tint = np.zeros_like(x)
    pattern = spec.palette.pattern
    if pattern == "table":
        tint = -14 * np.clip((np.abs(y + 0.1) - 0.55) * edge, 0, 1)
    elif pattern == "stripe":
        tint = 16 * np.clip((0.16 - np.abs(x)) * edge, 0, 1)
    elif pattern == "tiles":
        tint = 12 * np.clip(np.sin(np.pi * x) * np.sin(np.pi * y) * edge, -1, 1)
    elif pattern == "rings":
        tint = 12 * np.clip((0.62 - np.hypot(x, y)) * edge, 0, 1)
    light = looks.slope[ids, :1, None] * x + looks.slope[ids, 1:, None] * y
    floor, outside = (colour[ids, 0, :, None, None] for colour in (looks.floor, looks.outside))
    canvas = outside + inside * (floor + tint - outside)
    canvas = np.clip(canvas + light[:, None], 0, 254).astype(np.float32)
    marks = goals[ids][:, : 1 if spec.task.marks_object else None]
    for m in range(marks.shape[1]):
        centre, angle = view.points(marks[:, m]), np.zeros(len(ids))
        for radius, colour in ((spec.task.radius, looks.goal[ids, 0]), (0.72 * spec.task.radius, looks.floor[ids, 0])):
            _paint(canvas, view, centre, angle, np.zeros(2), radius, colour, 0.0)
    return canvas


def _paint(canvas, view: View, centre, angle, half, radius: float, colour, relief: float) -> None:
    """Blends one rounded box per frame into `canvas` [F, channels, H, W], in place.

    `centre` [F, 2] and `angle` [F] as the view gives them, `half` and `radius` in world units, `colour` [F, channels].
    """
    frames, _, height, width = canvas.shape
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.abs([[cos, sin], [sin, cos]])  # how far each half extent reaches along x and y
    faded = 0.51 * SOFTNESS / view.scale[0]  # an edge fades over as much to either side; a little more, for rounding
    extent = (np.einsum("aef,e->fa", turned, half) + radius + faded) * view.scale
    size = np.minimum(np.ceil(2 * extent.max(0)).astype(int) + 1, (width, height))
    corner = np.clip(np.floor(centre - extent).astype(int), 0, np.array([width, height]) - size)
    across, down = 1 / view.scale  # world units per pixel
    dx = ((corner[:, :1] + np.arange(size[0]) - centre[:, :1]) * across)[:, None, :].astype(np.float32)
    dy = ((corner[:, 1:] + np.arange(size[1]) - centre[:, 1:]) * down)[:, :, None].astype(np.float32)
    if half[0] == half[1] == 0:
        u, v = dx, dy
    else:
        cos, sin = (a.astype(np.float32)[:, None, None] for a in (cos, sin))
        u, v = cos * dx + sin * dy, cos * dy - sin * dx
        u = u - np.clip(u, -np.float32(half[0]), np.float32(half[0]))
        if half[1] > 0:
            v = v - np.clip(v, -np.float32(half[1]), np.float32(half[1]))
    distance = np.sqrt(u * u + v * v)
    cover = np.clip((np.float32(radius) - distance) * np.float32(view.scale[0] / SOFTNESS) + 0.5, 0, 1)
    paint = colour[:, :, None, None]
    if relief:
        paint = paint * _tone(u, v, distance, radius, angle, half)[:, None]
    windows = sliding_window_view(canvas, size[::-1], axis=(2, 3), writeable=True)
    where = np.arange(frames), slice(None), corner[:, 1], corner[:, 0]
    under = windows[where]
    under += (paint - under) * cover[:, None]
    windows[where] = under


def _tone(u, v, distance, radius: float, angle, half) -> np.ndarray:
    """float32 [F, h, w]: how light a round surface is, flat over the window: its slope faces the light or not."""
    x, y = LIGHT[0], -LIGHT[1]
    if half[0] == half[1] == 0:
        slope = x * u + y * v
    else:  # u and v lie in the shape's axes
        cos, sin = np.cos(angle), np.sin(angle)
        slope = (cos * x + sin * y).astype(np.float32)[:, None, None] * u
        slope = slope + (cos * y - sin * x).astype(np.float32)[:, None, None] * v
    rim = np.square(np.square(np.minimum(distance / radius, 1)))  # ** 4 takes twenty times as long
    tone = 1.05 + 0.22 * slope / radius - 0.2 * rim
    return np.clip(tone, 0.5, 1.3).astype(np.float32)
