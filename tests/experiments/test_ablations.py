"""The ablations: one thing changes at a time, the default is the reference, errors are over seeds."""

import math
import shutil
from collections import Counter
from dataclasses import replace
from typing import get_args

import pytest

from experiments.analysis.rows import curve, difference, place_rows, read_csv
from experiments.presets import CPU, PRESETS, SMOKE
from experiments.report import draw as draw_module
from experiments.report.draw import draw, draw_again
from experiments.running.trial import training_of, trial_id
from experiments.running.workspace import Workspace, save_record
from experiments.sweeps import conditioning as conditioning_axis
from experiments.sweeps import ladder as ladder_axis
from experiments.sweeps import settings as settings_axis
from experiments.sweeps import width as width_axis
from experiments.sweeps.sweep import CONTROL, POINT, reference_trial, titles, unique_trials
from hma_jax.config import Conditioning, ConfigError
from hma_jax.config.json import diff, stable_hash
from tests.experiments.fakes import PROVENANCE, STUDY, finished_study, record_of, rows_of

PLAIN = {name: study for name, study in PRESETS.items() if not study.designs.end_controls}
"""cpu-full has more controls, and ablations of its own length: test_designs.py."""

VARIANTS = len(get_args(Conditioning)) + 1
"""Of conditioning: every way, and the default with the other alignment."""


def changes(sweep, study) -> dict[str, set[str]]:
    """{name: configuration fields in which its trials differ from the reference}."""
    found = {}
    for point in sweep.points:
        if point.role == POINT:
            lines = diff(reference_trial(study, point.trial.train.seed), point.trial)
            fields = {line.split(":")[0] for line in lines} - {"measure_untrained"}
            found.setdefault(sweep.label(point.x), set()).update(fields)
    return found


def test_settings_change_the_setting_and_heads_only_where_actions_are_predicted():
    sweep = settings_axis.plan(CPU)
    assert changes(sweep, CPU) == {
        "passive": {"train.masking.setting"},
        "full dynamics": {"train.masking.setting", "model.action_heads"},
        "forward dynamics": set(),
    }
    trials = [p.trial for p in sweep.points if p.role == POINT]
    heads = {t.train.masking.setting: t.model.action_heads for t in trials}
    assert heads == {"passive": False, "full": True, "forward": False}


@pytest.mark.parametrize(("base", "other"), [("released", "causal"), ("causal", "released")])
def test_every_conditioning_and_the_other_alignment(base, other):
    study = replace(SMOKE, model=replace(SMOKE.model, action_alignment=base))
    found = changes(conditioning_axis.plan(study), study)
    assert set(get_args(Conditioning)) < set(found) and len(found) == VARIANTS
    assert found.pop("concat+modulate") == set()
    assert found.pop(f"concat+modulate, {other} alignment") == {"model.action_alignment"}
    assert set(map(frozenset, found.values())) == {frozenset({"model.conditioning"})}


def test_the_default_is_where_the_study_is():
    study = replace(SMOKE, model=replace(SMOKE.model, conditioning="add"))
    sweep = conditioning_axis.plan(study)
    assert sweep.label(sweep.reference_x) == "add"
    passive = replace(SMOKE.train.masking, setting="passive")
    study = replace(SMOKE, train=replace(SMOKE.train, masking=passive))
    sweep = settings_axis.plan(study)
    assert sweep.label(sweep.reference_x) == "passive"
    with pytest.raises(ConfigError, match="train.masking.setting is 'policy'"):
        train = replace(SMOKE.train, masking=replace(passive, setting="policy"))
        settings_axis.plan(replace(SMOKE, train=train, model=replace(SMOKE.model, action_heads=True)))


@pytest.mark.parametrize("study", PLAIN.values(), ids=PLAIN)
def test_ablations_share_the_reference_and_the_control_with_the_scaling_axes(study):
    settings, conditioning = settings_axis.plan(study), conditioning_axis.plan(study)
    assert {p.trial.train.seed for p in settings.points} == set(study.ablation_seeds)
    seeds = len(study.ablation_seeds)
    alone = study.train.masking.teacher_forcing  # the settings are trained without it
    assert not any(p.trial.train.masking.teacher_forcing for p in settings.points)
    shared = 0 if alone else seeds + 1
    assert len(unique_trials([settings, conditioning], PROVENANCE)) == (3 * seeds + 1) + (VARIANTS * seeds + 1) - shared
    width = unique_trials([width_axis.plan(study)], PROVENANCE)
    for sweep in (conditioning,) if alone else (settings, conditioning):
        shared = [p for p in sweep.points if p.x == sweep.reference_x and p.trial.train.seed in study.seeds]
        assert {p.role for p in shared} == {POINT, CONTROL}
        assert all(trial_id(p.trial, PROVENANCE) in width for p in shared)


@pytest.mark.parametrize("steps", [None, CPU.train.steps, 1000])
def test_no_rung_of_the_ladder_is_trained_twice(steps):
    """Where variants take as many steps as the study, none stands again among those that are trained for longer."""
    study = replace(CPU, designs=replace(CPU.designs, ablation_steps=steps))
    points = [p for p in ladder_axis.plan(study).points if p.role == POINT]
    trained = Counter((stable_hash(training_of(p.trial)), p.trial.train.steps) for p in points)
    assert set(trained.values()) == {1} and len(points) == 3 + 3 + 1 + 1 + 3 + 3 + 1 + (3 + 3 + 1 + 1) * (steps == 1000)


def test_published_presets_have_error_bars():
    assert all(len(PRESETS[name].ablation_seeds) >= 3 for name in ("cpu", "accelerator", "paper"))


def test_titles_tell_trials_apart():
    sweeps = [settings_axis.plan(STUDY), conditioning_axis.plan(STUDY)]
    lines = titles(sweeps, PROVENANCE)
    assert len(set(lines.values())) == len(lines) == len(unique_trials(sweeps, PROVENANCE))
    assert any(line.endswith("seed 1 · passive") for line in lines.values())


@pytest.fixture(scope="module")
def drawn(tmp_path_factory):
    """Both ablations, in which one seed of the passive model failed."""
    axes = ("settings", "conditioning")
    workspace = finished_study(tmp_path_factory.mktemp("study"), axes=axes, broken={"seed 1 · passive": "failed"})
    draw(workspace, record_of(axes=axes))
    return workspace


def test_rows_carry_the_name_of_their_place(drawn):
    rows = read_csv(drawn.results)
    names = {(r.x, r.label) for r in rows if r.sweep == "settings"}
    assert names == {(0, "passive"), (1, "full dynamics"), (2, "forward dynamics")}


def test_a_table_is_read_by_names_after_the_axis_got_another_variant(drawn, monkeypatch):
    """Without it rows of today's axis would stand at other names; those of a variant that is gone are left out."""
    then = [conditioning_axis.plan(STUDY), settings_axis.plan(STUDY)]
    monkeypatch.setattr(conditioning_axis, "KINDS", ("add", "concat+modulate", "concat", "modulate"))
    now = [conditioning_axis.plan(STUDY), settings_axis.plan(STUDY)]
    placed, gone = place_rows(rows_of(drawn, then), now)
    assert gone == ["cross_attention (axis conditioning)"]
    assert {repr(row) for row in placed} == {repr(row) for row in rows_of(drawn, now)}
    assert place_rows(placed, then)[1] == []
    nameless = [replace(row, label="") for row in placed]  # as of results/ablations
    assert place_rows(nameless, then) == (nameless, [])


def test_figures_of_a_kept_table_show_every_number_at_its_name(drawn, tmp_path, monkeypatch, capsys):
    for kept in (drawn.results, drawn.robots):
        shutil.copy(kept, tmp_path)
    save_record(Workspace(tmp_path), record_of(axes=("conditioning",)))
    monkeypatch.setattr(conditioning_axis, "KINDS", ("add", "concat+modulate", "concat", "modulate"))
    shown = []
    monkeypatch.setattr(draw_module, "draw_figures", lambda workspace, sweeps, rows: shown.append((sweeps, rows)))
    draw_again(tmp_path)
    (([sweep], rows),) = shown
    points = curve(rows, "conditioning", "perplexity")
    assert [sweep.label(p.x) for p in points] == [p.label for p in points] == list(sweep.labels)
    assert "left out, since the study no longer has it: cross_attention (axis conditioning)" in capsys.readouterr().out


def test_errors_are_over_seeds_and_differences_are_paired(drawn):
    passive, full, forward = curve(read_csv(drawn.results), "settings", "perplexity")
    assert forward.seed_sem == pytest.approx(math.sqrt(1 / 3))  # seeds 0, 1, 2 shift the fake by as much
    assert forward.sem > forward.seed_sem  # the other one has the windows in it
    assert difference(full, forward) == (pytest.approx(1.0), pytest.approx(0.0, abs=1e-9))
    assert set(passive.seeds) == {0, 2}
    assert difference(passive, forward)[0] == pytest.approx(2.0)  # without seed 1, which passive lacks
    assert math.isnan(difference(passive, replace(forward, seeds={0: 1.0}))[1])


def test_page_names_variants_and_marks_the_default(drawn):
    page = drawn.report.read_text()
    for text in ("passive", "<b>forward dynamics</b>", "<b>concat+modulate</b>", "causal alignment",
                 "<td>+0.", "default, shuffled actions", "Robots, the most controllable first", "1 trial has no result"):  # fmt: skip
        assert text in page, text
    assert "Scaling curves" not in page and not (drawn.figures / "scaling.png").exists()
    assert page.count("data:image/png;base64,") == 2 + 3 * 3  # two figures, three strips of three datasets


def test_page_of_a_model_without_perplexity(unrendered, tmp_path):
    axes = ("width", "settings", "lr")
    workspace = finished_study(tmp_path, axes=axes, without=("perplexity", "cross_entropy"))
    draw(workspace, record_of(axes=axes))
    page = workspace.report.read_text()
    shown = page.split("<details><summary>Configuration")[0]
    assert "ΔPSNR" in shown and "perplexity" not in shown
    assert {p.name for p in workspace.figures.iterdir()} == {"scaling.png", *(f"{a}.png" for a in axes)}


def test_page_of_ablations_without_any_finished_trial(tmp_path):
    axes = ("settings", "conditioning", "lr")
    workspace = finished_study(tmp_path, axes=axes, broken={"": "failed"})
    draw(workspace, record_of(axes=axes))
    assert "no trial finished" in workspace.report.read_text() and not workspace.optima.exists()
