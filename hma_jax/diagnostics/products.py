"""Which matrix products a program contains, and how often each is computed.

The rest of a program (softmax, norms, copies, the optimiser) takes additional time, so the time of its products, each
measured alone, is a lower bound.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn
from jax.interpreters import partial_eval

Axes = tuple[int, ...]


@dataclass(frozen=True)
class Product:
    """One `jax.lax.dot_general`: the shapes of its factors, their contracting axes and their batch axes."""

    left: tuple[int, ...]
    right: tuple[int, ...]
    contracting: tuple[Axes, Axes]
    batch: tuple[Axes, Axes]
    dtype: str

    @property
    def flops(self) -> float:
        """Two per multiply-add."""
        free = [n for axis, n in enumerate(self.right) if axis not in (*self.contracting[1], *self.batch[1])]
        return 2.0 * math.prod(self.left) * math.prod(free)

    @property
    def matrices(self) -> tuple[int, int, int, int]:
        """(batch size, rows, contracted values, columns)."""
        count = math.prod(self.left[axis] for axis in self.batch[0])
        inner = math.prod(self.left[axis] for axis in self.contracting[0])
        rows = math.prod(self.left) // max(count * inner, 1)
        columns = math.prod(self.right) // max(count * inner, 1)
        return count, rows, inner, columns

    def __call__(self, left: jax.Array, right: jax.Array) -> jax.Array:
        return jax.lax.dot_general(left, right, (self.contracting, self.batch))


def count_products(function: Callable[..., Any], *args: Any) -> Counter[Product]:
    """How often `function`, called with arguments like `args`, computes each product.

    Dead code is not counted. For a `cond`, the branch with the most operations counts; the body of a `while` loop
    counts once.
    """
    jaxpr = jax.make_jaxpr(function)(*args).jaxpr
    needed, _ = partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    return _count(needed)


def total_flops(products: Counter[Product]) -> float:
    return sum(times * product.flops for product, times in products.items())


def _count(jaxpr: Jaxpr) -> Counter[Product]:
    found: Counter[Product] = Counter()
    for equation in jaxpr.eqns:
        name = equation.primitive.name
        if name == "dot_general":
            found[_product(equation)] += 1
            continue
        inside = [_count(inner) for inner in _inner(equation)]
        if name == "cond":
            inside = [max(inside, key=total_flops)]
        for products in inside:
            for product, times in products.items():
                found[product] += times * (equation.params["length"] if name == "scan" else 1)
    return found


def _product(equation: JaxprEqn) -> Product:
    left, right = (variable.aval for variable in equation.invars)
    (left_summed, right_summed), (left_along, right_along) = equation.params["dimension_numbers"]
    contracting, batch = (tuple(left_summed), tuple(right_summed)), (tuple(left_along), tuple(right_along))
    return Product(left.shape, right.shape, contracting, batch, str(left.dtype))


def _inner(equation: JaxprEqn) -> Iterator[Jaxpr]:
    for value in equation.params.values():
        for one in value if isinstance(value, (tuple, list)) else (value,):
            if isinstance(one, ClosedJaxpr):
                yield one.jaxpr
            elif isinstance(one, Jaxpr):
                yield one
