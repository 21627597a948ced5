"""Numbers as they are printed."""

from __future__ import annotations

import math

import pytest

from experiments.report.pieces import pm
from experiments.terminal.words import counted, plus_minus


@pytest.mark.parametrize(
    ("mean", "error", "said"),
    [
        (27.1234, 5.4321, "27.1 ± 5.4"),
        (65410.47, 655.1, "65410 ± 655"),
        (0.0, 2.4e-17, "0.0000 ± 0.0000"),
        (-4.8e-07, 1e-7, "0.0000 ± 0.0000"),
        (0.5, 0.0, "0.5 ± 0"),
        (10.3456, math.nan, "10.35"),
        (math.inf, math.nan, "inf"),
        (10.3456, math.inf, "10.35"),
    ],
)
def test_a_mean_has_the_digits_that_its_error_leaves(mean, error, said):
    assert plus_minus(mean, error) == said
    assert plus_minus(mean, error, "+") == f"+{said}"


@pytest.mark.parametrize("error", [math.nan, math.inf])
def test_a_mean_of_unknown_error_stands_alone_on_the_page(error):
    assert pm(-10.3456, error) == "\u221210.35"


def test_one_thing_is_not_called_several():
    assert [counted(n, "step") for n in (0, 1, 2000)] == ["0 steps", "1 step", "2,000 steps"]
