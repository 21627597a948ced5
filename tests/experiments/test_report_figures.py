"""Figures of a report and the tables beside them say the same, with errors that count what they say they count."""

import math
from dataclasses import replace
from types import SimpleNamespace

import matplotlib.pyplot as plt
import numpy as np
import pytest

from experiments.analysis.changes import find_differences
from experiments.analysis.compare import Side, overall_difference
from experiments.analysis.fits import Coefficient, PowerFit, fit_power
from experiments.analysis.isoflop import Budget, IsoFlop
from experiments.analysis.rows import TRAINING, TRAINING_LOSS, Row, curve
from experiments.analysis.scaling import Curve, CurveFit
from experiments.presets import CPU_FULL
from experiments.report import plot_fits, plots
from experiments.report.fits import describe_fits, with_constant
from experiments.report.pieces import pm
from experiments.report.plot_families import plot_family
from experiments.report.plot_names import plot_names
from experiments.report.plot_style import LogTicks, dodge, style_of
from experiments.report.plots import _draw
from experiments.report.sweeps import AxisStatistics, describe
from experiments.running.trial import trial_id
from experiments.sweeps.conditioning import plan as plan_conditioning
from experiments.sweeps.episodes import plan as plan_episodes
from experiments.sweeps.lr_horizon import plan as plan_lr_horizon
from experiments.sweeps.sweep import CONTROL, POINT, Sweep, unique_trials
from experiments.sweeps.width import plan as plan_width
from tests.experiments.analysis.curves import measured, power, sizes
from tests.experiments.fakes import PROVENANCE
from tests.experiments.judged import WIDE, windows_of


def rows_of(sweep: Sweep, metrics) -> list[Row]:
    """Finished rows of every point; `metrics`(point) gives {metric: mean}."""
    return [
        Row(
            sweep=sweep.name, x=p.x, label=sweep.label(p.x), role=p.role, series=p.series, seed=p.trial.train.seed,
            trial=trial_id(p.trial, PROVENANCE), status="finished", scope="overall", metric=metric, mean=mean, sem=0.1,
            n=80, episodes=40, parameters=100, train_flops=1.0, store="", manifest="", tokenizer="",
        )  # fmt: skip
        for p in sweep.points
        for metric, mean in metrics(p).items()
    ]  # fmt: skip


def test_the_best_rate_of_the_figure_is_that_of_the_nats():
    """It was that of the release's perplexity, which a few hard robots decide: the table beside it said another."""
    sweep = plan_lr_horizon(CPU_FULL)
    low, middle, _ = sorted({p.x for p in sweep.points})
    rows = rows_of(sweep, lambda p: {"cross_entropy": 4 + (p.x != middle), "perplexity": 80 - 20 * (p.x == low)})
    figure = plot_family(rows, sweep)
    panel = next(a for a in figure.axes if a.get_ylabel() == "perplexity: exp of the mean nats")
    stars = [line for line in panel.lines if line.get_marker() == "*"]
    assert len(stars) == 2
    for star in stars:
        assert star.get_xdata()[0] == pytest.approx(middle, rel=0.05) and star.get_ydata()[0] == pytest.approx(
            math.e**4
        )
        assert star.get_markerfacecolor() != "white"


def test_tables_have_nats_beside_the_perplexity():
    sweep = plan_conditioning(CPU_FULL)
    said = describe(sweep, rows_of(sweep, lambda _: {"cross_entropy": 4.1, "perplexity": 75.0}))
    assert (
        "".join(f"<th scope=col>{h}</th>" for h in ("nats per token", "minus the default", "perplexity", "seeds"))
        in said
    )


def test_a_difference_over_fewer_seeds_than_the_mean_beside_it_is_said_to_be():
    """Of one seed beside a default of three it contradicted the two means, even in sign, and nothing said why."""
    sweep = plan_conditioning(replace(WIDE, ablation_seeds=(0, 1, 2)))
    rows = rows_of(sweep, lambda p: {"cross_entropy": 4 + 0.1 * p.trial.train.seed})
    fewer = [r for r in rows if r.x == sweep.reference_x or r.seed == 0]
    for own, told in ((rows, False), (fewer, True)):
        said = describe(sweep, own)
        assert ("the difference is over the seeds that both have" in said) == told


def test_errors_of_variants_count_seeds_and_episodes():
    """They were those of seeds alone, since all are judged on the same windows; but how much a variant helps differs
    from episode to episode."""
    sweep = plan_conditioning(replace(WIDE, ablation_seeds=(0, 1, 2)))
    windows = {id: windows_of(trial) for id, trial in unique_trials([sweep], PROVENANCE).items()}
    rows = rows_of(sweep, lambda p: {"delta_psnr": 0.3 + 0.01 * p.trial.train.seed})
    differences = find_differences([sweep], PROVENANCE, windows)
    assert {c.last for c in differences} == set(range(len(sweep.labels))) - {sweep.reference_x}

    def side(x: float) -> Side:
        own = [p.trial for p in sweep.points if p.x == x and p.role == POINT]
        return Side("", {t.train.seed: windows[trial_id(t, PROVENANCE)] for t in own}, "")

    d = overall_difference(side(0), side(sweep.reference_x), "delta_psnr", sweep.scope)
    said = describe(sweep, rows, AxisStatistics(differences=differences))
    assert f"<td>{'+' * (d.mean > 0)}{pm(d.mean, d.sem)}</td>" in said
    [point] = [p for p in curve(rows, sweep.name, "delta_psnr") if p.x == 0]
    assert point.sem > 5 * point.seed_sem and f"<td>{pm(point.mean, point.sem)}</td>" in said
    assert "standard errors over seeds and episodes" in said and "adds nothing" not in said
    figure = plot_names(rows, sweep)
    low, high = figure.axes[0].containers[0].lines[2][0].get_segments()[0][:, 0]
    assert high - low == pytest.approx(2 * point.sem) and "s.e. over seeds and episodes" in figure.get_supxlabel()


def test_the_error_of_a_training_loss_is_over_seeds_alone():
    """It joined the scatter of single steps, which is within that of seeds: rates that all seeds told apart had bars
    that lay over each other."""
    sweep = plan_lr_horizon(CPU_FULL)
    x = max(p.x for p in sweep.points)
    rows = [
        replace(r, scope=TRAINING, sem=0.07, mean=4 + 0.01 * r.seed, episodes=0)
        for r in rows_of(sweep, lambda _: {TRAINING_LOSS: 4.0})
    ]
    rows += rows_of(sweep, lambda _: {"cross_entropy": 4.0})
    series = next(r.series for r in rows)
    point = next(p for p in curve(rows, sweep.name, TRAINING_LOSS, scope=TRAINING, series=series) if p.x == x)
    assert len(point.seeds) == 3 and point.sem == point.seed_sem < 0.01
    assert "of the training loss over seeds" in plot_family(rows, sweep).get_supxlabel()
    of_one = [r for r in rows if r.seed == 0]
    alone = next(p for p in curve(of_one, sweep.name, TRAINING_LOSS, scope=TRAINING, series=series))
    assert alone.sem == pytest.approx(0.07)
    assert "s.e. over episodes, of the training loss over steps;" in caption_of(plot_family(of_one, sweep))


def test_points_of_one_seed_are_hollow_and_said_to_be():
    """Their bars lack the spread of seeds, and looked the surest of all."""
    sweep = plan_lr_horizon(CPU_FULL)
    _, middle, last = sorted({p.x for p in sweep.points})
    rows = [r for r in rows_of(sweep, lambda p: {"cross_entropy": 4 + (p.x != middle)}) if r.x < last or r.seed == 0]
    figure = plot_family(rows, sweep)
    faces = [c.lines[0].get_markerfacecolor() == "white" for c in figure.axes[0].containers]
    assert faces == [False, True] * 2 and "hollow: one seed, over episodes" in caption_of(figure)
    figure = plot_family([r for r in rows if r.seed == 0], sweep)
    assert caption_of(figure).startswith("bars, one seed: s.e. over episodes;")
    stars = [line for line in figure.axes[-1].lines if line.get_marker() == "*"]
    assert stars and all(star.get_markerfacecolor() == "white" for star in stars)
    names = plan_conditioning(CPU_FULL)
    of_names = [r for r in rows_of(names, lambda _: {"cross_entropy": 4.0}) if r.x > 0 or r.seed == 0]
    figure = plot_names(of_names, names)
    dots = [line.get_markerfacecolor() == "white" for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert dots == [True] + [False] * (len(names.labels) - 1)
    assert "hollow dot: one seed, over episodes" in caption_of(figure)


def caption_of(figure):
    return " ".join(figure.get_supxlabel().split())


@pytest.mark.parametrize("plan", [plan_lr_horizon, plan_conditioning])
@pytest.mark.parametrize("metrics", [("cross_entropy",), ("cross_entropy", "delta_psnr", TRAINING_LOSS)])
def test_a_caption_lies_within_its_figure(plan, metrics):
    """Of one panel and of two."""
    sweep = plan(CPU_FULL)
    last = max(p.x for p in sweep.points)
    rows = [r for r in rows_of(sweep, lambda _: dict.fromkeys(metrics, 4.0)) if r.x < last or r.seed == 0]
    figure = (plot_names if sweep.labels else plot_family)(rows, sweep)
    figure.canvas.draw()
    box = figure._supxlabel.get_window_extent()
    assert 0 < box.x0 and box.x1 < figure.bbox.width and "one seed, over episodes" in caption_of(figure)


@pytest.mark.parametrize("others", [4.0, 2.7e18])
@pytest.mark.parametrize("plan", [plan_width, plan_lr_horizon, plan_conditioning])
def test_a_loss_whose_exp_no_float_holds_is_left_out_of_figures_which_say_so(plan, others, tmp_path, monkeypatch):
    """Of a learning rate that is far too high: finite in nats. It kept the whole study from having a page."""
    sweep, kept = plan(CPU_FULL), []
    worst = max(p.x for p in sweep.points)
    rows = rows_of(sweep, lambda p: {"cross_entropy": 800.0 if p.x == worst else others})
    monkeypatch.setattr(plots, "save", lambda figure, _: kept.append(figure))
    plots.plot_sweep(rows, sweep, tmp_path / "figure.png")
    kept[0].canvas.draw()
    high = len({(r.trial, r.x) for r in rows if r.mean > 100})
    (tally,) = {title for panel in kept[0].axes if (title := panel.get_title(loc="right"))}
    assert tally.endswith(f" trials, perplexity of {high} too high to draw")
    plt.close(kept[0])


def test_errors_of_tables_without_episodes_are_said_to_be_over_windows():
    """As that of results/ablations."""
    sweep = plan_conditioning(CPU_FULL)
    rows = [replace(r, episodes=0) for r in rows_of(sweep, lambda _: {"cross_entropy": 4.0})]
    assert "bars: s.e. over seeds and windows;" in plot_names(rows, sweep).get_supxlabel()
    figure, panel = plt.subplots()
    _draw(panel, [replace(r, label="", seed=0) for r in rows], replace(sweep, labels=()), "perplexity")
    assert "one seed: s.e. over windows" in panel.get_legend_handles_labels()[1]
    plt.close(figure)


def test_variants_without_a_seed_in_common_have_no_difference():
    sweep = plan_conditioning(CPU_FULL)
    of_default = {p.trial.train.seed for p in sweep.points if p.x == sweep.reference_x}
    alone = min(of_default)
    rows = [
        r for r in rows_of(sweep, lambda _: {"cross_entropy": 4.0}) if (r.seed == alone) == (r.x == sweep.reference_x)
    ]
    said = describe(sweep, rows)
    assert "<td>–</td>" in said and "nan" not in said


def test_several_curves_are_shown_with_their_controls():
    sweep = plan_episodes(CPU_FULL)
    rows = rows_of(sweep, lambda p: {"cross_entropy": 5.3 if p.role == CONTROL else 4.0, "perplexity": 90.0})
    figure = plot_family(rows, sweep)
    label = "4,000 steps, shuffled actions, one seed"
    [bars] = [c for c in figure.axes[0].containers if c.get_label() == label]
    at = sorted({p.x for p in sweep.points if p.role == CONTROL})
    assert bars.lines[0].get_xdata().tolist() == at and bars.lines[0].get_ydata() == pytest.approx([math.exp(5.3)] * 2)
    said = describe(sweep, rows)
    of_controls = said.split("<h4>4,000 steps, shuffled actions</h4>")[1]
    assert all(f"<th scope=row class=text>{x:,}</th>" in of_controls for x in at) and pm(5.3, 0.1) in of_controls


def test_a_curve_s_table_has_its_controls():
    sweep = plan_width(CPU_FULL)
    said = describe(sweep, rows_of(sweep, lambda _: {"cross_entropy": 4.0}))
    assert all(
        f"<th scope=row class=text>{p.x:,}, shuffled actions</th>" in said for p in sweep.points if p.role == CONTROL
    )


def test_a_table_without_a_finished_trial_has_the_columns_of_frames():
    from experiments.sweeps.width import plan

    said = describe(plan(CPU_FULL), [])
    assert "perplexity</th>" in said and "error of actions" not in said


@pytest.mark.parametrize(
    ("low", "high"),
    [(27, 66), (33, 72), (26.4, 95), (1.04, 1.6), (0.011, 0.9), (2, 9), (1e-10, 1), (2e-13, 30), (1e-40, 1e4)],
)
def test_a_log_axis_has_a_tick_near_each_of_its_ends(low, high):
    """The best variants stood left of the first one."""
    ticks, near = LogTicks().tick_values(low, high), (high / low) ** 0.2
    assert low <= ticks[0] <= low * near and high / near <= ticks[-1] <= high and 3 <= len(ticks) <= 9


@pytest.mark.parametrize("count", [2, 3, 5])
def test_curves_are_told_apart_without_colours_and_seen_on_white(count):
    styles = [style_of(i, count) for i in range(count)]
    assert len({style["marker"] for style in styles}) == count
    for style in styles:
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in style["color"][:3]]
        assert 1.05 / (np.dot(linear, (0.2126, 0.7152, 0.0722)) + 0.05) >= 3  # WCAG 2.1, of graphics
    moved = [dodge([1.0, 100.0], i, count, [1.0, 100.0]) for i in range(count)]
    assert len({x for x, _ in moved}) == count and all(0.9 < x < 1.1 for x, _ in moved)


def curve_fit(fit: PowerFit, points) -> CurveFit:
    return CurveFit(Curve("width", fit.axes, ()), points, fit)


@pytest.mark.parametrize("doubts", [(), ("points lie off the curve (F = 14.9): not of this form",)])
def test_a_fit_that_is_doubtful_is_drawn_so(doubts, tmp_path, monkeypatch):
    points = measured(sizes(6), power(sizes(6), 2.0, (1.0, 0.5)), 1e-3, 3, np.random.default_rng(0))
    fit, kept = replace(fit_power(points, 20), doubts=doubts), []
    monkeypatch.setattr(plot_fits, "save", lambda figure, _: kept.append(figure))
    plot_fits.plot_fits([curve_fit(fit, points)], [], tmp_path / "fits.png")
    panel = kept[0].axes[0]
    lines = {line.get_label(): line.get_linestyle() for line in panel.lines}
    assert lines["fit, all points" + ", doubtful" * bool(doubts)] == ("--" if doubts else "-")
    assert [t.get_text() for t in panel.texts] == [d.split(":")[0] for d in doubts]


def test_whether_a_prediction_holds_can_be_seen(tmp_path, monkeypatch):
    """The star of what was observed covered the interval that it was to be judged by."""
    points = measured(sizes(6), power(sizes(6), 2.0, (1.0, 0.5)), 1e-3, 3, np.random.default_rng(0))
    fit, kept = fit_power(points, 20), []
    x, loss = points.x.max(), float(fit.at(np.array([[points.x.max()]]))[0])
    predicted = SimpleNamespace(curve="width", x=(x,), mean=loss, low=0.99 * loss, high=1.01 * loss)
    monkeypatch.setattr(plot_fits, "save", lambda figure, _: kept.append(figure))
    plot_fits.plot_fits(
        [curve_fit(fit, points)], [SimpleNamespace(prediction=predicted, observed=0.995 * loss)], tmp_path / "fits.png"
    )
    kept[0].canvas.draw()
    for panel, star_at in zip(kept[0].axes, (0.995 * loss, 100 * math.log(0.995)), strict=True):
        (star,) = (line for line in panel.lines if line.get_label() == "observed")
        assert star.get_ydata()[0] == pytest.approx(star_at)
        ends = panel.containers[0].lines[2][0].get_segments()[0]
        pixels = panel.transData.transform([star.get_xydata()[0], *ends])
        assert abs(pixels[0, 0] - pixels[1, 0]) > star.get_markersize() / 2 * kept[0].dpi / 72
    low, high = panel.containers[0].lines[2][0].get_segments()[0][:, 1]
    assert (low, high) == pytest.approx((100 * math.log(0.99), 100 * math.log(1.01)))


def test_a_best_size_that_is_doubtful_is_drawn_and_said_to_be(tmp_path, monkeypatch):
    best, kept = Coefficient("N_opt", 2e4, 1.9e4, 2.1e4), []
    budget = Budget(
        1e12, np.array([1e4, 2e4, 4e4]), np.array([4.0, 3.9, 4.0]), np.array([0.1, 0.0, 1.36]), 9.9, best, best
    )
    more = replace(budget, flops=2e12, loss=np.array([4.1, 4.0, 3.9]))
    law = Coefficient("a", 0.28, 0.22, 0.35)
    fit = IsoFlop((budget, replace(more, misfit="sizes lie off")), law, 1.0, law, 1.0, replace(APART, low=-0.1))
    monkeypatch.setattr(plot_fits, "save", lambda figure, _: kept.append(figure))
    plot_fits.plot_isoflop(fit, tmp_path / "isoflop.png")
    left, right = kept[0].axes
    stars = [line.get_markerfacecolor() == "white" for line in left.lines if line.get_marker() == "*"]
    assert stars == [False, True] and line_of_parabolas(right) == "--"
    assert "1 of its 2 best sizes is doubtful" in describe_fits([], fit, [], "")
    assert "doubtful" not in describe_fits([], replace(fit, budgets=(budget, more)), [], "")


def line_of_parabolas(panel) -> str:
    (line,) = (line for line in panel.lines if line.get_label().startswith("parabola: "))
    return line.get_linestyle()


def test_crosses_are_named_where_no_law_is_drawn_whose_legend_does(tmp_path, monkeypatch):
    best, kept = Coefficient("N_opt", 2e4, 1.9e4, 2.1e4), []
    sizes, loss = np.array([1e4, 2e4, 4e4]), np.array([4.0, 3.9, 4.0])
    budget = Budget(1e12, sizes, loss, np.array([0.1, 0.0, 1.36]), 9.9, best, best)
    monkeypatch.setattr(plot_fits, "save", lambda figure, _: kept.append(figure))
    plot_fits.plot_isoflop(IsoFlop((budget,), refused="1 of 1 budgets"), tmp_path / "isoflop.png")
    assert kept[0].get_supxlabel() == "crosses: by three sizes"


@pytest.mark.parametrize("low", [1e4 + 1e-10, 1.1e4])
def test_an_interval_that_does_not_hold_its_value_is_drawn(low, tmp_path):
    """By rounding with one seed and one held-out episode, where all bootstraps are equal: no page was written."""
    best = Coefficient("N_opt", 1e4, low, 1.2e4)
    budget = Budget(1e12, np.array([9e3, 1e4, 2e4]), np.array([4.0, 3.9, 4.0]), np.ones(3), 9.2, best, best)
    plot_fits.plot_isoflop(IsoFlop((budget,), refused="1 of 1 budgets"), tmp_path / "isoflop.png")
    points = measured(sizes(6), power(sizes(6), 2.0, (1.0, 0.5)), 1e-3, 3, np.random.default_rng(0))
    predicted = SimpleNamespace(curve="width", x=(1e5,), mean=2.3, low=2.3 * low / 1e4, high=2.8)
    outcome = SimpleNamespace(prediction=predicted, observed=None)
    plot_fits.plot_fits([curve_fit(fit_power(points, 5), points)], [outcome], tmp_path / "fits.png")
    assert {path.name for path in tmp_path.iterdir()} == {"isoflop.png", "fits.png"}


APART = Coefficient("difference", 0.19, 0.1, 0.3)


def test_a_growth_of_the_best_size_that_three_sizes_do_not_have_is_drawn_and_said_to_be_doubtful(tmp_path, monkeypatch):
    """Of the exponent alone: of no budget anything is doubtful."""
    best, law, kept = Coefficient("N_opt", 2e4, 1.9e4, 2.1e4), Coefficient("a", 0.28, 0.22, 0.35), []
    sizes, loss, parabola = np.array([1e4, 2e4, 4e4]), np.array([4.0, 3.9, 4.0]), np.array([0.1, 0.0, 1.36])
    first, last = (Budget(flops, sizes, loss, parabola, 9.9, best, best) for flops in (1e12, 2e12))
    fit = IsoFlop((first, replace(last, loss=loss[[2, 0, 1]])), law, 1.0, replace(law, value=0.09), 1.0, APART)
    monkeypatch.setattr(plot_fits, "save", lambda figure, _: kept.append(figure))
    plot_fits.plot_isoflop(fit, tmp_path / "isoflop.png")
    assert line_of_parabolas(kept[0].axes[1]) == "--" and "doubtful" in kept[0].get_supxlabel()
    said = describe_fits([], fit, [], "")
    assert "How the best size grows is doubtful: as C<sup>0.28</sup>" in said and "as C<sup>0.09</sup>" in said
    assert (
        "The three sizes around each best one alone give 0.09, another exponent by more than the bootstraps scatter."
        in said
    )


@pytest.mark.parametrize(("high", "interval"), [(3.1e-4, ""), (1.4, " <span class=sem>[0, 1.4]</span>")])
def test_an_E_at_the_bound_of_the_search_is_no_number(high, interval):
    """The page had 0.000314 [0.000314, 0.000314] of it."""
    coefficients = (Coefficient("E", 3.1e-4, 3.1e-4, high), Coefficient("A", 7.5, 7.4, 7.6), Coefficient("alpha", 0.082, 0.08, 0.084))  # fmt: skip
    fit = PowerFit(("training steps",), ("t",), coefficients=coefficients)
    fitted = curve_fit(fit, SimpleNamespace(value=np.array([3.14, 4.4])))
    said = describe_fits([fitted], None, [], "")
    assert "<td class=text>L = 7.5 x<sup>\u22120.082</sup></td>" in said
    assert f"<td class=text>0 (at the bound){interval}</td>" in said and "0.00031" not in said
    assert fit.formula() == "L = 0.00031 + 7.5 x^-0.082"  # as predictions keep it
    formula, constant, _ = with_constant(fitted)  # as `hma fit` prints it
    assert (formula, constant) == ("L = 7.5 x^-0.082", "0 (at the bound)")


@pytest.fixture(autouse=True)
def _closed():
    yield
    plt.close("all")
