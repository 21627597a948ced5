"""Best sizes for budgets of training FLOPs, on a law whose optimum is known."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.stats

from experiments.analysis.isoflop import _Line, _misfit, fit_isoflop
from experiments.report.fits import describe_fits, fit_rows
from tests.experiments.analysis.curves import measured, of_one_run, only, power, scaled

SIZES, BUDGETS = np.geomspace(1e4, 1e7, 7), np.geomspace(6e10, 6e12, 5)
FIVE, FOUR = np.geomspace(1e4, 1e6, 5), np.geomspace(1e12, 1e13, 4)


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


def test_one_run_that_went_wrong_leaves_the_other_seeds_their_losses():
    """Its draws pull the others away from it, but never to a loss below zero, which has no logarithm."""
    fit = fit_isoflop(scaled(runs(np.random.default_rng(0)), {0: 20.0}), np.geomspace(7e10, 5e12, 4), draws=50)
    assert all(np.isfinite([c.value, c.low, c.high]).all() for c in (fit.exponent, *(b.best for b in fit.budgets)))


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
    exponent, _, *best = fit_rows([], fit)
    best = [row for row in best if row.coefficient == "N_opt"]
    assert ["off the parabola" in row.doubts for row in best] == said
    assert exponent.doubts.count("off the parabola") == sum(said)


def saturating(steeper, world=0):
    """Losses [runs] that are lowest at one size whatever the budget; the smallest is worse than a parabola through the
    others has it, by `steeper` more with every budget."""
    sizes = np.geomspace(1e4, 1e6, 5)
    x = np.array([(n, c) for n in sizes for c in BUDGETS])
    lack = steeper * np.searchsorted(BUDGETS, x[:, 1]) * (x[:, 0] == sizes[0])
    return measured(x, 3 * np.exp(0.02 * np.log(x[:, 0] / sizes[1]) ** 2 + lack), 1e-3, 3, np.random.default_rng(world))


def test_a_best_size_that_only_a_saturating_small_one_moves_is_doubted():
    """It bends the parabola, whose minimum then moves though the lowest loss does not."""
    fit = fit_isoflop(saturating(0.02), BUDGETS, draws=100)
    assert fit.exponent.low > 0.02 and fit.near.value < fit.exponent.low
    other, still = fit.doubts
    assert f"give {fit.near.value:.2g}, another exponent by more than the bootstraps scatter" in other
    assert "31,623 trunk parameters have the lowest loss at every budget" in still and still.endswith("size grows")
    assert all(doubt in fit_rows([], fit)[0].doubts for doubt in fit.doubts)


def test_a_best_size_that_stays_where_the_lowest_loss_does_is_not_doubted():
    fit = fit_isoflop(saturating(0.0, world=1), BUDGETS, draws=100)  # in world 0 chance tells the two exponents apart
    assert fit.exponent.low < 0 < fit.exponent.high and not fit.doubts


def test_an_exponent_of_the_right_form_is_seldom_doubted():
    """The noisier estimate of three sizes was held against the interval of the other: half of all were doubted."""
    x = np.array([(n, c) for n in np.geomspace(1e4, 1e6, 9) for c in FOUR])
    loss = 3 * np.exp(0.02 * np.log(x[:, 0] / (1e5 * (x[:, 1] / FOUR.mean()) ** 0.5)) ** 2)
    doubted = [
        bool(fit_isoflop(measured(x, loss, 3e-3, 3, np.random.default_rng(world)), FOUR, draws=100).doubts)
        for world in range(20)
    ]
    assert sum(doubted) <= 4, doubted


def bowls(best, noise=3e-4):
    """Losses [runs] of five sizes that are exact parabolas, lowest at `best` [budgets of BUDGETS]."""
    x = np.array([(n, c) for n in FIVE for c in BUDGETS])
    off = np.log(x[:, 0] / np.asarray(best)[np.searchsorted(BUDGETS, x[:, 1])])
    return measured(x, 3 * np.exp(0.02 * off**2), noise, 3, np.random.default_rng(0))


def test_a_growth_that_a_refused_budget_shows_is_not_of_the_form_alone():
    """The smallest size is best at the first budget, and the next one at the others."""
    best = (1.2 * FIVE[0], *(FIVE[1] * np.array([0.95, 1.0, 1.1, 1.3])))
    fit = fit_isoflop(bowls(best), BUDGETS, draws=50)
    assert "smallest size is best" in fit.budgets[0].refused and fit.exponent.low > 0
    assert not any("lowest loss at every budget" in doubt for doubt in fit.doubts)


def test_a_best_size_that_the_form_alone_has_shrink_is_said_to_shrink():
    fit = fit_isoflop(bowls(FIVE[2] * np.array([1.4, 1.2, 1.0, 0.9, 0.8])), BUDGETS, draws=50)
    assert fit.exponent.high < 0 and fit.doubts[-1].endswith("says that the best size shrinks")


@pytest.mark.parametrize(("budgets", "found"), [((6e12,), 1), ((6e12, 1.2e13), 2)])
def test_no_law_is_made_of_one_budget_or_two_that_whole_steps_miss_by_a_little(budgets, found):
    """Four were laid between the FLOPs of its sizes, and the best size was said not to grow, with certainty."""
    x = np.array(
        [(n, c * (1 + off)) for n, off in zip(FIVE, (0, 3e-4, -2e-4, 5e-4, 1e-4), strict=True) for c in budgets]
    )
    points = measured(x, 3 * np.exp(0.02 * np.log(x[:, 0] / 9e4) ** 2), 3e-4, 3, np.random.default_rng(0))
    fit = fit_isoflop(points, draws=20)
    assert fit.exponent is None and fit.refused.startswith(f"{found} of {found} budgets")


def test_noise_that_leaves_no_minimum_is_said():
    fit = fit_isoflop(runs(np.random.default_rng(3), noise=0.1), np.geomspace(6e10, 6e12, 4), draws=50)
    assert any(b.doubt or b.refused for b in fit.budgets)


def test_few_sizes_or_budgets_out_of_reach_are_refused():
    rng = np.random.default_rng(3)
    assert "3 sizes" in fit_isoflop(runs(rng, sizes=np.geomspace(1e4, 1e6, 3)), draws=5).refused
    assert fit_isoflop(runs(rng), np.array([1e20]), draws=5).budgets[0].refused.startswith("0 sizes")


def valley(of_budget, opens=0.1):
    """Losses [runs] that are exact parabolas over log N, lowest (or, opening downwards, highest) at `of_budget` of C;
    the two seeds of a run are off by as much to either side."""
    log_loss = opens * (np.log(EXACT[:, 0]) - np.log(of_budget(EXACT[:, 1]))) ** 2
    return np.exp(log_loss) * np.tile([0.9, 1.1], len(EXACT) // 2)


GRID = np.geomspace(1e3, 1e5, 7)
EXACT = np.repeat([(n, c) for n in GRID for c in GRID[[1, 3, 5]] ** 2], 2, axis=0)


def fit_exactly(value, draw, budgets=GRID[[1, 3, 5]] ** 2):
    """With the losses `draw` as the one bootstrap."""
    return fit_isoflop(SimpleNamespace(x=EXACT, value=value, draw=lambda *_: draw[None]), budgets, draws=1)


def test_values_come_from_the_losses_and_intervals_from_the_draws():
    fit = fit_exactly(valley(lambda c: c**0.5), valley(lambda c: 1e4 * (c / 1e8) ** 0.6))
    for a in (fit.exponent, fit.near):
        assert (a.value, a.low, a.high) == pytest.approx((0.5, 0.6, 0.6))
    assert (fit.scale, fit.near_scale) == pytest.approx((1, 1))
    for budget, first in zip(fit.budgets, (0, 1, 2), strict=True):  # the best size and two on either side, or five
        assert budget.sizes == pytest.approx(GRID[first : first + 5])
        assert (budget.best.value, budget.best.low) == pytest.approx(
            (budget.flops**0.5, 1e4 * (budget.flops / 1e8) ** 0.6)
        )
        assert budget.near.value == pytest.approx(budget.best.value)
        assert budget.loss == pytest.approx(np.exp(0.1 * np.log(budget.sizes / budget.flops**0.5) ** 2))


@pytest.mark.parametrize(("top", "end"), [(9e4, 0), (1.1e3, -1)])
def test_a_draw_that_opens_downwards_is_lowest_where_it_falls_to(top, end):
    fit = fit_exactly(valley(lambda c: c**0.5), valley(lambda c: top, opens=-0.1))
    for budget in fit.budgets:
        assert budget.best.low == budget.best.high == pytest.approx(budget.sizes[end])
        assert budget.doubt == "in 100% of the bootstraps the best size is at an end"


def test_a_smallest_size_that_is_best_is_refused():
    fit = fit_exactly(valley(lambda c: 1e3), valley(lambda c: 1e3))
    assert all("the smallest size is best" in budget.refused for budget in fit.budgets)


def test_a_parabola_that_is_lowest_beyond_the_sizes_is_refused():
    """Of the losses themselves the last but one is the least: the largest size was said to be best."""
    losses = dict(zip(GRID, [1.7, 1.3, 0.9, 0.64, 0.40, 0.16, 0.17], strict=True))
    value = np.exp([losses[n] for n in EXACT[:, 0]])
    fit = fit_exactly(value, value)
    assert {budget.refused for budget in fit.budgets} == {"the parabola has no minimum between the sizes"}


def test_a_parabola_that_opens_downwards_is_refused_without_naming_a_best_size():
    losses = dict(zip(GRID, [1.3, 1.0, 1.2, 0.9, 1.2, 1.0, 1.3], strict=True))
    value = np.exp([losses[n] for n in EXACT[:, 0]])
    fit = fit_exactly(value, value)
    assert all(budget.parabola[0] < 0 for budget in fit.budgets)
    assert {budget.refused for budget in fit.budgets} == {"the parabola has no minimum between the sizes"}


def test_two_minima_make_no_exponent():
    value = valley(lambda c: c**0.5)
    fit = fit_exactly(value, value, GRID[[1, 3]] ** 2)
    assert fit.refused == "2 of 2 budgets have a minimum; the exponent needs at least 3" and fit.exponent is None


def test_a_budget_may_lie_a_tenth_beyond_what_was_measured():
    value = valley(lambda c: c**0.5)
    low, high = GRID[1] ** 2, GRID[5] ** 2
    fit = fit_exactly(value, value, np.array([0.85 * low, 0.95 * low, 1.05 * high, 1.15 * high]))
    assert [len(budget.sizes) for budget in fit.budgets] == [0, 5, 5, 0]


def test_where_one_size_has_one_seed_nothing_is_said_of_the_parabola():
    sizes = np.geomspace(1e4, 1e6, 5)
    x = np.array([(n, c) for n in sizes for c in BUDGETS])
    off = np.log(x[:, 0] / 1e5)
    points = measured(x, 3 * np.exp((0.02 + 0.06 * (off < 0)) * off**2), 3e-3, 3, np.random.default_rng(0))
    fewer = only(points, (points.seed == 0) | (points.x[:, 0] != sizes[2]))
    said = ["off the parabola" in b.remarks for p in (points, fewer) for b in fit_isoflop(p, BUDGETS, draws=50).budgets]
    assert said == [True] * 5 + [False] * 5


def test_a_misfit_has_the_freedom_of_sizes_beyond_a_parabola_s_three_and_of_seeds_beyond_each_size_s_first():
    residuals = np.zeros((5, 3))
    residuals[0], residuals[1] = np.sqrt(5), [0, 1, 1]  # squares: 5 in all of the values, 1 around them of each draw
    assert f"(F = 5.0, p = {scipy.stats.f.sf(5, 2, 10):.2g})" in _misfit(residuals, [3] * 5)


@pytest.mark.parametrize(("flops", "seeds"), [(2e3, 1), (5e5, 2)])
def test_a_size_has_the_seeds_of_its_nearest_budget_by_ratio(flops, seeds):
    points = of_one_run([(1, 1e3), (1, 1e6), (1, 1e6)], [0, 0, 1], [3.0, 2.0, 2.1])
    assert _Line(points, points.value[None], 1.0).seeds_near(flops) == seeds
