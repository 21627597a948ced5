"""Which trials of a study make a curve, over what, and how the page shows it."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.analysis.intervals import critical
from experiments.analysis.measured import PRIOR
from experiments.analysis.scaling import (
    TRUNK,
    WINDOWS,
    curves_of,
    fit_budgets,
    fit_curve,
    fit_study,
    noise_near,
    surface_of,
    trunk_parameters,
)
from experiments.presets import CPU_FULL
from experiments.report.fits import describe_fits, fit_rows
from experiments.report.plot_fits import plot_fits, plot_isoflop
from experiments.running.trial import trial_id
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import Point, Sweep, reference_trial
from hma_jax.config import ModelConfig
from hma_jax.evaluation.windows import WindowTable
from tests.experiments.analysis.curves import measured, of_one_run, only, sizes
from tests.experiments.fakes import PROVENANCE
from tests.experiments.judged import WIDE

STEPS = (100, 300, 1000, 3000, 10000)
ROBOTS = WIDE.dataset_names()


@pytest.fixture(scope="module")
def branches():
    """Runs of six widths that were judged at five numbers of steps each, for three seeds."""
    points, windows, flops = [], {}, {}
    rng = np.random.default_rng(0)
    for width in (8, 16, 24, 32, 48, 64):
        for seed in range(3):
            luck = 1e-3 * rng.standard_normal()
            for steps in STEPS:
                base = reference_trial(WIDE, seed)
                trial = replace(
                    base, model=replace(base.model, width=width), train=replace(base.train, steps=steps, seed=seed),
                    measure_untrained=False,
                )  # fmt: skip
                id, n, d = trial_id(trial, PROVENANCE), trunk_parameters(trial.model), steps * trial.train.batch
                loss = (1 + (n / 1e3) ** -0.4 + (d / 50) ** -0.4) * np.exp(luck)
                count = 4 * len(ROBOTS)
                windows[id] = WindowTable(
                    np.repeat(ROBOTS, 4), np.tile(np.arange(4), len(ROBOTS)), np.zeros(count, int),
                    np.full(count, 4), {"cross_entropy": np.full(count, loss)},
                )  # fmt: skip
                flops[id] = 6.0 * n * d
                points.append(Point(steps, trial, series=f"width {width}"))
    return [Sweep("steps", "steps", ROBOTS, tuple(points))], windows, flops


@pytest.fixture(scope="module")
def fitted(branches):
    """(fits of these, fits at equal compute), as `fit_study` and `fit_budgets` have them."""
    sweeps, windows, flops = branches
    return (
        fit_study(sweeps, PROVENANCE, windows, draws=30),
        fit_budgets(sweeps, PROVENANCE, windows, flops, draws=30),
    )


def test_only_the_parameters_that_robots_share_count():
    one = ModelConfig(width=32, layers=2, heads=2, tokens=16)
    assert trunk_parameters(replace(one, layers=4)) == pytest.approx(2 * trunk_parameters(one), rel=0.05)
    assert trunk_parameters(replace(one, width=64)) == pytest.approx(4 * trunk_parameters(one), rel=0.1)


def test_a_width_sweep_is_a_curve_over_the_trunk():
    [curve] = curves_of(plan_sweeps(WIDE, ("width",)), PROVENANCE)
    assert curve.axes == (TRUNK,) and len(curve.positions) == 15  # five widths, three seeds; the control is none of it
    assert len({p.x for p in curve.positions}) == 5


def test_other_sweeps_keep_their_own_axis():
    curves = curves_of(plan_sweeps(WIDE, ("trajectories", "lr")), PROVENANCE)
    assert [c.name for c in curves] == ["trajectories"]  # a learning rate is no scale
    assert {p.x[0] for p in curves[0].positions} == set(WIDE.trajectory_counts)


def test_compute_is_no_power_of_the_width():
    """At equal compute the loss rises again beyond the best width; `fit_budgets` says where that is."""
    study = replace(CPU_FULL, axes=("width", "compute"))
    assert [c.name for c in curves_of(plan_sweeps(study, study.axes), PROVENANCE)] == ["width"]


@pytest.mark.parametrize("sweep", ["dilution", "transfer", "episodes", "newcomers", "fewshot"])
def test_bootstraps_draw_among_the_seeds_of_a_position(sweep):
    """Also where each seed has robots of its own, or adapts a model that was trained on such."""
    for curve in curves_of(plan_sweeps(CPU_FULL, (sweep,)), PROVENANCE):
        for x in {p.x for p in curve.positions}:
            here = [p for p in curve.positions if p.x == x]
            assert len({p.seed for p in here}) == 3 and len({p.run for p in here}) == 1, (curve.name, x)


def test_independent_trainings_are_no_branches_of_one_run():
    """The same judged robots, with one other that differs between positions: as many robots, but not the same run."""
    judged, others = ROBOTS[:1], ROBOTS[1:]
    points = tuple(
        Point(x, replace(reference_trial(WIDE, seed), datasets=(*judged, other), evaluated=judged))
        for x, other in enumerate(others, 1)
        for seed in range(3)
    )
    (curve,) = curves_of([Sweep("company", "company", judged, points)], PROVENANCE)
    assert len({p.run for p in curve.positions}) == len(others) > 1
    assert len({(p.run, p.x) for p in curve.positions}) == len(others)


def robots_of_their_own():
    """(the curve of `dilution`, windows of all its trials): three seeds, each of which judges other robots."""
    (curve,) = curves_of(plan_sweeps(CPU_FULL, ("dilution",)), PROVENANCE)
    assert len({p.scope for p in curve.positions}) == 3
    windows = {}
    for place in curve.positions:
        hard = 1 + 0.3 * place.seed
        loss = hard * (2 + (place.x[0] / 5) ** -0.7)
        robots = np.repeat(place.scope, 2)
        zeros = np.zeros(len(robots), int)
        metrics = {"cross_entropy": np.full(len(robots), loss)}
        windows[place.trial] = WindowTable(robots, np.tile([0, 1], len(place.scope)), zeros, zeros + 4, metrics)
    return curve, windows


def test_seeds_of_other_robots_without_a_common_position_are_no_curve_yet():
    """A report of trials of which each position lacks one ended there."""
    curve, windows = robots_of_their_own()
    few = {p.trial: windows[p.trial] for p in curve.positions if (p.x[0] > 10) == (p.seed == 0)}
    fitted = fit_curve(curve, few, draws=10)
    assert fitted.measured is None and "no position has a finished trial of every seed" in fitted.fit.refused


@pytest.mark.parametrize("seeds", [(0,), (0, 1), (0, 1, 2)])
def test_seeds_that_judge_other_robots_are_fitted_together(seeds):
    """How hard their robots are is taken out, by position; the shape is the same for all of them."""
    curve, windows = robots_of_their_own()
    fitted = fit_curve(curve, {p.trial: windows[p.trial] for p in curve.positions if p.seed in seeds}, draws=10)
    assert fitted.fit["alpha"].value == pytest.approx(0.7, abs=0.02)
    assert ("how hard these are is taken out" in " ".join(fitted.fit.doubts)) == (len(seeds) > 1)


def test_branches_of_widths_make_a_surface(branches, fitted):
    sweeps, windows, _ = branches
    surface = surface_of(sweeps, PROVENANCE)
    assert len(surface.positions) == len(windows) == 90
    assert surface.axes == (TRUNK, WINDOWS) and len({p.run for p in surface.positions}) == 6
    (first, *_, joint), isoflop = fitted
    assert first.curve.axes == ("steps",) and first.fit["alpha"].value == pytest.approx(0.4, abs=0.05)
    assert len(set(first.measured.run)) == 1  # one run, of which every step is a branch
    assert (joint.fit["alpha"].value, joint.fit["beta"].value) == (pytest.approx(0.4, abs=0.05),) * 2
    assert isoflop.exponent.value == pytest.approx(0.5, abs=0.15)


def test_a_study_without_branches_has_no_surface():
    assert surface_of(plan_sweeps(WIDE, ("width", "trajectories")), PROVENANCE) is None


def test_the_page_shows_fits_and_what_was_refused(branches, fitted, tmp_path):
    sweeps, windows, flops = branches
    fits, isoflop = fitted
    words = describe_fits(fits, isoflop, [], "")
    assert "N<sup>\u22120." in words and "D<sup>\u22120." in words and "The best size grows as C<sup>0." in words
    plot_fits(fits, [], tmp_path / "fits.png")
    plot_isoflop(isoflop, tmp_path / "isoflop.png")
    assert all((tmp_path / f"{n}.png").read_bytes().startswith(b"\x89PNG") for n in ("fits", "isoflop"))
    few = {id: table for id, table in windows.items() if flops[id] < 1e7}
    refused = fit_study(sweeps, PROVENANCE, few, draws=30)
    assert any(r.refused and not r.coefficient for r in fit_rows(refused, None))
    assert "No fit: " in describe_fits(refused, None, [], "")


def test_many_fits_stand_in_several_rows(branches, tmp_path, monkeypatch):
    """Beside each other they were too small to read on a page."""
    kept = []
    monkeypatch.setattr("experiments.report.plot_fits.save", lambda figure, _: kept.append(figure))
    sweeps, windows, _ = branches
    fits = [f for f in fit_study(sweeps, PROVENANCE, windows, draws=2) if len(f.curve.axes) == 1][:5]
    plot_fits(fits, [], tmp_path / "fits.png")
    (figure,) = kept
    figure.canvas.draw()
    assert len(figure.axes) == 2 * 5 and figure.get_figwidth() < 14
    assert [panel.get_title("left") for panel in figure.axes[::2]] == [f.curve.name for f in fits]
    boxes = [panel.get_window_extent() for panel in figure.axes]
    assert not any(a.overlaps(b) for i, a in enumerate(boxes) for b in boxes[:i])


@pytest.mark.parametrize("seeds", [(2, 1, 1, 1), (2, 2, 2, 2)])
def test_the_scatter_of_few_seeds_is_known_no_better_than_by_as_many(seeds):
    """A prediction's interval is made of it: of new seeds, 90 % are within 90 % of Student's t."""
    rng, inside = np.random.default_rng(0), []
    x = sizes(4)
    for _ in range(300):
        points = measured(x, np.full(4, 3.0), 0.01, 2, rng)
        points = only(points, np.array([seed < seeds[i // 2] for i, seed in enumerate(points.seed)]))
        noise, freedom = noise_near(points, x[-1])
        inside.append(abs(0.01 * rng.standard_normal()) < critical(freedom, 0.9) * noise)
    assert freedom == sum(seeds) - 4
    assert np.mean(inside) == pytest.approx(0.9, abs=0.05)


def test_the_noise_near_a_position_is_that_of_the_nearest_by_ratio():
    points = of_one_run([1, 1, 100, 100], [0, 1, 0, 1], [1.0, 1.1, 1.0, 2.0])
    assert noise_near(points, np.array([30.0]))[0] == points.noise()[2] > points.noise()[0]


def test_what_other_positions_tell_of_a_position_s_noise_counts_as_the_prior_does():
    points = of_one_run(np.repeat(np.arange(1, 11), 2), [0, 1] * 10, [1.0, 1.1] * 10)
    assert points.freedom == 10 and noise_near(points, np.array([3.0]))[1] == 1 + PRIOR
