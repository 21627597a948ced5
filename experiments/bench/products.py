"""The matrix products of a program, each alone: how long the program would take if nothing else took time."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from experiments.bench.models import Subject
from experiments.bench.programs import program, repeatable
from experiments.bench.record import Stage
from experiments.bench.timing import compile_call, time_by_turns
from hma_jax.diagnostics.products import Product, count_products, total_flops

LEAST_SECONDS = 0.02
"""Least duration of one timed call: a product is repeated in a loop until a call takes this long."""

ASSUMED_RATE = 1e11
"""FLOP/s by which the repetitions are chosen."""


def time_products(subject: Subject, name: str, rows: int, repeats: int) -> list[Stage]:
    """A stage for the program called `name` on `rows` windows, then one for every product in it, named by its
    shape, with the time and the operations of all its occurrences, the most expensive first."""
    found = count_products(*program(subject, name, rows=rows))
    whole = time_by_turns({name: repeatable(subject, name, rows=rows)}, repeats)[name]
    stages = []
    for product, occurrences in found.items():
        loops = max(int(LEAST_SECONDS * ASSUMED_RATE / max(product.flops, 1)), 1)
        factors = [jnp.ones(shape, product.dtype) for shape in (product.left, product.right)]
        call = compile_call(_repeated(product, loops), *factors)
        timing = time_by_turns({"": lambda c=call, f=factors: c(*f)}, repeats)[""].scaled(occurrences / loops)
        flops = occurrences * product.flops
        stages.append(Stage(shape_of(product, occurrences), rows, timing, call.compile_seconds, flops=flops))
    stages.sort(key=lambda stage: -stage.timing.median)
    return [Stage(name, rows, whole, flops=total_flops(found)), *stages]


def shape_of(product: Product, occurrences: int) -> str:
    """Occurrences, number of products batched in one call, then rows, summed values and columns."""
    count, *sizes = product.matrices
    return f"{occurrences} times {count} of " + " x ".join(map(str, sizes))


def _repeated(product: Product, loops: int) -> Callable[[jax.Array, jax.Array], jax.Array]:
    def call(left: jax.Array, right: jax.Array) -> jax.Array:
        def body(_: int, carry: tuple[jax.Array, ...]) -> tuple[jax.Array, ...]:
            # Without the barrier the factors would be the same every time, and the product would be moved out of the
            # loop.
            left, right, _ = carry
            return jax.lax.optimization_barrier((left, right, product(left, right)))

        out = jax.eval_shape(product, left, right)
        return jax.lax.fori_loop(0, loops, body, (left, right, jnp.zeros(out.shape, out.dtype)))[2]

    return call
