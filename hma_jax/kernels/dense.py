"""Products with a weight, with one weight per robot, and look-ups in tables; gradients are written out.

On CPU the narrower factor of a weight gradient is first transposed into a copy, because XLA's products of transposed
factors are slow. A robot's gradient is summed over its examples by a product with their one-hot assignment; without a
scatter the sum is the same on every run.
"""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec

from hma_jax.runtime.sharding import BATCH, Layouts, batch_ways, is_split, mesh_axes, pinned


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def contract(x: jax.Array, w: jax.Array, axes: int = 1, dtype: jnp.dtype | None = None) -> jax.Array:
    """`jnp.tensordot` of x [..., in] and w [in, ...], whose weight gradient copies the narrower factor on CPU. With
    `axes` 2, `in` is two axes of both. The result has the type of x, or `dtype`, in which it is then summed."""
    return jnp.tensordot(x, w, axes, preferred_element_type=dtype)


def _contract_backward(
    axes: int, dtype: jnp.dtype | None, saved: tuple[jax.Array, jax.Array], dy: jax.Array
) -> tuple[jax.Array, jax.Array]:
    x, w = saved
    dy = dy.astype(x.dtype)
    outs = w.ndim - axes
    dx = jnp.tensordot(dy, w, (tuple(range(dy.ndim - outs, dy.ndim)), tuple(range(axes, w.ndim))))
    if is_split():  # a split dimension must not be merged with others
        dw = jnp.tensordot(x.reshape(-1, *w.shape[:axes]), dy.reshape(-1, *w.shape[axes:]), (0, 0))
        return dx, dw
    wide, narrow = math.prod(w.shape[:axes]), math.prod(w.shape[axes:])
    dw = _product_over_rows(x.reshape(-1, wide), dy.reshape(-1, narrow))
    return dx, dw.reshape(w.shape)


contract.defvjp(lambda *args: (contract(*args), args[:2]), _contract_backward)


def _product_over_rows(x: jax.Array, dy: jax.Array) -> jax.Array:
    """x [rows, in], dy [rows, out] -> [in, out], summed over rows."""

    def transposed(x: jax.Array, dy: jax.Array) -> jax.Array:
        if x.shape[1] <= dy.shape[1]:
            return _materialised(x.T) @ dy
        return _materialised(_materialised(dy.T) @ x).T

    return jax.lax.platform_dependent(x, dy, cpu=transposed, default=lambda x, dy: jnp.tensordot(x, dy, (0, 0)))


def _materialised(x: jax.Array) -> jax.Array:
    """x as an array in memory: XLA may not fuse its producer with its consumers."""
    return jax.lax.optimization_barrier(x)


@jax.custom_vjp
def matmul_direct_grad(x: jax.Array, w: jax.Array) -> jax.Array:
    """x [..., in] @ w [in, out], whose weight gradient is written as x^T dy.

    JAX's own rule writes it as (dy^T x)^T, for which XLA's CPU compiler first stores dy^T. Without that copy a step of
    the tokenizer takes a sixth less time. On an AMD EPYC the gradient equals that of x @ w to the last bit; that of
    `contract` does not.
    """
    return x @ w


def _matmul_direct_grad_backward(saved: tuple[jax.Array, jax.Array], dy: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, w = saved
    dw = jnp.tensordot(x.reshape(-1, w.shape[0]), dy.reshape(-1, w.shape[1]), (0, 0))
    return jnp.tensordot(dy, w, (-1, 1)), dw


matmul_direct_grad.defvjp(lambda x, w: (matmul_direct_grad(x, w), (x, w)), _matmul_direct_grad_backward)


# --- One weight per robot ------------------------------------------------------------------------


def per_robot(x: jax.Array, w: jax.Array, robot_row_B: jax.Array, layouts: Layouts | None = None) -> jax.Array:
    """x [B, ..., in] times each example's own slice of w [E, in, out], robot_row_B [B] -> [B, ..., out].

    `layouts` are those of w on a mesh. The slices are copied to their examples in the type of w. A copy is small
    beside the example's activations: D^2 numbers where those are T P D.
    """
    y = _per_robot(x.reshape(x.shape[0], -1, x.shape[-1]), w, robot_row_B, layouts)
    return y.reshape(*x.shape[:-1], y.shape[-1])


@partial(jax.custom_vjp, nondiff_argnums=(3,))
def _per_robot(x_Bni: jax.Array, w: jax.Array, robot_row_B: jax.Array, layouts: Layouts | None) -> jax.Array:
    return jnp.einsum("bri,bio->bro", x_Bni, _to_examples(w, robot_row_B, layouts))


def _per_robot_backward(
    layouts: Layouts | None, saved: tuple[jax.Array, ...], dy: jax.Array
) -> tuple[jax.Array, jax.Array, None]:
    x, w, robot_row_B = saved
    dx = jnp.einsum("bro,bio->bri", dy, _to_examples(w, robot_row_B, layouts))
    each = jax.vmap(_product_over_rows)(x, dy)
    return dx, _from_examples(each, robot_row_B, len(w), layouts), None


_per_robot.defvjp(lambda *args: (_per_robot(*args), args[:3]), _per_robot_backward)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def take_by_robot(w: jax.Array, robot_row_B: jax.Array, layouts: Layouts | None) -> jax.Array:
    """w [E, ...] -> [B, ...]: each example's own slice. `layouts` are those of w on a mesh."""
    return _to_examples(w, robot_row_B, layouts)


take_by_robot.defvjp(
    lambda *args: (take_by_robot(*args), args[:2]),
    lambda layouts, saved, dy: (_from_examples(dy, saved[1], len(saved[0]), layouts), None),
)


TO_EXAMPLES, FROM_EXAMPLES = "robots_to_examples", "examples_to_robots"
"""Scopes of the two communications in compiled programs, by which tests and profiles find them."""


def _to_examples(w: jax.Array, robot_row_B: jax.Array, layouts: Layouts | None) -> jax.Array:
    """w [E, ...] -> [B, ...]; on a mesh, from the storage layout of w to the devices that hold the examples.

    If a device has as many examples as there are robots, w is gathered; otherwise only each example's slice is sent.
    """
    if layouts is None:
        return jnp.take(w, robot_row_B, axis=0)
    storage, compute = layouts
    with jax.named_scope(TO_EXAMPLES):
        if _few(len(w), robot_row_B):
            each = jnp.take(pinned(w, None, *compute[1:]), robot_row_B, axis=0)
        else:
            each = pinned(jnp.take(w, pinned(robot_row_B, None), axis=0), _free_batch_axes(storage), *storage[1:])
        return pinned(each, BATCH, *compute[1:])


def _from_examples(each: jax.Array, robot_row_B: jax.Array, robots: int, layouts: Layouts | None) -> jax.Array:
    """The way back, of gradients: [B, ...] -> [E, ...], the sum over each robot's examples."""
    if layouts is None:
        return sum_by_robot(each, robot_row_B, robots)
    storage, _ = layouts
    with jax.named_scope(FROM_EXAMPLES):
        if not _few(robots, robot_row_B):
            each = pinned(each, _free_batch_axes(storage), *storage[1:])
        return pinned(sum_by_robot(each, robot_row_B, robots), None, *storage[1:])


def _free_batch_axes(storage: PartitionSpec) -> tuple[str, ...]:
    """The batch's mesh axes that are left for the examples when the other axes are split as in storage."""
    used = {name for part in storage[1:] for name in mesh_axes(part)}
    return tuple(name for name in BATCH if name not in used)


def _few(robots: int, robot_row_B: jax.Array) -> bool:
    return robots * batch_ways(jax.sharding.get_abstract_mesh()) <= len(robot_row_B)


CHUNK = 32
"""Action values that are multiplied at a time."""


def from_actions(x: jax.Array, w: jax.Array) -> jax.Array:
    """x [..., U] times w [U, out] -> [..., out]; padding both with zeros does not change a bit of the result.

    Chunks of a fixed size are summed one after the other, in float32 at least, so that padding adds zeros to a
    finished sum. One product over all of U would not do: kernels split a sum by its length.
    """
    chunks = jnp.moveaxis(_in_chunks(x, x.ndim - 1), -2, 0), _in_chunks(w, 0)

    def add(y: jax.Array, chunk: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        return y + jnp.matmul(*chunk, preferred_element_type=y.dtype), None

    zero = jnp.zeros((*x.shape[:-1], w.shape[-1]), jnp.promote_types(x.dtype, jnp.float32))
    return jax.lax.scan(add, zero, chunks)[0].astype(x.dtype)


def to_actions(x: jax.Array, w: jax.Array) -> jax.Array:
    """x [..., in] times w [in, U] -> [..., U], in float32 at least; more columns do not change a bit of the others."""
    columns, dtype = jnp.moveaxis(_in_chunks(w, 1), 1, 0), jnp.promote_types(x.dtype, jnp.float32)
    y = jax.lax.map(lambda chunk: jnp.matmul(x, chunk, preferred_element_type=dtype), columns)
    y = jnp.moveaxis(y, 0, -2)
    return y.reshape(*x.shape[:-1], -1)[..., : w.shape[1]]


def _in_chunks(x: jax.Array, axis: int) -> jax.Array:
    """`axis` as two, (chunks, CHUNK); padded with zeros, and at least two chunks: a loop of one would become
    another program."""
    count = max(2, -(-x.shape[axis] // CHUNK))
    padding = [(0, 0)] * x.ndim
    padding[axis] = (0, count * CHUNK - x.shape[axis])
    return jnp.pad(x, padding).reshape(*x.shape[:axis], count, CHUNK, *x.shape[axis + 1 :])


def per_robot_from_actions(
    x: jax.Array, w: jax.Array, robot_row_B: jax.Array, layouts: Layouts | None = None
) -> jax.Array:
    """`per_robot` for w [E, U, out], by `from_actions`."""
    return jax.vmap(from_actions)(x, take_by_robot(w, robot_row_B, layouts))


def per_robot_to_actions(
    x: jax.Array, w: jax.Array, robot_row_B: jax.Array, layouts: Layouts | None = None
) -> jax.Array:
    """`per_robot` for w [E, in, U], by `to_actions`."""
    return jax.vmap(to_actions)(x, take_by_robot(w, robot_row_B, layouts))


def sum_by_robot(x: jax.Array, robot_row_B: jax.Array, robots: int) -> jax.Array:
    """x [B, ...] -> [E, ...]: the sum over each robot's examples."""
    if robots == 1:
        return jnp.sum(x, axis=0, keepdims=True)
    one_hot = (jnp.arange(robots)[:, None] == robot_row_B).astype(x.dtype)
    if is_split():  # a split dimension must not be merged with others
        return jnp.tensordot(one_hot, x, 1)
    return (one_hot @ x.reshape(len(x), -1)).reshape(robots, *x.shape[1:])


# --- Tables ------------------------------------------------------------------------------------

MAX_ONE_HOT_ENTRIES = 2048
"""Larger tables get their gradient by a scatter-add instead of a product with one-hot rows."""


@jax.custom_vjp
def look_up(table: jax.Array, ids: jax.Array) -> jax.Array:
    """Rows [..., D] of a table [V, D] for ids [...].

    The gradient is summed in float32 whatever the type of the rows: a token that a batch holds a thousand
    times would lose most of its sum in bfloat16. It is a product with the ids' one-hot form, which is the same
    on every run; only large tables are scattered into.
    """
    return jnp.take(table, ids, axis=0)


def _look_up_backward(saved: tuple[jax.Array, jax.Array], dy: jax.Array) -> tuple[jax.Array, None]:
    table, ids = saved
    rows, ids = dy.reshape(-1, dy.shape[-1]), ids.ravel()
    if len(table) > MAX_ONE_HOT_ENTRIES:
        return jnp.zeros(table.shape, jnp.float32).at[ids].add(rows.astype(jnp.float32)), None
    hot = (jnp.arange(len(table))[:, None] == ids).astype(rows.dtype)
    return jnp.matmul(hot, rows, preferred_element_type=jnp.float32), None


look_up.defvjp(lambda table, ids: (look_up(table, ids), (table, ids)), _look_up_backward)
