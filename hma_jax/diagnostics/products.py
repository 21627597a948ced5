"""Which matrix products a program consists of, and how often each is computed.

The rest of a program (softmax, norms, copies, the optimiser) takes time on top: what its products take, each
measured alone, is what no arrangement of it can go below.
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
    """One `jax.lax.dot_general`: shapes of its factors, which axes are summed over and which run along."""

    left: tuple[int, ...]
    right: tuple[int, ...]
    summed: tuple[Axes, Axes]
    along: tuple[Axes, Axes]
    dtype: str

    @property
    def flops(self) -> float:
        """Two per multiply-add."""
        free = [n for axis, n in enumerate(self.right) if axis not in (*self.summed[1], *self.along[1])]
        return 2.0 * math.prod(self.left) * math.prod(free)

    @property
    def matrices(self) -> tuple[int, int, int, int]:
        """(how many products side by side, rows, summed values, columns)."""
        count = math.prod(self.left[axis] for axis in self.along[0])
        inner = math.prod(self.left[axis] for axis in self.summed[0])
        rows = math.prod(self.left) // max(count * inner, 1)
        columns = math.prod(self.right) // max(count * inner, 1)
        return count, rows, inner, columns

    def __call__(self, left: jax.Array, right: jax.Array) -> jax.Array:
        return jax.lax.dot_general(left, right, (self.summed, self.along))


def count_products(function: Callable[..., Any], *args: Any) -> Counter[Product]:
    """How often `function` of arguments like `args` computes each product.

    What no result needs is not counted. Of a condition's branches the one with most operations counts, and the
    body of a loop whose length is not known beforehand counts once.
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
    summed, along = (tuple(left_summed), tuple(right_summed)), (tuple(left_along), tuple(right_along))
    return Product(left.shape, right.shape, summed, along, str(left.dtype))


def _inner(equation: JaxprEqn) -> Iterator[Jaxpr]:
    for value in equation.params.values():
        for one in value if isinstance(value, (tuple, list)) else (value,):
            if isinstance(one, ClosedJaxpr):
                yield one.jaxpr
            elif isinstance(one, Jaxpr):
                yield one
