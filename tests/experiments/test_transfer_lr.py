"""The transfer of learning rates: a fair comparison, and optima that say when they cannot be trusted."""

import csv
import math
from dataclasses import replace

import pytest

from experiments.analysis.optima import Optimum, as_good, cross_validated_penalties, find_optima
from experiments.analysis.rows import TRAINING, TRAINING_LOSS, CurvePoint, curve, read_csv
from experiments.presets import CPU, PRESETS, SMOKE
from experiments.report.draw import draw
from experiments.report.plots import plot_sweep
from experiments.report.sweeps import _transfer
from experiments.report.validity import _optima
from experiments.study import TransferConfig
from experiments.sweeps import lr
from experiments.sweeps.registry import plan_sweeps
from experiments.sweeps.sweep import POINT, STANDARD, unique_trials
from experiments.user_input.override import override
from hma_jax.config import ConfigError
from hma_jax.config.json import diff
from hma_jax.model.attention import attention_scale
from tests.experiments.fakes import PROVENANCE, STUDY, finished_study, record_of, rows_of

RATE = STUDY.train.optimizer.learning_rate


def rows_with(root, broken=None, study=STUDY):
    return rows_of(finished_study(root, study, broken, axes=("lr",)), [lr.plan(study)])


def optima_of(rows, metric="cross_entropy"):
    """{(role, series): optimum}"""
    found = find_optima(rows, [lr.plan(STUDY)])
    return {(o.role, o.series): o for o in found if o.metric == metric}


@pytest.mark.parametrize("study", PRESETS.values(), ids=PRESETS)
def test_both_parametrisations_are_one_function_at_the_base_width(study):
    sweep = lr.plan(study)
    mup, standard = (
        {(p.series, p.x, p.trial.train.seed): p.trial for p in sweep.points if p.role == role}
        for role in (POINT, STANDARD)
    )
    assert mup.keys() == standard.keys()
    for place, trial in mup.items():
        same = place[0] == sweep.base
        assert diff(trial, standard[place]) == ([] if same else ["model.mup.enabled: True -> False"])
    grid = study.transfer
    widths = len(grid.widths or study.widths)
    assert len(unique_trials([sweep], PROVENANCE)) == (2 * widths - 1) * grid.rates * len(study.seeds)
    # Sharing the trials is right only if switching muP off changes nothing there.
    trial = next(t for (series, *_), t in mup.items() if series == sweep.base)
    off = replace(trial.model, mup=replace(trial.model.mup, enabled=False))
    assert trial.model.width_multiplier == off.width_multiplier == 1.0
    assert attention_scale(trial.model) == pytest.approx(attention_scale(off), rel=1e-12)


def test_rates_surround_that_of_the_study():
    rates = sorted({p.x for p in lr.plan(CPU).points})
    assert rates == pytest.approx([1e-3, 2e-3, 4e-3, 8e-3, 16e-3])
    assert rates[2] == CPU.train.optimizer.learning_rate
    higher = sorted({p.x for p in lr.plan(override(CPU, ("transfer.shift=2",))).points})
    assert higher == pytest.approx([4e-3, 8e-3, 16e-3, 32e-3, 64e-3])


def test_the_horizon_s_curves_are_of_trained_models(tmp_path):
    """The reference among its trials measures what an untrained model says, too, which is no curve of rates."""
    workspace = finished_study(tmp_path, STUDY, axes=("lr_horizon",))
    draw(workspace, record_of(axes=("lr_horizon",)))
    found = list(csv.DictReader(workspace.optima.open()))
    assert {row["role"] for row in found} == {POINT} and len({row["series"] for row in found}) == 2
    assert (workspace.figures / "lr_horizon.png").exists()


@pytest.mark.parametrize("axis", ["lr", "lr_horizon"])
def test_a_grid_of_which_every_trial_diverged_is_drawn(axis, tmp_path):
    """A log scale of no number ended in a ValueError of matplotlib."""
    workspace = finished_study(tmp_path, STUDY, axes=(axis,), broken={"": "diverged"})
    (sweep,) = plan_sweeps(STUDY, (axis,))
    plot_sweep(rows_of(workspace, [sweep]), sweep, tmp_path / "lr.png")
    assert (tmp_path / "lr.png").read_bytes().startswith(b"\x89PNG")


def test_the_smaller_trial_is_as_declared():
    trial = lr.plan(CPU).points[0].trial
    assert trial.train.steps == CPU.transfer.steps < CPU.train.steps
    assert trial.datasets == trial.evaluated == CPU.dataset_names()[: CPU.transfer.datasets]


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("transfer.rates=4", "must be odd"),
        ("transfer.factor=1", "larger than 1"),
        ("transfer.widths=16,8", "must increase"),
        ("transfer.steps=0", "transfer.steps must be at least 1"),
        ("transfer.widths=8,16", "at least three"),
        ("transfer.widths=8,32,64", "base_width 16 among them"),
    ],
)
def test_a_grid_that_cannot_work_is_refused(setting, message):
    with pytest.raises(ConfigError, match=message):
        lr.plan(override(SMOKE, [setting]))


def test_optima_line_up_with_mup_and_cost_nothing(tmp_path):
    rows = rows_with(tmp_path)
    optima = optima_of(rows)
    for series in ("width 8", "width 16", "width 32"):
        found = optima[POINT, series]
        assert (found.x, found.penalty, found.edge) == (RATE, 0.0, "")
    wide = optima[STANDARD, "width 32"]
    assert wide.x == RATE / 2 and wide.transferred_x == RATE and wide.moved == -1 and wide.penalty > 0.05
    assert optima[STANDARD, "width 16"].penalty == 0.0  # its own optimum
    assert wide.penalty_low < wide.penalty < wide.penalty_high
    training = optima_of(rows, TRAINING_LOSS)
    assert training[STANDARD, "width 8"].penalty == pytest.approx(0.1)


@pytest.mark.parametrize("moved", [-2, -1, 1, 2])
def test_an_optimum_at_an_end_of_the_grid_leaves_open_how_far_the_best_rate_moves(moved):
    """It was looked for among those alone that moved furthest, or not at all."""
    base, inside = (
        Optimum("lr", "cross_entropy", POINT, f"width {x}", x, "", 1.0, 0.1, x, x, step, 1.0, 0.0, 0.0, 0.0)
        for x, step in ((1.0, 0), (4.0, 2))
    )
    other = replace(inside, series="width 64", moved=moved)
    span = max(moved, 2) - min(moved, 0)
    within = f"3 widths is at most 2 steps from that of the base width, and moves by {span} steps in all"
    assert f"{within} (held-out loss)" in _transfer([base, inside, other], "width")
    said = _transfer([base, inside, replace(other, edge="edge")], "width")
    assert f"{within}, some at an end of the grid or not told from it, so perhaps further" in said


def test_whether_the_best_rate_lies_inside_is_open_until_seeds_tell_it_from_the_ends(tmp_path):
    """By one seed it was inside, and by a second one, which told as little of the ends, at an end of the grid."""
    rows = rows_with(tmp_path)
    grid, series = sorted({r.x for r in rows}), ("width 8", "width 16", "width 32")
    above = {x: 0.1 * abs(i - 2) for i, x in enumerate(grid)}

    def checked(noise, seeds=(0, 1)):
        """Of curves that are lowest in the middle, but for what `noise` of seed 1 and x adds."""
        changed = [
            replace(r, mean=1 + above[r.x] + noise(r.x) * r.seed) if r.metric == "cross_entropy" else r
            for r in rows
            if r.seed in seeds
        ]
        optima = find_optima(changed, [lr.plan(STUDY)])
        (check,) = _optima(optima, changed)
        return check, _transfer(optima, "width")

    check, said = checked(lambda x: 0, seeds=(0,))
    assert check.verdict == "open" and check.text == f"Told by one seed only for {', '.join(series)}."
    assert "all told by one seed only" in said
    check, said = checked(lambda x: 0)
    assert check.verdict == "good" and "one seed" not in said
    check, said = checked(lambda x: 0.15 * (x != grid[2]) * (-1) ** grid.index(x))
    assert check.verdict == "open" and check.text.startswith("Not told from one at an end for width 8")
    check, said = checked(lambda x: -9 * (x == grid[0]))
    assert check.verdict == "bad" and check.text == f"At an end of the grid for {', '.join(series)}."


def point(x: float, *losses: float) -> CurvePoint:
    return CurvePoint(x, sum(losses) / len(losses), 0.0, 0.0, dict(enumerate(losses)), (100,))


def test_rates_that_seeds_do_not_tell_apart_are_as_good():
    best = point(2.0, 1.00, 1.10, 1.20)
    behind = point(4.0, 1.05, 1.15, 1.25)  # by as much on each seed, whatever the seeds' own level
    ahead_once = point(1.0, 1.02, 1.09, 1.23)
    assert as_good([ahead_once, best, behind], best, {1.0, 2.0, 4.0}) == (1.0, 2.0)
    alone = point(2.0, 0.9)
    assert as_good([point(1.0, 1.0), alone], alone, {1.0, 2.0}) == (2.0, 2.0), (
        "one seed tells nothing: the best alone stands"
    )


def test_what_is_as_good_ends_where_a_rate_is_worse_and_where_seeds_scatter_or_have_no_number():
    grid = {1.0, 2.0, 4.0, 8.0, 16.0}
    best = point(4.0, 1.00, 1.10, 1.20)
    near, worse, far = point(8.0, 1.02, 1.09, 1.23), point(2.0, 1.05, 1.15, 1.25), point(1.0, 0.99, 1.11, 1.22)
    assert as_good([far, worse, best, near], best, grid) == (4.0, 8.0), "a rate beyond one that is told"
    # By their own error seeds that scatter by as much as they are behind tell nothing: t = 2.3 of 2.9.
    wild = point(16.0, 1.05, 2.00, 2.20)
    assert as_good([worse, best, near, wild], best, grid) == (4.0, 8.0)
    beyond = replace(near, x=16.0)
    assert as_good([worse, best, near, beyond], best, grid) == (4.0, 16.0)
    assert as_good([worse, best, beyond], best, grid) == (4.0, 4.0), "a rate beyond one that diverged or did not run"


def test_a_rate_that_is_as_good_at_an_end_of_the_grid_leaves_an_edge(tmp_path):
    """The lowest mean alone was looked at, though one seed's best was the last rate."""
    rows = rows_with(tmp_path)
    grid = sorted({r.x for r in rows})
    wanted = {0: (0.3, 0.2, 0.1, 0.0, -0.02), 1: (0.36, 0.26, 0.16, 0.0, 0.03)}

    def lowered(r):
        flat = (r.role, r.series, r.metric, r.scope) == (STANDARD, "width 8", "cross_entropy", "overall")
        return replace(r, mean=1.0 + wanted[r.seed][grid.index(r.x)]) if flat else r

    found = optima_of([lowered(r) for r in rows])[STANDARD, "width 8"]
    assert (found.x, found.near_high, found.edge) == (grid[-2], grid[-1], "edge")


def test_what_is_as_good_does_not_reach_over_a_rate_without_a_result(tmp_path):
    """While the sweep ran, and for good where a trial failed, it reached the end of the grid beyond."""
    rows = rows_with(tmp_path, {f"width 8 · seed {s} · learning rate 0.002, no muP": "failed" for s in (0, 1)})
    grid = sorted({r.x for r in rows})
    wanted = {0: (0.3, 0.2, 0.0, None, -0.02), 1: (0.36, 0.26, 0.0, None, 0.03)}

    def level(r):
        flat = (r.role, r.series, r.metric, r.scope) == (STANDARD, "width 8", "cross_entropy", "overall")
        return replace(r, mean=1.0 + wanted[r.seed][grid.index(r.x)]) if flat else r

    found = optima_of([level(r) for r in rows])[STANDARD, "width 8"]
    assert (found.x, found.near_high, found.edge) == (grid[2], grid[2], "open")


def test_a_best_rate_is_inside_the_grid_only_where_a_rate_on_either_side_is_told_to_be_worse(tmp_path):
    """What is as good ends at a rate of one seed or without a result, and so it was said to be inside."""
    rows = rows_with(tmp_path)
    grid = sorted({r.x for r in rows})

    def checked(wanted, gone):
        """Of width 8 with {seed: loss by rate}, without the results that are `gone`, (x, seed) or its status."""
        changed = []
        for r in rows:
            own = (r.role, r.series) == (POINT, "width 8")
            if own and (r.x, r.seed) in gone:
                r = replace(r, status=gone[r.x, r.seed], metric="", scope="", mean=math.nan)
            elif own and (r.metric, r.scope) == ("cross_entropy", "overall"):
                r = replace(r, mean=1.0 + wanted[r.seed][grid.index(r.x)])
            changed.append(r)
        optima = find_optima(changed, [lr.plan(STUDY)])
        (check,) = _optima(optima, changed)
        return check, _transfer(optima, "width")

    beside = dict.fromkeys((0, 1), (0.5, 0.4, 0.3, 0.0, 0.0001))
    check, said = checked(beside, {})
    assert check.verdict == "good" and "perhaps further" not in said
    check, said = checked(beside, {(grid[-1], 1): "running"})
    assert check.verdict == "open" and "perhaps further" in said
    assert check.text == (
        "On one side no rate is told to be worse, as one there has one seed or no result, for width 8."
    )
    apart = {0: (0.3, 0.2, 0.0, 0.1, -0.02), 1: (0.36, 0.26, 0.0, 0.1, 0.03)}
    for status, verdict in (("failed", "open"), ("diverged", "good")):
        check, _ = checked(apart, {(grid[3], seed): status for seed in (0, 1)})
        assert check.verdict == verdict, status


def test_what_a_choice_costs_is_judged_on_seeds_that_it_was_not_made_by():
    """Of noise alone, the lowest of several losses would always seem to gain; the choice of other seeds does not."""
    own = [point(1.0, 1.0, 1.2, 1.1), point(2.0, 1.2, 1.0, 1.1)]
    base = [point(1.0, 0.5, 0.5, 0.5), point(2.0, 0.9, 0.9, 0.9)]
    # Left out 0 the others choose 2, which costs it 0.2; left out 1 they choose 1, which costs 0.2; the base stays at
    # 1.
    assert cross_validated_penalties(own, base) == pytest.approx([-0.2, 0, 0])
    assert cross_validated_penalties([point(1.0, 1.0), point(2.0, 2.0)], base) == []
    clear = [point(1.0, 1.3, 1.4, 1.5), point(2.0, 1.0, 1.1, 1.2)]
    assert cross_validated_penalties(clear, base) == pytest.approx([0.3, 0.3, 0.3])


def test_a_rate_at_which_a_seed_of_the_base_diverged_is_not_its_best_for_others(tmp_path):
    """Its other seeds have the lowest loss there, and so every curve paid for a rate that nobody would take."""
    rows = rows_with(tmp_path, study=replace(STUDY, seeds=(0, 1, 2)))
    grid = sorted({r.x for r in rows})
    losses = {"width 16": (1.3, 1.2, 1.1, 1.0, 0.9), "width 32": (1.3, 1.2, 1.1, 1.0, 1.6)}

    def changed(r):
        if r.role == STANDARD and r.series == "width 16" and r.x == grid[-1] and r.seed == 0:
            return replace(r, status="diverged", metric="", scope="", mean=math.nan)
        of_curve = (r.role, r.metric, r.scope) == (STANDARD, "cross_entropy", "overall") and r.series in losses
        return replace(r, mean=losses[r.series][grid.index(r.x)]) if of_curve else r

    found = optima_of([changed(r) for r in rows])[STANDARD, "width 32"]
    assert (found.x, found.transferred_x, found.moved) == (grid[-2], grid[-2], 0)
    assert (found.penalty, found.penalty_low, found.penalty_high) == (0, 0, 0)


def test_an_optimum_at_the_end_of_the_grid_is_marked(unrendered, tmp_path):
    study = replace(STUDY, transfer=TransferConfig(rates=3, widths=(8, 16, 32)))
    workspace = finished_study(tmp_path, study, axes=("lr",))
    draw(workspace, record_of(study, axes=("lr",)))
    optima = optima_of(read_csv(workspace.results))
    assert optima[STANDARD, "width 32"].edge == optima[STANDARD, "width 8"].edge == "edge"
    assert optima[POINT, "width 32"].edge == ""
    with open(workspace.optima, newline="") as file:
        marked = {(line["role"], line["series"]) for line in csv.DictReader(file) if line["edge"]}
    assert marked == {("standard", "width 8"), ("standard", "width 32")}
    assert "0.0005 <span class=failed>edge</span>" in workspace.report.read_text()


def test_divergence_bounds_the_grid_and_costs_everything(unrendered, tmp_path):
    """One seed that diverges is enough to rule a rate out, and a diverged neighbour is no edge."""
    broken = {"width 32 · seed 1 · learning rate 0.001, no muP": "diverged",
              "width 8 · seed 0 · learning rate 0.004, no muP": "diverged"}  # fmt: skip
    workspace = finished_study(tmp_path, broken=broken, axes=("lr",))
    draw(workspace, record_of(axes=("lr",)))
    optima = optima_of(read_csv(workspace.results))
    assert math.isinf(optima[STANDARD, "width 32"].penalty)
    assert optima[STANDARD, "width 8"].x == 2 * RATE and optima[STANDARD, "width 8"].edge == ""
    assert "<td>diverged</td>" in workspace.report.read_text()


def test_a_rate_that_was_not_tried_leaves_an_edge(tmp_path):
    broken = {f"width 8 · seed {s} · learning rate 0.004, no muP": "failed" for s in (0, 1)}
    assert optima_of(rows_with(tmp_path, broken))[STANDARD, "width 8"].edge == "edge"


def test_no_base_width_no_penalty(tmp_path):
    optima = optima_of(rows_with(tmp_path, {"width 16": "failed"}))
    assert (POINT, "width 8") in optima and (POINT, "width 16") not in optima
    assert all(math.isnan(o.penalty) for o in optima.values())


def test_final_loss_is_the_mean_of_the_last_tenth(tmp_path):
    rows = rows_with(tmp_path)
    points = curve(rows, "lr", TRAINING_LOSS, POINT, TRAINING, "width 8")
    assert [p.x for p in points] == pytest.approx([RATE / 4, RATE / 2, RATE, 2 * RATE, 4 * RATE])
    assert points[2].mean == pytest.approx(3.5)  # of 20 steps the last two, 4 and 3
