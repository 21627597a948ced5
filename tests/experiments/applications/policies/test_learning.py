"""Training of small networks: what each step is given, and what is kept."""

from functools import partial

import jax.numpy as jnp
import numpy as np

from experiments.applications.policies.learning import FitConfig, fit


def fitted(examples: int, **settings) -> dict[int, np.ndarray]:
    """{step: weights [examples]}, of which each step moves those of its examples alone."""

    def loss(params, data, index, key):
        return params["w"][index].sum()

    start, config = {"w": jnp.zeros(examples)}, FitConfig(warmup=0, **settings)
    kept = fit(start, loss, {}, examples, config, 0, lambda *_: None)
    return {step: params["w"] for step, params in kept.items()}


def test_every_step_draws_its_own_examples():
    moved = np.count_nonzero(fitted(10_000, steps=8, batch=2, ema=0.0)[8])
    assert moved == 16


def test_what_is_kept_is_the_average_of_weights_which_forgets_the_first_ones_sooner():
    run = partial(fitted, 1, steps=4, batch=1, keep=(0, 1, 2, 3))
    weights, kept, average = run(ema=0.0), run(ema=0.15), 0.0
    for n in range(4):
        decay = min(0.15, n / (n + 10))
        average = decay * average + (1 - decay) * weights[n + 1]
        np.testing.assert_allclose(kept[n + 1], average, rtol=1e-5)
    assert kept[0] == weights[0] == 0
