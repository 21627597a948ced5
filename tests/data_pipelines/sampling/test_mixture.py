from __future__ import annotations

import json

import numpy as np
import pytest

from data_pipelines.errors import DataError
from data_pipelines.sampling.mixture import make_mixture, mixture_weights
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import GOLDEN


def test_weights_equal_the_official_sampler():
    cases = json.loads((GOLDEN / "11_tables" / "sampler_weights.json").read_text())
    for case in cases:
        ours = mixture_weights(case["sizes"], case["temperature"])
        np.testing.assert_allclose(ours, case["weights"], rtol=1e-12)
    assert len(cases) > 5


def test_weights_grow_with_the_cube_root():
    assert mixture_weights([1000, 1], tau=3).tolist() == pytest.approx([10 / 11, 1 / 11])


def test_empty_datasets_are_dropped_with_their_reason():
    mixture = make_mixture({"a": 8, "b": 0, "c": 1}, 3.0, {"b": "too short"})
    assert mixture.names == ("a", "c") and mixture.dropped == {"b": "too short"}
    assert mixture.weights == pytest.approx((2 / 3, 1 / 3))


def test_nothing_left_is_an_error_with_all_reasons():
    with pytest.raises(DataError, match="a: too short; b: skipped"):
        make_mixture({"a": 0, "b": 0}, 3.0, {"a": "too short", "b": "skipped"})


@pytest.mark.parametrize("tau", [0.01, 0.001])
def test_the_smallest_temperatures_draw_the_largest_alone(tau):
    """Where the powers of the others, or of all, are too small for a number."""
    assert mixture_weights([10, 10**6, 10], tau).tolist() == [0, 1, 0]
    assert mixture_weights([5, 5, 5], tau).tolist() == pytest.approx([1 / 3, 1 / 3, 1 / 3])


def test_temperature_must_be_positive():
    with pytest.raises(ConfigError, match="tau must be positive"):
        mixture_weights([1, 2], 0)
