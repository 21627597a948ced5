"""A small network that finds what is in a robot's frames: points by heatmaps, and the action between two frames.

One trunk for all robots, an output of its own for each. The peak of a point's heatmap says whether it is there at all,
the cells around the peak where. Two frames in a row say which action moved what: what is read is compared with what was
commanded. Pure functions of arrays; who trains it, and on what, is not its business.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

Weights = dict[str, jax.Array]

CELL = 2
"""Pixels of a frame per cell of a heatmap."""

SPREAD = 1.0
"""Standard deviation of a point's heat, in cells."""

AROUND = 2
"""Cells on each side of the peak that say where it is."""

LAYERS = {
    "half": (4, 3, 16), "half2": (3, 16, 24), "quarter": (3, 24, 32), "quarter2": (3, 32, 32), "eighth": (3, 32, 64),
    "eighth2": (3, 64, 64), "up_quarter": (1, 64, 32), "merge_quarter": (3, 32, 32), "up_half": (1, 32, 24),
    "merge_half": (3, 24, 24), "motion": (1, 64, 16),
}  # fmt: skip
"""Convolutions: side, channels in, channels out."""

HIDDEN = 64
"""Units that read an action."""


class Found(NamedTuple):
    """P points in n frames: float32 [n, P, 2] in pixels (column, row), and [n, P] in [0, 1], how sure that it is there."""

    position: jax.Array
    confidence: jax.Array


def init_detector(key: jax.Array, robots: int, points: int, actions: int, size: int) -> Weights:
    """For `robots` robots of at most `points` points and `actions` action values, and square frames of `size` pixels,
    a multiple of 8."""
    shapes = {name: (side, side, a, b) for name, (side, a, b) in LAYERS.items()}
    cells = (size // 8) ** 2
    shapes |= {"hidden": (cells * 2 * LAYERS["motion"][2], HIDDEN)}
    shapes |= {"heads": (robots, LAYERS["merge_half"][2], points), "read": (robots, HIDDEN, actions)}
    weights = {}
    for name, shape in shapes.items():
        key, own = jax.random.split(key)
        fan_in = shape[-2] * (shape[0] * shape[1] if len(shape) == 4 else 1)
        weights[name] = jax.random.normal(own, shape) * (2.0 / fan_in) ** 0.5
        if name not in ("heads", "read"):
            weights[name + "_bias"] = jnp.zeros(shape[-1])
    return weights | {"heads_bias": jnp.full((robots, points), -4.0), "read_bias": jnp.zeros((robots, actions))}


def _conv(weights: Weights, name: str, x: jax.Array, stride: int = 1) -> jax.Array:
    dims = ("NHWC", "HWIO", "NHWC")
    out = jax.lax.conv_general_dilated(x, weights[name], (stride, stride), "SAME", dimension_numbers=dims)
    return out + weights[name + "_bias"]


def _twice(x: jax.Array) -> jax.Array:
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)


def look(weights: Weights, images: jax.Array, robot_n: jax.Array) -> tuple[jax.Array, jax.Array]:
    """(heat logits [n, H / 2, W / 2, P], features [n, H / 8, W / 8, 64]) of frames [n, H, W, 3] in 0..255."""
    act = jax.nn.relu
    x = images.astype(jnp.float32) / 127.5 - 1.0
    half = act(_conv(weights, "half2", act(_conv(weights, "half", x, 2))))
    quarter = act(_conv(weights, "quarter2", act(_conv(weights, "quarter", half, 2))))
    eighth = act(_conv(weights, "eighth2", act(_conv(weights, "eighth", quarter, 2))))
    x = act(_conv(weights, "merge_quarter", act(quarter + _twice(_conv(weights, "up_quarter", eighth)))))
    x = act(_conv(weights, "merge_half", act(half + _twice(_conv(weights, "up_half", x)))))
    heat = jnp.einsum("nhwc,ncp->nhwp", x, weights["heads"][robot_n])
    return heat + weights["heads_bias"][robot_n][:, None, None], eighth


def read_action(weights: Weights, before: jax.Array, after: jax.Array, robot_n: jax.Array) -> jax.Array:
    """The normalised action [n, U] between frames that follow each other, from the features of both."""
    seen = [jax.nn.relu(_conv(weights, "motion", x)).reshape(len(x), -1) for x in (before, after)]
    hidden = jnp.concatenate(seen, axis=-1) @ weights["hidden"] + weights["hidden_bias"]
    return jnp.einsum("nd,ndu->nu", jax.nn.relu(hidden), weights["read"][robot_n]) + weights["read_bias"][robot_n]


def watch(weights: Weights, film: jax.Array, robot: jax.Array) -> tuple[Found, jax.Array]:
    """Points in all frames of one robot's film [n + 1, H, W, 3], and the normalised actions [n, U] between them."""
    robots = jnp.full(len(film), robot)
    heat, features = look(weights, film, robots)
    return locate(heat), read_action(weights, features[:-1], features[1:], robots[1:])


def locate(heat: jax.Array) -> Found:
    """Points from heat logits [n, h, w, P]: where the heat around the highest cell has its middle."""
    count, height, width, points = heat.shape
    warm = jax.nn.sigmoid(heat)
    peak = jnp.argmax(warm.reshape(count, -1, points), axis=1)  # [n, P]
    row, column = (x[:, None, None] for x in (peak // width, peak % width))
    rows, columns = jnp.arange(height)[None, :, None, None], jnp.arange(width)[None, None, :, None]
    near = (jnp.abs(rows - row) <= AROUND) & (jnp.abs(columns - column) <= AROUND)
    part = jnp.where(near, warm, 0.0)
    total = part.sum((1, 2))
    middle = jnp.stack([(part * columns).sum((1, 2)), (part * rows).sum((1, 2))], -1) / total[..., None]
    return Found(middle * CELL + (CELL - 1) / 2, warm.max((1, 2)))


def heat_of(position: jax.Array, there: jax.Array, cells: int) -> jax.Array:
    """The heat [n, cells, cells, P] that points at `position` [n, P, 2] should have; none where not `there` [n, P]."""
    at = (position - (CELL - 1) / 2) / CELL
    column, row = at[:, None, None, :, 0], at[:, None, None, :, 1]
    grid = jnp.arange(cells, dtype=jnp.float32)
    away = (grid[None, None, :, None] - column) ** 2 + (grid[None, :, None, None] - row) ** 2
    return jnp.exp(-away / (2 * SPREAD**2)) * there[:, None, None]


def detection_loss(
    weights: Weights, images: jax.Array, robot_n: jax.Array, position: jax.Array, there: jax.Array, known: jax.Array,
    action: jax.Array, alive: jax.Array,
) -> jax.Array:  # fmt: skip
    """Of pairs of frames [2, n, H, W, 3] with points [2, n, P, 2], there or not [2, n, P], of which `known` [n, P] are
    asked, and the normalised action [n, U] between them, of which `alive` [n, U] are the robot's."""
    count = len(robot_n)
    heat, features = look(weights, images.reshape(-1, *images.shape[2:]), jnp.concatenate([robot_n, robot_n]))
    read = read_action(weights, features[:count], features[count:], robot_n)
    wanted = heat_of(position.reshape(-1, *position.shape[2:]), there.reshape(-1, there.shape[-1]), heat.shape[1])
    cost = jax.nn.softplus(heat) - wanted * heat  # cross-entropy of every cell
    floor = jax.scipy.special.entr(wanted) + jax.scipy.special.entr(1 - wanted)
    asked = jnp.concatenate([known, known])[:, None, None]
    heats = ((cost - floor) * asked).sum() / asked.sum()
    return heats + (jnp.square(read - action) * alive).sum() / alive.sum()
