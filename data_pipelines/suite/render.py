"""The renderer: rounded boxes on a floor, antialiased, many frames at once.

Every shape is a rounded box: a disc has no extent but its corner radius, a capsule is a
segment with one. Coverage comes from the signed distance, computed in a window just large
enough for the shape, so the cost follows the painted area.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from data_pipelines.suite.appearance import Appearance
from data_pipelines.suite.bodies import Pose
from data_pipelines.suite.rollout import Rollout
from data_pipelines.suite.spec import Camera, EmbodimentSpec

CHUNK = 48
"""Frames drawn together: about what keeps canvas and windows in the cache."""

PIXEL = np.complex128
"""Pixels are moved as one 16-byte element (four float32, the last unused): six times faster
in numpy's indexing than rows of three."""


@dataclass(frozen=True)
class Shapes:
    """P rounded boxes in F frames, painted in order. World units, radians, colours 0..255.

    centre [F, P, 2], angle [F, P], half [P, 2] (extent without the corners), radius [P],
    colour float32 [P, F, 4].
    """

    centre: np.ndarray
    angle: np.ndarray
    half: np.ndarray
    radius: np.ndarray
    colour: np.ndarray


def frame_index(rollout: Rollout, episodes: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """(episode, step) of every frame of these episodes, in order."""
    lengths = rollout.lengths[episodes]
    return np.repeat(episodes, lengths), np.concatenate([np.arange(k) for k in lengths])


def render_frames(
    spec: EmbodimentSpec,
    rollout: Rollout,
    looks: Appearance,
    camera: Camera,
    episode: np.ndarray,
    step: np.ndarray,
) -> np.ndarray:
    """uint8 [F, H, W, 3] for the given (episode, step) pairs [F]."""
    images = np.empty((len(step), camera.height, camera.width, 3), np.uint8)
    for start in range(0, len(step), CHUNK):
        part = slice(start, start + CHUNK)
        images[part] = _render_chunk(spec, rollout, looks, camera, episode[part], step[part])
    return images


def _render_chunk(spec, rollout, looks, camera, episode, step) -> np.ndarray:
    pose = spec.body.pose(rollout.q[episode, step])
    view = _View(camera, pose)
    canvas = _background(spec, looks, view, episode)
    shapes = _scene(spec, rollout, looks, pose, episode, step)
    for p in range(len(shapes.radius)):
        _paint(
            canvas,
            view.points(shapes.centre[:, p]),
            view.angles(shapes.angle[:, p]),
            shapes.half[p] * view.scale,
            shapes.radius[p] * view.scale,
            shapes.colour[p],
        )
    return canvas.astype(np.uint8)[..., :3]


def _scene(spec, rollout, looks, pose: Pose, episode, step) -> Shapes:
    """Goals, objects, distractors and robot, back to front."""
    task, look, links = spec.task, spec.look, spec.body.links
    frames = len(step)
    goals = rollout.goals[episode][:, : 1 if task.objects else None]
    objects, drift = rollout.objects[episode, step], rollout.distractors[episode, step]
    visible = [i for i, link in enumerate(links) if link.radius > 0]
    middle = (pose.origin[:, visible] + pose.tip[:, visible]) / 2
    discs = np.concatenate([goals, objects, drift], 1)
    sizes = [max(task.radius, 0.15)] * goals.shape[1]
    sizes += [task.size] * objects.shape[1] + [look.distractor_size] * drift.shape[1]
    count = discs.shape[1]
    colours = [np.repeat(looks.goal, goals.shape[1], 1), looks.objects, looks.distractors]
    colours.append(looks.robot[:, [links[i].paint for i in visible]])
    return Shapes(
        centre=np.concatenate([discs, middle], 1),
        angle=np.concatenate([np.zeros((frames, count)), pose.angle[:, visible]], 1),
        half=np.array([(0, 0)] * count + [(links[i].length / 2, links[i].half_width) for i in visible]),
        radius=np.array(sizes + [links[i].radius for i in visible]),
        colour=np.ascontiguousarray(np.concatenate(colours, 1)[episode].swapaxes(0, 1)),
    )


class _View:
    """World to pixel for every frame of a chunk."""

    def __init__(self, camera: Camera, pose: Pose):
        frames = len(pose.angle)
        turn = np.full(frames, np.radians(camera.rotate))
        centre = np.broadcast_to(np.array(camera.centre, float), (frames, 2))
        self.moving = camera.follow is not None
        if self.moving:
            heading = pose.angle[:, camera.follow]
            cos, sin = np.cos(heading), np.sin(heading)
            x, y = camera.centre
            centre = pose.tip[:, camera.follow] + np.stack([cos * x - sin * y, sin * x + cos * y], 1)
            turn = turn + np.pi / 2 - heading  # the link points up in the image
        self.camera, self.centre, self.turn = camera, centre, turn
        self.cos, self.sin = np.cos(turn), np.sin(turn)
        self.scale = camera.zoom * min(camera.height, camera.width) / 2
        self.mirror = -1.0 if camera.flip else 1.0
        self.origin = np.array([camera.width / 2 - 0.5, camera.height / 2 - 0.5])

    def points(self, point: np.ndarray) -> np.ndarray:
        """[F, 2] pixel (column, row); the world's y points up."""
        away = point - self.centre
        x = (self.cos * away[:, 0] - self.sin * away[:, 1]) * self.mirror
        y = self.sin * away[:, 0] + self.cos * away[:, 1]
        return self.origin + self.scale * np.stack([x, -y], 1)

    def angles(self, angle: np.ndarray) -> np.ndarray:
        """[F] in pixel axes (rows point down)."""
        return -self.mirror * (angle + self.turn)

    def world(self) -> tuple[np.ndarray, np.ndarray]:
        """World x and y of every pixel, [F or 1, H*W] float32."""
        row, column = np.mgrid[: self.camera.height, : self.camera.width].reshape(2, -1).astype(np.float32)
        left, top = (float(v) for v in self.origin)  # python floats keep the arrays float32
        x = (column - left) / self.scale * self.mirror
        y = (top - row) / self.scale
        keep = slice(None) if self.moving else slice(0, 1)
        cos, sin = self.cos[keep, None].astype(np.float32), self.sin[keep, None].astype(np.float32)
        centre = self.centre[keep].astype(np.float32)
        return cos * x + sin * y + centre[:, :1], -sin * x + cos * y + centre[:, 1:]


def _background(spec, looks: Appearance, view: _View, episode: np.ndarray) -> np.ndarray:
    """float32 canvas [F, H, W, 4]: floor, outside and the light's slope."""
    x, y = view.world()
    pattern = spec.look.pattern
    inside = np.clip(((1.02 - np.maximum(np.abs(x), np.abs(y))) * view.scale), 0, 1)
    if pattern == "table":
        inside = np.clip((0.62 - np.abs(y + 0.15)) * view.scale, 0, 1)
    elif pattern == "stripe":
        inside = np.clip((np.abs(x) - 0.28) * view.scale, 0, 1)
    elif pattern == "slope":
        inside = np.clip(0.75 + 0.35 * y, 0, 1)
    ids, which = np.unique(episode, return_inverse=True)
    if view.moving:  # every frame sees another part of the floor
        ids, which = episode, slice(None)
    floor, outside = looks.floor[ids], looks.outside[ids]
    light = looks.slope[ids, :1] * x + looks.slope[ids, 1:] * y
    canvas = outside + inside[..., None] * (floor - outside) + light[..., None]
    canvas = np.clip(canvas, 0, 254).reshape(-1, view.camera.height, view.camera.width, 4)
    return canvas if view.moving else canvas[which]


def _paint(canvas, centre, angle, half, radius, colour) -> None:
    """Blends one rounded box per frame into `canvas` [F, H, W, 4], in place. Pixel units."""
    frames, height, width = canvas.shape[:3]
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.abs([[cos, sin], [sin, cos]])  # how far each half extent reaches along x and y
    extent = np.einsum("aef,e->fa", turned, half) + radius + 1.0
    size = np.minimum(np.ceil(2 * extent.max(0)).astype(int) + 1, (width, height))
    corner = np.clip(np.floor(centre - extent).astype(int), 0, np.array([width, height]) - size)
    dx = (corner[:, :1] + np.arange(size[0]) - centre[:, :1])[:, None, :].astype(np.float32)
    dy = (corner[:, 1:] + np.arange(size[1]) - centre[:, 1:])[:, :, None].astype(np.float32)
    if half[0] == half[1] == 0:
        squared = dx * dx + dy * dy
    else:
        cos, sin = (v.astype(np.float32)[:, None, None] for v in (cos, sin))
        u = np.abs(cos * dx + sin * dy)
        u = np.maximum(u - np.float32(half[0]), 0)
        v = np.abs(cos * dy - sin * dx)
        if half[1] > 0:
            v = np.maximum(v - np.float32(half[1]), 0)
        squared = u * u + v * v
    cover = (np.float32(radius + 0.5) - np.sqrt(squared)).ravel()
    # From here on only covered pixels: position in the window -> position in the canvas.
    hit = np.flatnonzero(cover > 0)
    area = int(size[0] * size[1])
    counts = np.diff(np.searchsorted(hit, np.arange(frames + 1) * area))
    first = np.arange(frames) * height * width + corner[:, 1] * width + corner[:, 0]
    window = (np.arange(size[1])[:, None] * width + np.arange(size[0])).ravel()
    index = window[hit - np.repeat(np.arange(frames) * area, counts)] + np.repeat(first, counts)
    pixels = canvas.reshape(-1, 4).view(PIXEL)[:, 0]
    under = pixels[index]
    channels = under.view(np.float32).reshape(-1, 4)
    paint = np.repeat(colour.view(PIXEL)[:, 0], counts).view(np.float32).reshape(-1, 4)
    paint -= channels
    paint *= np.minimum(cover[hit], 1)[:, None]
    channels += paint
    pixels[index] = under
