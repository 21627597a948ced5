"""Best sizes for budgets of training FLOPs, on a law whose optimum is known."""

import numpy as np
import pytest

from experiments.analysis.isoflop import fit_isoflop
from experiments.report.fits import describe_fits, fit_rows
from tests.experiments.analysis.curves import measured, power

SIZES, BUDGETS = np.geomspace(1e4, 1e7, 7), np.geomspace(6e10, 6e12, 5)


def runs(rng, noise=1e-3, sizes=SIZES):
    """L = 1 + (N / 1e4)^-0.5 + (D / 1e4)^-0.5 at C = 6 N D: N_opt = (C / 6)^0.5."""
    x = np.array([(n, c) for n in sizes for c in BUDGETS])
    tokens = np.stack([x[:, 0], x[:, 1] / (6 * x[:, 0])], 1)
    return measured(x, power(tokens, 1.0, (1.0, 0.5), (1.0, 0.5)), noise, 3, rng)


def test_the_exponent_and_its_interval():
    fit = fit_isoflop(runs(np.random.default_rng(0)), np.geomspace(6e10, 6e12, 5), draws=100)
    assert not fit.refused and fit.exponent.low < 0.5 < fit.exponent.high
    assert fit.exponent.value == pytest.approx(0.5, abs=0.05)
    for budget in fit.budgets:
        assert budget.best.value == pytest.approx((budget.flops / 6) ** 0.5, rel=0.15)
        assert budget.best.low < budget.best.value < budget.best.high


def test_budgets_between_branches_are_interpolated():
    fit = fit_isoflop(runs(np.random.default_rng(1)), np.geomspace(1e11, 3e12, 4), draws=50)
    for budget in fit.budgets:
        tokens = np.stack([budget.sizes, budget.flops / (6 * budget.sizes)], 1)
        assert budget.loss == pytest.approx(power(tokens, 1.0, (1.0, 0.5), (1.0, 0.5)), rel=0.01)
    assert fit.exponent.value == pytest.approx(0.5, abs=0.06)
    assert [b.flops for b in fit_isoflop(runs(np.random.default_rng(1)), draws=5).budgets] == pytest.approx(
        np.geomspace(6e10, 6e12, 4)
    )


def test_a_best_size_at_the_end_is_refused():
    small = runs(np.random.default_rng(2), sizes=np.geomspace(1e3, 1e4, 5))
    fit = fit_isoflop(small, np.geomspace(6e10, 6e12, 4), draws=20)
    assert "0 of 4 budgets have a minimum" in fit.refused and fit.exponent is None
    assert all("the largest size is best" in b.refused and b.best is None for b in fit.budgets)
    assert [row.refused for row in fit_rows([], fit)] == [fit.refused, *(b.refused for b in fit.budgets)]


def test_a_loss_that_only_flattens_has_no_best_size():
    """A parabola through it has a minimum all the same."""
    sizes = np.array([16.0, 24, 32, 48, 64]) ** 2 * 20
    x = np.array([(n, c) for n in sizes for c in BUDGETS])
    loss = 3 + 1.5 * (x[:, 0] / sizes[0]) ** -1.0
    fit = fit_isoflop(measured(x, loss, 1e-3, 3, np.random.default_rng(5)), BUDGETS, draws=20)
    assert fit.exponent is None and "0 of 5 budgets" in fit.refused
    assert all("the largest size is best" in budget.refused for budget in fit.budgets)


@pytest.mark.parametrize(("steeper", "seeds"), [(0.0, 3), (0.06, 3), (0.06, 1)])
def test_sizes_off_the_parabola_are_said(steeper, seeds):
    """The best size then lies where the form puts it, within an interval that knows of seeds and episodes alone. Left
    of its minimum the loss rises as right of it, or by `steeper` more; with one seed nothing tells that from luck."""
    sizes = np.geomspace(1e4, 1e6, 5)
    x = np.array([(n, c) for n in sizes for c in BUDGETS])
    off = np.log(x[:, 0] / 1e5)
    loss = 3 * np.exp((0.02 + steeper * (off < 0)) * off**2)
    fit = fit_isoflop(measured(x, loss, 3e-3, seeds, np.random.default_rng(0)), BUDGETS, draws=100)
    assert all(b.best and not b.doubt for b in fit.budgets)
    said = ["off the parabola by more than seeds scatter (F = " in b.remarks for b in fit.budgets]
    assert all(said) if steeper and seeds > 1 else not any(said)
    page = describe_fits([], fit, [], "")
    assert page.count("off the parabola by more than seeds scatter") == sum(said)
    exponent, *best = fit_rows([], fit)
    assert ["off the parabola" in row.doubts for row in best] == said
    assert exponent.doubts.count("off the parabola") == sum(said)


def test_noise_that_leaves_no_minimum_is_said():
    fit = fit_isoflop(runs(np.random.default_rng(3), noise=0.1), np.geomspace(6e10, 6e12, 4), draws=50)
    assert any(b.doubt or b.refused for b in fit.budgets)


def test_few_sizes_or_budgets_out_of_reach_are_refused():
    rng = np.random.default_rng(3)
    assert "3 sizes" in fit_isoflop(runs(rng, sizes=np.geomspace(1e4, 1e6, 3)), draws=5).refused
    assert fit_isoflop(runs(rng), np.array([1e20]), draws=5).budgets[0].refused.startswith("0 sizes")
