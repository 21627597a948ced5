"""What the page and the terminal warn of."""

import pytest

from experiments.applications.judging.doubts import describe_order, doubts_of_rates
from experiments.applications.judging.summary import COMPARED, CONTROL, MODEL, REFERENCE

UNKNOWN = {"mean": None, "low": None, "high": None}
MODEL_NAME, CONTROL_NAME = (next(name for name, at in COMPARED.items() if at == column) for column in (MODEL, CONTROL))


def summary(model: dict, control: dict) -> dict:
    """As of a judgement whose only doubt may be the order of its policies."""
    order = {MODEL_NAME: model, CONTROL_NAME: control}
    return {
        "agreement": {name: {"policies and starts": {"spearman": x}} for name, x in order.items()},
        "above the control": {"mean": 0.5, "low": 0.4, "high": 0.6},
        "own": [],
        "compared with": REFERENCE,
        "policies": {f"cloned-{i}": {REFERENCE: {"mean": 0.1 * i}} for i in range(9)},
    }


def interval(mean: float, low: float, high: float) -> dict:
    return {"mean": mean, "low": low, "high": high}


def test_a_control_that_orders_policies_as_the_model_does_is_told():
    """The committed judgement of the drawer: other episodes' actions open it, too, and better policies' more often."""
    doubtful = summary(interval(0.96, 0.72, 1.0), interval(0.95, 0.46, 1.0))
    said = "Spearman's correlation is 0.95 in the control, 0.96 (0.72 to 1.00) in the model."
    assert said in describe_order(doubtful) and doubts_of_rates(doubtful) == [describe_order(doubtful)]


@pytest.mark.parametrize("control", [interval(-0.35, -0.9, 0.5), UNKNOWN])
def test_a_control_of_another_order_or_none_is_no_doubt(control):
    assert doubts_of_rates(summary(interval(0.96, 0.72, 1.0), control)) == []


def test_an_order_without_an_interval_is_not_compared():
    assert describe_order(summary(interval(0.96, None, None), interval(0.95, None, None))) == ""
