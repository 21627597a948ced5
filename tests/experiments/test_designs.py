"""The designs of `cpu-full`: what they hold fixed, whom they judge, what they share, and that they fit."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import pytest

from data_pipelines.suite.embodiments import EMBODIMENTS, TRAINED
from data_pipelines.suite.generate import episode_count
from experiments.analysis.scaling import surface_of, trunk_parameters
from experiments.dry_run.cost import plan_trials
from experiments.dry_run.preparing_cost import estimate_preparing
from experiments.presets import ACCELERATOR, CPU_FULL, PAPER
from experiments.running.trial import training_of, trial_id
from experiments.sweeps.draws import draw_judged, draw_mixture
from experiments.sweeps.episodes import count_episodes
from experiments.sweeps.registry import AXES, find_axis, plan_sweeps
from experiments.sweeps.sweep import CONTROL, POINT, reference_trial, unique_trials
from experiments.user_input.override import override
from hma_jax.config import ConfigError
from hma_jax.training.optimizer import check_schedule
from tests.experiments.fakes import PROVENANCE

FAMILY = {e.name: e.family for e in EMBODIMENTS}
SWEEPS = dict(zip(CPU_FULL.axes, plan_sweeps(CPU_FULL, CPU_FULL.axes), strict=True))
LONG = set(CPU_FULL.designs.long)
TWICE = replace(PAPER, seeds=(0, 1))
BOTH = (*SWEEPS.values(), *plan_sweeps(TWICE, TWICE.axes))


def points(axis: str, role: str = POINT):
    return [p for p in SWEEPS[axis].points if p.role == role]


POSITIONS = {
    ("datasets", "dilution", "transfer"): lambda trial: len(trial.datasets),
    ("trajectories", "fewshot"): lambda trial: trial.max_trajectories,
    ("width", "compute"): lambda trial: trial.model.width,
    ("horizon",): lambda trial: trial.train.steps,
    ("lr", "lr_horizon"): lambda trial: trial.train.optimizer.learning_rate,
}


@pytest.mark.parametrize("axes", POSITIONS, ids=" ".join)
def test_the_position_of_a_point_is_the_number_that_its_trial_has(axes):
    found = [(p.x, POSITIONS[axes](p.trial)) for sweep in BOTH for p in sweep.points if sweep.name in axes]
    assert found and all(x == number for x, number in found)


def test_every_point_is_averaged_over_robots_that_it_evaluates():
    for sweep in BOTH:
        assert all({*(p.scope or sweep.scope)} <= {*p.trial.evaluated} for p in sweep.points), sweep.name


@pytest.mark.parametrize("axis", CPU_FULL.axes)
def test_every_point_has_three_seeds(axis):
    """But for the long reference, which says that it has one."""
    seeds = Counter((p.series, p.x) for p in points(axis) if p.trial.train.steps not in LONG)
    assert set(seeds.values()) == {3}
    assert {p.trial.train.seed for p in points(axis)} == {0, 1, 2}


@pytest.mark.parametrize("axis", ["dilution", "transfer", "episodes", "width"])
def test_both_ends_of_an_axis_have_a_control(axis):
    controls = {p.x: p.trial for p in points(axis, CONTROL)}
    ends = {min(p.x for p in points(axis)), max(p.x for p in points(axis))}
    assert ends <= controls.keys() and all(t.shuffle_actions for t in controls.values())
    trained = {p.x: p.trial for p in points(axis) if p.trial.train.seed == 0 and p.trial.train.steps == 4000}
    for x, control in controls.items():
        if x in trained:
            changed = replace(control, shuffle_actions=False, measure_untrained=trained[x].measure_untrained)
            assert changed == trained[x]


@pytest.mark.parametrize("axis", ["dilution", "transfer", "episodes", "width", "horizon", "compute"])
def test_the_reference_is_a_point(axis):
    budgets = {CPU_FULL.train.steps, *CPU_FULL.designs.compute}
    references = {reference_trial(CPU_FULL, seed, n) for seed in CPU_FULL.seeds for n in budgets}
    assert len(references & {p.trial for p in points(axis)}) >= 3


def test_the_default_conditioning_is_a_branch_of_the_horizon():
    longer = unique_trials([SWEEPS["horizon"]], PROVENANCE)
    default = [p for p in points("conditioning") if p.x == SWEEPS["conditioning"].reference_x]
    assert len(default) == 3 and all(trial_id(p.trial, PROVENANCE) in longer for p in default)


def test_settings_are_compared_under_one_objective():
    """What predicts actions cannot be trained with teacher forcing, which all else is."""
    assert {p.trial.train.masking.teacher_forcing for p in points("settings")} == {False}
    assert len({p.trial.train.masking.setting for p in points("settings")}) == 3
    for axis in set(CPU_FULL.axes) - {"settings"}:
        assert {p.trial.train.masking.teacher_forcing for p in points(axis)} == {True}


def test_judged_robots_are_others_for_every_seed_and_each_of_another_family():
    drawn = [draw_judged(CPU_FULL, seed) for seed in range(20)]
    assert len(set(drawn)) == 20
    silent = {e.name for e in EMBODIMENTS if e.video_only}
    for judged in drawn:
        assert len({FAMILY[name] for name in judged}) == len(judged) == 5 and not silent & set(judged)


def test_the_axes_are_known_whose_seeds_are_judged_on_other_windows():
    assert {name for name, sweep in SWEEPS.items() if sweep.robots_vary} == {"dilution", "transfer", "newcomers"}


def test_sets_of_robots_are_nested_and_hold_the_judged():
    for seed in CPU_FULL.seeds:
        sets = [set(draw_mixture(CPU_FULL, seed, n)) for n in (5, 10, 20, 40)]
        assert sets[0] == set(draw_judged(CPU_FULL, seed)) and all(a < b for a, b in zip(sets, sets[1:], strict=False))


def test_dilution_holds_all_windows_and_transfer_those_of_the_judged():
    """Under the uniform mixture a robot's share is one over their number."""
    assert {p.trial.train.steps for p in points("dilution")} == {4000}
    assert {p.trial.train.steps / len(p.trial.datasets) for p in points("transfer")} == {100.0}
    for p in (*points("dilution"), *points("transfer")):
        assert p.scope == draw_judged(CPU_FULL, p.trial.train.seed) and set(p.scope) <= set(p.trial.evaluated)
    with pytest.raises(ConfigError, match="uniform mixture"):
        find_axis("transfer")(replace(CPU_FULL, tau=3.0))


def test_newcomers_are_whole_and_of_the_kin_that_is_said():
    sweep = SWEEPS["newcomers"]
    for p in points("newcomers"):
        judged, added = set(p.scope), set(p.trial.datasets) - set(p.scope)
        assert set(p.trial.capped) == judged and p.trial.max_trajectories == 8
        kin = {FAMILY[name] for name in added} & {FAMILY[name] for name in judged}
        label = sweep.labels[int(p.x)]
        assert not ("strangers" in label and kin)
        assert "siblings" not in label or {FAMILY[name] for name in added} <= {FAMILY[name] for name in judged}
        assert len(added) == {"alone": 0, "20": 15, "all robots": 35}[label.split(",")[0]]
        assert p.trial.train.steps == (4000 if "as long" in label else 100 * len(p.trial.datasets)), label


def test_rates_come_down_at_every_point_of_equal_compute():
    """The widest model had 512 steps at the smallest of these budgets, 500 of which warm up."""
    found = find_axis("compute")(ACCELERATOR).points
    assert {point.series for point in found} and len({point.series for point in found}) < len(
        ACCELERATOR.designs.compute
    )
    for point in found:
        check_schedule(point.trial.train.optimizer, point.trial.train.steps)


def test_every_width_spends_the_same_compute():
    plans = plan_trials(CPU_FULL, [SWEEPS["compute"]])
    for series in {p.series for p in points("compute")}:
        trials = {p.trial for p in points("compute") if p.series == series}
        spent = [plan.cost.train_flops for plan in plans.values() if plan.trial in trials]
        assert max(spent) < 1.01 * min(spent)


def test_budgets_of_compute_that_agree_in_two_digits_are_told_apart_by_more():
    """They were refused as two points at one place, with advice for an author of axes."""
    (sweep,) = plan_sweeps(override(CPU_FULL, ["designs.compute=500,510,1000"]), ("compute",))
    assert {p.series for p in sweep.points} == {"1.61e+12 FLOP", "1.64e+12 FLOP", "3.22e+12 FLOP"}


def test_the_surface_over_size_and_data_has_every_width():
    """The reference, which is judged under more actions, too."""
    surface = surface_of(list(SWEEPS.values()), PROVENANCE)
    sizes = {float(trunk_parameters(replace(CPU_FULL.model, width=width))) for width in CPU_FULL.widths}
    assert {p.x[0] for p in surface.positions} == sizes


def test_trajectories_are_counted_as_they_are():
    there = [episode_count(e, CPU_FULL.suite.scale, CPU_FULL.suite.fewest) for e in TRAINED]
    for cap in (4, 64, 10_000):
        assert count_episodes(CPU_FULL, cap) == sum(min(n, cap) for n in there)
    assert {p.x for p in points("episodes")} >= {160, sum(there)}


def test_trajectories_that_nobody_counted_are_not_counted_as_none(monkeypatch):
    """All of them stood at 0, before 4 of each; the change along the axis then had the wrong sign."""
    counts, split = {"mine": 300, "yours": 40}, {"mine": "", "yours": ""}
    monkeypatch.setattr(
        "experiments.sweeps.episodes.get_spec",
        lambda name: SimpleNamespace(name=name, episodes=counts[name], val_split=split[name]),
    )
    study = replace(CPU_FULL, datasets=tuple(counts), dataset_counts=(1, 2), unseen=(), trajectory_counts=(4, 200))

    def found() -> list[tuple[float, int | None]]:
        return sorted({p.x: p.trial.max_trajectories for p in find_axis("episodes")(study).points}.items())

    # Of the 40, 8 are held out; 256 takes none of the 200 that the reference has.
    assert found() == [(8, 4), (32, 16), (96, 64), (232, 200)]
    counts |= {"mine": 20, "yours": 20}  # 5 of each are held out: 16 and all of them were the same training twice
    assert found() == [(8, 4), (30, 200)]
    split["yours"] = "val"  # `episodes` are of both splits
    with pytest.raises(
        ConfigError, match="unknown for yours: .* leave the axis out; how many of yours are in val_split"
    ):
        find_axis("episodes")(study)
    counts["yours"], split["yours"] = 0, ""
    with pytest.raises(
        ConfigError,
        match="needs the number of training trajectories, which is unknown for yours: write `episodes` into",
    ):
        find_axis("episodes")(study)


def test_few_shots_start_from_trials_of_other_axes():
    others = unique_trials([SWEEPS["dilution"]], PROVENANCE).values()
    sources = {p.trial.source for p in points("fewshot")} - {None}
    assert sources <= set(others) and len(sources) == 9
    whole = [p for p in points("fewshot") if "everything" in p.series]
    assert len(whole) == 9 and all(p.trial.source and p.trial.train.only == () for p in whole)
    adapted = [p for p in points("fewshot") if p.trial.source and p not in whole]
    assert all(p.trial.train.only == CPU_FULL.unseen for p in adapted)


@pytest.mark.parametrize(
    ("axis", "setting", "words"),
    [
        ("dilution", "designs.counts=", r"designs.counts \(\) must begin with designs.judged, 5, and end with all 40"),
        ("transfer", "designs.counts=", r"designs.counts \(\) must begin"),
        ("transfer", "train.steps=7", "5 of 40 robots .* share of train.steps 7, which is none; set it to at least 8"),
        ("newcomers", "train.steps=7", "5 of 40 robots .* share of train.steps 7, which is none; set it to at least 8"),
        ("newcomers", "designs.kinship=40", "designs.kinship 40 robots, siblings or strangers, .* fewer than all 40"),
        ("newcomers", "designs.kinship=5", "designs.kinship 5 robots, .* more than the 5 judged"),
        ("fewshot", "designs.shots=", "designs.shots is empty"),
        ("fewshot", "designs.shots_after=", "designs.shots_after is empty"),
        ("lr_horizon", "designs.budgets=", "designs.budgets is empty"),
        ("lr_horizon", "designs.rate_factors=", "designs.rate_factors is empty"),
        ("episodes", "designs.caps=", r"none of designs.caps \(\) is:"),
        ("episodes", "designs.caps=5000", r"none of designs.caps \(5000,\) is:"),
        ("compute", "designs.compute=", r"designs.compute \(\)"),
        ("compute", "designs.compute=30", r"designs.compute \(30,\): .*trains beyond train.optimizer.warmup_steps, 30"),
    ],
)
def test_a_design_without_points_names_the_setting(axis, setting, words):
    with pytest.raises(ConfigError, match=words):
        plan_sweeps(override(CPU_FULL, [setting]), (axis,))


def test_points_that_are_the_same_are_planned_once():
    """Rows of one seed twice would look like seeds that agree."""
    study = override(CPU_FULL, ["train.steps=500", "seeds=0"])
    (sweep,) = plan_sweeps(study, ("lr_horizon",))
    assert [p.x for p in sweep.points] == pytest.approx([0.004, 0.008, 0.016]) and sweep.base == sweep.points[0].series
    (sweep,) = plan_sweeps(override(CPU_FULL, ["designs.caps=4,5000"]), ("episodes",))
    assert len({p.x for p in sweep.points}) == 2 and "at most 4 or all" in sweep.question
    alone = ["datasets=arm_night,rover_road", "designs.judged=2", "designs.counts=2"]
    (sweep,) = plan_sweeps(override(CPU_FULL, alone), ("dilution",))
    assert [p.role for p in sweep.points] == [POINT] * 3 + [CONTROL]


def test_retrieval_among_sixteen_is_asked_of_the_reference_alone():
    """At any number of steps, and of its controls."""
    runs = [training_of(p.trial) for p in SWEEPS["horizon"].points]
    runs += [run | {"shuffle_actions": True} for run in runs]
    for sweep in SWEEPS.values():
        for p in sweep.points:
            assert p.trial.eval.other_actions == (15 if training_of(p.trial) in runs else 3)
            others = replace(p.trial.eval, other_actions=15)
            assert others == CPU_FULL.eval and all(t.eval.other_actions in (3, 15) for t in p.trial.with_source())
    none = replace(CPU_FULL, eval=replace(CPU_FULL.eval, other_actions=0))
    assert {p.trial.eval.other_actions for s in plan_sweeps(none, ("width",)) for p in s.points} == {0}
    whole = replace(CPU_FULL, designs=replace(CPU_FULL.designs, other_actions=None))
    assert {p.trial.eval.other_actions for s in plan_sweeps(whole, CPU_FULL.axes) for p in s.points} == {15}


def test_questions_say_what_the_study_does():
    """Not what cpu-full does."""
    designs = replace(CPU_FULL.designs, judged=3, counts=(3, 40), kinship=9, budgets=(8000,), long=(8000, 9000))
    few = replace(CPU_FULL, designs=designs)
    for axis in ("dilution", "transfer", "newcomers"):
        question = find_axis(axis)(few).question
        assert "3 robots are judged, drawn anew" in question and "five" not in question.lower()
    branches = find_axis("horizon")(few).question
    assert "one run, whose rate decays" in branches and "Points of 9,000 steps have one seed" in branches
    cosine = replace(few.train, optimizer=replace(few.train.optimizer, schedule="cosine"))
    assert "one run" not in find_axis("horizon")(replace(few, train=cosine)).question
    assert "is too low" not in find_axis("compute")(few).question


def test_the_whole_fits_into_about_twelve_hours_of_two_cores():
    """By an estimate that said 27 minutes of the preset `cpu`, which took 21."""
    plans = plan_trials(CPU_FULL, list(SWEEPS.values()))
    seconds = estimate_preparing(CPU_FULL).seconds + sum(p.seconds for p in plans.values()) / 2
    assert 8 * 3600 < seconds < 13 * 3600
    alone = sum(p.cost.flops for p in plans.values()) / sum(p.flops for p in plans.values())
    assert alone > 1.15, "sharing runs should save a seventh of all computing"


def test_the_paper_judges_on_a_random_five_with_a_given_tokenizer():
    sweep = find_axis("datasets")(PAPER)
    assert sweep.scope == draw_judged(PAPER, 0, 5) != PAPER.datasets[:5]
    assert "judged on 5 datasets that are drawn for each seed, and see" in sweep.question
    for p in sweep.points:
        assert p.scope == sweep.scope and set(sweep.scope) <= set(p.trial.datasets)
    assert [len(p.trial.datasets) for p in sweep.points] == [5, 10, 20, 30, 40, 40]
    assert PAPER.tokenizer.kind == "magvit2" and PAPER.widths[-1] == 768
    assert set(CPU_FULL.axes) <= set(AXES)
