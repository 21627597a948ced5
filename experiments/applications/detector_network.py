"""A keypoint detector: a small network that finds a robot's tools, and objects by their colour, by heatmaps.

One backbone for all robots, and an output layer for each. The height of a heatmap's peak is the point's confidence, the
cells around the peak give its position. Pure functions of arrays; training data and loop are the caller's.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

DetectorParams = dict[str, jax.Array]

CELL = 2
"""Pixels of a frame per cell of a heatmap."""

HEAT_STD = 1.0
"""Standard deviation of a point's target heat, in cells."""

PEAK_RADIUS = 2
"""Number of cells on each side of the peak over which its position is averaged."""

LAYERS = {
    "half": (4, 3, 16), "half2": (3, 16, 24), "quarter": (3, 24, 32), "quarter2": (3, 32, 32), "eighth": (3, 32, 64),
    "eighth2": (3, 64, 64), "up_quarter": (1, 64, 32), "merge_quarter": (3, 32, 32), "up_half": (1, 32, 24),
    "merge_half": (3, 24, 24),
}  # fmt: skip
"""Convolutions: side, channels in, channels out."""


class Detections(NamedTuple):
    """P points in n frames: float32 [n, P, 2] in pixels (column, row), and the confidence that each is there, [n, P] in
    [0, 1]."""

    position: jax.Array
    confidence: jax.Array


def init_detector(key: jax.Array, robots: int, points: int) -> DetectorParams:
    """Weights for `robots` robots with at most `points` points, and frames whose sides are multiples of 8 pixels."""
    shapes = {name: (side, side, a, b) for name, (side, a, b) in LAYERS.items()}
    shapes["heads"] = (robots, LAYERS["merge_half"][2], points)
    weights = {}
    for name, shape in shapes.items():
        key, own = jax.random.split(key)
        fan_in = shape[-2] * (shape[0] * shape[1] if len(shape) == 4 else 1)
        weights[name] = jax.random.normal(own, shape, jnp.float32) * (2.0 / fan_in) ** 0.5
        weights[name + "_bias"] = jnp.zeros(shape[-1], jnp.float32)
    return weights | {"heads_bias": jnp.full((robots, points), -4.0, jnp.float32)}


def _conv(weights: DetectorParams, name: str, x: jax.Array, stride: int = 1) -> jax.Array:
    dims = ("NHWC", "HWIO", "NHWC")
    out = jax.lax.conv_general_dilated(x, weights[name], (stride, stride), "SAME", dimension_numbers=dims)
    return out + weights[name + "_bias"]


def _twice(x: jax.Array) -> jax.Array:
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)


def heat_logits(weights: DetectorParams, images: jax.Array, robot_n: jax.Array) -> jax.Array:
    """Heat logits [n, H / 2, W / 2, P] of frames [n, H, W, 3] in 0..255."""
    act = jax.nn.relu
    x = images.astype(jnp.float32) / 127.5 - 1.0
    half = act(_conv(weights, "half2", act(_conv(weights, "half", x, 2))))
    quarter = act(_conv(weights, "quarter2", act(_conv(weights, "quarter", half, 2))))
    eighth = act(_conv(weights, "eighth2", act(_conv(weights, "eighth", quarter, 2))))
    x = act(_conv(weights, "merge_quarter", act(quarter + _twice(_conv(weights, "up_quarter", eighth)))))
    x = act(_conv(weights, "merge_half", act(half + _twice(_conv(weights, "up_half", x)))))
    heat = jnp.einsum("nhwc,ncp->nhwp", x, weights["heads"][robot_n])
    return heat + weights["heads_bias"][robot_n][:, None, None]


def detect(weights: DetectorParams, frames: jax.Array, robot: jax.Array) -> Detections:
    """Points in frames [n, H, W, 3] of one `robot`, its index."""
    return locate_peaks(heat_logits(weights, frames, jnp.full(len(frames), robot)))


def locate_peaks(heat: jax.Array) -> Detections:
    """Points from heat logits [n, h, w, P]: the centroid of the heat around the highest cell."""
    count, height, width, points = heat.shape
    warm = jax.nn.sigmoid(heat)
    peak = jnp.argmax(warm.reshape(count, -1, points), axis=1)  # [n, P]
    row, column = (x[:, None, None] for x in (peak // width, peak % width))
    rows, columns = jnp.arange(height)[None, :, None, None], jnp.arange(width)[None, None, :, None]
    near = (jnp.abs(rows - row) <= PEAK_RADIUS) & (jnp.abs(columns - column) <= PEAK_RADIUS)
    part = jnp.where(near, warm, 0.0)
    total = part.sum((1, 2))
    middle = jnp.stack([(part * columns).sum((1, 2)), (part * rows).sum((1, 2))], -1) / total[..., None]
    return Detections(middle * CELL + (CELL - 1) / 2, warm.max((1, 2)))


def target_heat(position: jax.Array, there: jax.Array, cells: int) -> jax.Array:
    """Target heat [n, cells, cells, P] of points at `position` [n, P, 2]: Gaussians, 0 where not `there` [n, P]."""
    at = (position - (CELL - 1) / 2) / CELL
    column, row = at[:, None, None, :, 0], at[:, None, None, :, 1]
    grid = jnp.arange(cells, dtype=jnp.float32)
    away = (grid[None, None, :, None] - column) ** 2 + (grid[None, :, None, None] - row) ** 2
    return jnp.exp(-away / (2 * HEAT_STD**2)) * there[:, None, None]


def points_loss(
    weights: DetectorParams,
    images: jax.Array,
    robot_n: jax.Array,
    position: jax.Array,
    there: jax.Array,
    known: jax.Array,
) -> jax.Array:
    """The mean cross-entropy of heat maps, above its least value, for frames [n, H, W, 3]. `position` [n, P, 2] are
    true points and `there` [n, P] says which are in the picture; only points that the robot has, `known` [n, P],
    count."""
    heat = heat_logits(weights, images, robot_n)
    wanted = target_heat(position, there, heat.shape[1])
    cost = jax.nn.softplus(heat) - wanted * heat
    least = jax.scipy.special.entr(wanted) + jax.scipy.special.entr(1 - wanted)
    asked = known[:, None, None]
    return ((cost - least) * asked).sum() / asked.sum()
