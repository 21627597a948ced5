import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.kernels.dense import (
    contract,
    from_actions,
    look_up,
    matmul_direct_grad,
    per_robot,
    per_robot_from_actions,
    per_robot_to_actions,
    to_actions,
)
from tests.hma_jax.kernels.test_attention import check_equal, drawn

ROBOTS = jnp.array([2, 0, 2, 3, 2])


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize(
    "x, w, axes", [((3, 4, 5), (5, 2, 7), 1), ((3, 4, 5), (5, 2), 1), ((3, 2, 5), (2, 5, 4), 2)], ids=str
)
def test_contract_has_the_gradients_of_a_tensordot(x: tuple, w: tuple, axes: int, dtype: str):
    args = drawn(0, *x, dtype=dtype), drawn(1, *w, dtype=dtype)
    check_equal(
        lambda a, b: contract(a, b, axes), lambda a, b: jnp.tensordot(a, b, axes), *args,
        tolerance=1e-5 if dtype == "float32" else 2e-2,
    )  # fmt: skip


def test_contract_sums_in_the_type_it_is_asked_for():
    x, w = jnp.full((1, 4096), 1, jnp.bfloat16), jnp.full((4096, 1), 1 + 2**-7, jnp.bfloat16)
    assert contract(x, w, 1, jnp.float32)[0, 0] == 4096 + 32
    assert contract(x, w).dtype == jnp.bfloat16


@pytest.mark.parametrize("sizes", [(48, 256), (7, 5)], ids=str)
def test_matmul_direct_grad_has_the_gradients_of_a_product_and_transposes_none(sizes: tuple):
    x, w = drawn(0, 8, 4, 16, sizes[0]), drawn(1, *sizes)
    check_equal(matmul_direct_grad, jnp.matmul, x, w, tolerance=1e-6)
    programs = [
        str(jax.make_jaxpr(jax.grad(lambda w, f=f: f(x, w).sum()))(w)) for f in (matmul_direct_grad, jnp.matmul)
    ]
    assert ["transpose[" in program for program in programs] == [False, True]


def one_by_one(x, w, robots):
    return jnp.stack([jnp.tensordot(x[i], w[robots[i]], 1) for i in range(len(x))])


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
@pytest.mark.parametrize("product", [per_robot, per_robot_from_actions, per_robot_to_actions])
@pytest.mark.parametrize("sizes", [(7, 9), (40, 5), (6, 70)], ids=str)
def test_each_example_is_multiplied_with_its_own_robot_s_matrix(product, sizes: tuple, dtype: str):
    x, w = drawn(0, 5, 3, sizes[0], dtype=dtype), drawn(1, 4, *sizes, dtype=dtype)
    tolerance = 1e-5 if dtype == "float32" else 2e-2
    check_equal(lambda x, w: product(x, w, ROBOTS), lambda x, w: one_by_one(x, w, ROBOTS), x, w, tolerance=tolerance)


@pytest.mark.parametrize("product", [per_robot, per_robot_from_actions, per_robot_to_actions])
def test_a_robot_alone_has_the_gradient_of_all_its_examples(product):
    """Summed, as that of each of several robots is."""
    x, w, robots = drawn(0, 5, 3, 7), drawn(1, 1, 7, 9), jnp.zeros(5, int)
    check_equal(lambda x, w: product(x, w, robots), lambda x, w: one_by_one(x, w, robots), x, w, tolerance=1e-5)


WIDTHS = [1, 7, 31, 33, 65, 176, 300]


@pytest.mark.exact
@pytest.mark.parametrize(
    "rows, out",
    [((4, 6), 32), *(pytest.param(*n, marks=pytest.mark.slow) for n in (((1, 1), 24), ((3, 12), 256)))],
    ids=str,
)
def test_padding_the_action_axis_changes_no_bit(rows: tuple, out: int):
    """Each width in a program of its own, padded to the next larger ones and to the largest.

    Padded by numpy, as jax.numpy would compile a program for every shape."""
    into, back = jax.jit(from_actions), jax.jit(to_actions)
    for width in WIDTHS:
        x, w, features = map(np.asarray, (drawn(width, *rows, width), drawn(1, width, out), drawn(2, *rows, out)))
        want, columns = into(x, w), back(features, w.T)
        for wider in {*WIDTHS[WIDTHS.index(width) :][1:3], WIDTHS[-1]}:
            more = wider - width
            got = into(np.pad(x, [(0, 0)] * len(rows) + [(0, more)]), np.pad(w, [(0, more), (0, 0)]))
            np.testing.assert_array_equal(got, want)
            others = np.concatenate([w.T, drawn(3, out, more)], axis=1)
            np.testing.assert_array_equal(np.asarray(back(features, others))[..., :width], columns)


def test_in_bfloat16_many_action_values_are_summed_as_in_one_product():
    """The sum of eleven chunks was rounded after each."""
    x, w = drawn(0, 64, 350, dtype="bfloat16"), drawn(1, 350, 64, dtype="bfloat16")
    exact = np.asarray(x, np.float64) @ np.asarray(w, np.float64)
    chunked, whole = (np.linalg.norm(np.asarray(f(x, w), np.float64) - exact) for f in (from_actions, jnp.matmul))
    assert from_actions(x, w).dtype == jnp.bfloat16 and chunked < 1.1 * whole


def test_actions_are_not_rounded_to_the_type_of_what_predicts_them():
    x, w = drawn(0, 4, 350, dtype="bfloat16"), drawn(1, 350, 7, dtype="bfloat16")
    y = jax.jit(to_actions)(x, w)
    assert y.dtype == jnp.float32
    np.testing.assert_allclose(y, np.asarray(x, np.float64) @ np.asarray(w, np.float64), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("entries", [5, 3000], ids=["multiplied", "scattered"])
def test_looking_up_has_the_gradient_of_a_take(entries: int):
    ids = np.random.default_rng(0).integers(0, entries, (3, 4))
    check_equal(lambda t: look_up(t, ids), lambda t: jnp.take(t, ids, axis=0), drawn(0, entries, 6), tolerance=1e-6)


def test_a_token_seen_a_thousand_times_gets_all_of_its_gradient():
    """In bfloat16 a running sum stops growing at a few hundred equal terms."""
    ids, table = jnp.zeros(4096, jnp.int32), jnp.zeros((3, 2))
    gradient = jax.grad(lambda t: jnp.sum(look_up(t, ids).astype(jnp.bfloat16)))(table)
    np.testing.assert_array_equal(gradient, [[4096, 4096], [0, 0], [0, 0]])
