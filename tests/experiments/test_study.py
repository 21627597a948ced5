"""Studies and the three plans: shared reference, nested points, stable ids."""

import dataclasses
import typing
from dataclasses import replace

import jax
import numpy as np
import pytest

from experiments.declared_table import declared_table
from experiments.dry_run.cost import ONE_ROBOT, estimate
from experiments.presets import ACCELERATOR, CPU, PAPER, PRESETS, SMOKE, get_preset
from experiments.running.provenance import Provenance
from experiments.running.trial import trial_id
from experiments.study import on_user_data, without_equal_caps
from experiments.study_setup import Preset
from experiments.sweeps import datasets, trajectories, width
from experiments.sweeps.sweep import reference_trial, unique_trials
from experiments.user_input.override import override
from hma_jax.config import ConfigError, MaskingConfig, MeshConfig, PixelsConfig
from hma_jax.config.json import from_dict, to_dict
from hma_jax.model.hma import declare_model
from hma_jax.training.optimizer import learning_rate_multiplier
from hma_jax.training.state import init_state
from hma_jax.training.step import make_train_step
from tests.data_pipelines.fakes import make_spec
from tests.tiny import TABLE, random_batch

PLANS = (datasets.plan, trajectories.plan, width.plan)
PROVENANCE = Provenance("store", "manifest", "tokenizer")
PLAIN = {name: study for name, study in PRESETS.items() if not study.designs.end_controls}
"""cpu-full has more controls, and ablations of its own length: test_designs.py."""


def test_with_the_released_gains_every_parameter_moves_at_its_rate():
    """Epsilon held back matrices whose gradients are small: in the first step of `accelerator` some moved at 2 %."""
    study = ACCELERATOR
    assert PAPER.train.optimizer.epsilon == study.train.optimizer.epsilon
    model = replace(study.model, width=64, heads=2, layers=1, frames=3, tokens=4, action_tokens=1)
    settings = replace(study.train.optimizer, warmup_steps=1, weight_decay=0.0)
    declared, train = declare_model(model, TABLE), replace(study.train, batch=4, optimizer=settings)
    state, batch = init_state(declared, TABLE, 0), random_batch(0, model, 4, TABLE)
    after, _ = jax.jit(make_train_step(declared, TABLE, model, train))(state, batch)
    still = set()
    pairs = zip(jax.tree.leaves(state.params), jax.tree.leaves(after.params), strict=True)
    for (name, spec), (old, new) in zip(declared.leaves().items(), pairs, strict=True):
        moved = np.abs(np.asarray(new) - np.asarray(old))[np.asarray(new != old)]
        rate = settings.learning_rate * learning_rate_multiplier(spec, model)
        if moved.size:
            assert np.median(moved) > 0.9 * rate, name
        else:
            still.add(name)
    assert still == {"action_mask"}  # which stands for hidden actions: here are none


@pytest.mark.parametrize("study", PLAIN.values(), ids=PLAIN)
def test_axes_share_one_reference_and_one_control(study):
    sweeps = [plan(study) for plan in PLANS]
    trials = unique_trials(sweeps, PROVENANCE)
    points = len(study.dataset_counts) + len(study.trajectory_counts) + len(study.widths) - 2
    assert len(trials) == points * len(study.seeds) + 1
    reference = trial_id(reference_trial(study, study.seeds[0]), PROVENANCE)
    assert all(any(trial_id(p.trial, PROVENANCE) == reference for p in s.points) for s in sweeps)
    assert sum(t.shuffle_actions for t in trials.values()) == 1
    assert sum(t.measure_untrained for t in trials.values()) == len(study.seeds)


def test_points_of_an_axis_are_nested_and_judged_alike():
    sweep = datasets.plan(CPU)
    trials = [p.trial for p in sweep.points if p.role == "point"]
    for small, large in zip(trials, trials[1:], strict=False):
        assert large.datasets[: len(small.datasets)] == small.datasets
    assert all(set(sweep.scope) <= set(t.evaluated) <= set(t.datasets) for t in trials)
    assert len({(t.train.steps, t.train.batch) for t in trials}) == 1  # total samples held fixed


def test_only_the_axis_changes_along_it():
    for plan, field in ((trajectories.plan, "max_trajectories"), (width.plan, "model")):
        points = [p.trial for p in plan(SMOKE).points if p.role == "point"]
        same = {f.name for f in dataclasses.fields(points[0])} - {field, "measure_untrained"}
        assert all(len({getattr(t, name) for t in points}) == 1 for name in same)
    widths = [p.trial.model for p in width.plan(SMOKE).points]
    assert len({replace(m, width=16) for m in widths}) == 1


def test_id_changes_with_everything_that_determines_a_trial():
    trial = reference_trial(replace(SMOKE, datasets=("a", "b", "c")), seed=0)
    changed = [
        replace(trial, datasets=("a", "c", "b")),
        replace(trial, max_trajectories=3),
        replace(trial, evaluated=("a",)),
        replace(trial, model=replace(trial.model, mlp_ratio=2.0)),
        replace(trial, train=replace(trial.train, seed=1)),
        replace(trial, eval=replace(trial.eval, seed=1)),
        replace(trial, tau=1.0),
        replace(trial, shuffle_actions=True),
    ]
    ids = {trial_id(t, PROVENANCE) for t in [trial, *changed]}
    ids |= {trial_id(trial, replace(PROVENANCE, **{f: "other"})) for f in ("store", "manifest", "tokenizer")}
    ids.add(trial_id(trial, replace(PROVENANCE, results=PROVENANCE.results + 1)))
    assert len(ids) == 1 + len(changed) + 4
    same = from_dict(type(trial), to_dict(trial))  # through job.json
    assert trial_id(same, PROVENANCE) == trial_id(trial, PROVENANCE)


def test_user_data_cuts_the_counts():
    study = on_user_data(CPU, ["bridge_dataset"])
    assert study.dataset_names() == ("bridge_dataset",) and study.dataset_counts == (1,)
    assert on_user_data(CPU, list("abcdefg")).dataset_counts == (5, 7)


def test_caps_that_would_train_on_the_same_data_are_no_points_of_their_own(monkeypatch):
    """The last one stays what it is: every trial is trained with it, and an entry's count may be too small."""
    sizes = {"bridge_dataset": 105, "droid_sample": 7}  # 100 and 5 to train on
    monkeypatch.setattr("experiments.study.find_spec", lambda n: replace(make_spec(n), episodes=sizes.get(n, 0)))

    def caps(*names: str, **store: int) -> tuple[int, ...]:
        study = on_user_data(replace(ACCELERATOR, store=replace(ACCELERATOR.store, **store)), names)
        return without_equal_caps(study).trajectory_counts

    assert caps("bridge_dataset", "droid_sample") == (10, 30, 1000)
    assert caps("bridge_dataset", max_val=2) == (10, 30, 100, 1000)
    assert caps("droid_sample") == (1000,)
    assert caps("droid_sample", "of_unknown_size") == ACCELERATOR.trajectory_counts


def test_the_widths_of_a_sweep_do_not_bound_a_single_model():
    study = override(CPU, ["model.width=128"])
    assert reference_trial(study, 0).model.width == 128
    points = {p.x: p.trial for p in width.plan(study).points}
    assert list(points) == [16, 32, 48, 128]
    assert points[128].model == study.model


def test_the_number_of_datasets_is_checked_by_the_axis_that_counts_them():
    study = override(SMOKE, ["datasets=a,b"])
    assert reference_trial(study, 0).datasets == ("a", "b")
    with pytest.raises(ConfigError, match=r"the last of dataset_counts \(2, 3\) must be the number of datasets, 2"):
        datasets.plan(study)


@pytest.mark.parametrize(
    ("preset", "setting", "message"),
    [
        ("smoke", "tokenizer.quantise=false", r'model takes ids; set model.diffusion=\{"channels": 8, "patch": 1\}'),
        ("smoke-continuous", "tokenizer.quantise=true", "tokenizer makes ids; set tokenizer.quantise=false"),
        ("smoke-continuous", "model.diffusion.patch=2", "32 values .*tokenizer makes 8; .*tokenizer.bits=32"),
        ("smoke-continuous", "tokenizer.bits=9", "tokenizer makes 9; set .*model.diffusion.channels=9"),
        ("smoke-continuous", "model.tokens=9", "the tokenizer makes 16"),
    ],
)
def test_model_that_takes_other_tokens_is_told_what_to_set(preset, setting, message):
    with pytest.raises(ConfigError, match=message):
        override(get_preset(preset), [setting])


@pytest.mark.parametrize(
    ("preset", "setting", "message"),
    [
        ("smoke", "eval.decode.top_k=99", "decode.top_k 99 exceeds the"),
        ("smoke-continuous", "eval.decode.order=confidence", "needs probabilities"),
        ("smoke-continuous", "model.diffusion.steps=2", "decode.sampler.steps 3 is more than model.diffusion.steps 2"),
    ],
)
def test_a_decoding_that_every_trained_trial_would_fail_at_is_refused(preset, setting, message):
    with pytest.raises(ConfigError, match=message):
        override(get_preset(preset), [setting])


def test_no_past_is_displaced_as_if_oblong_frames_were_square():
    """4 x 9 tokens were taken for 6 x 6."""
    study = get_preset("smoke-continuous")
    diffusion = replace(study.model.diffusion, channels=3, patch=8)
    oblong = replace(
        study,
        tokenizer=PixelsConfig(image_size=(32, 72), patch=8),
        model=replace(study.model, tokens=36, diffusion=diffusion),
    )
    masking = MaskingConfig(teacher_forcing=True, displaced_past=0.5)
    with pytest.raises(ConfigError, match="displaced_past needs square frames, but the tokenizer makes 4 x 9 tokens"):
        replace(oblong, train=replace(oblong.train, masking=masking))


def test_the_seed_of_a_study_s_trials_is_one_of_its_seeds():
    """`train.seed` would be replaced by each of them without a word."""
    with pytest.raises(
        ConfigError, match="train.seed cannot be set, because trials take their seeds from seeds; set seeds=3"
    ):
        override(SMOKE, ["train.seed=3"])
    assert override(SMOKE, ["seeds=3"]).seeds == (3,)
    with pytest.raises(ConfigError, match="a seed of seeds and ablation_seeds must lie in"):
        override(SMOKE, ["ablation_seeds=[0, 4294967296]"])


def test_the_advice_makes_a_study_continuous():
    study = override(SMOKE, ["tokenizer.quantise=false", 'model.diffusion={"channels": 8, "patch": 1}'])
    assert study.model.diffusion.token_channels == study.tokenizer.token_channels == 8


def test_every_choice_on_offer_is_accepted():
    for schedule in ("constant", "cosine", "wsd"):
        assert override(SMOKE, [f"train.optimizer.schedule={schedule}"]).train.optimizer.schedule == schedule
    assert from_dict(type(SMOKE), to_dict(SMOKE)) == SMOKE


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "MeshConfig: expected named fields"),
        ({"data": "all"}, "MeshConfig.data: expected int, got 'all'"),
        ({"data": True}, "MeshConfig.data: expected int, got True"),
    ],
)
def test_json_of_the_wrong_kind_names_the_field(values, message):
    with pytest.raises(ConfigError, match=message):
        from_dict(MeshConfig, values)


def test_command_line_offers_every_preset():
    assert set(typing.get_args(Preset)) == set(PRESETS)


def test_unknown_preset_lists_the_known():
    with pytest.raises(ConfigError, match="smoke, cpu, cpu-full, accelerator, paper"):
        get_preset("gpu")


def test_paper_preset_has_the_papers_sizes():
    assert PAPER.dataset_counts == (5, 10, 20, 30, 40) and len(PAPER.datasets) == 40
    assert (PAPER.model.frames, PAPER.model.tokens, PAPER.model.layers, PAPER.model.action_tokens) == (12, 256, 32, 64)
    assert (PAPER.train.steps, PAPER.train.batch, PAPER.tau) == (60_000, 64, 3.0)
    assert PAPER.store.frame_step == 1  # as the published shares of the mixture need
    assert PAPER.widths == (64, 128, 256, 512, 768)
    assert PAPER.trajectory_counts == tuple(10**n for n in range(1, 7))
    reference = reference_trial(PAPER, 0)
    counts = {
        w: estimate(replace(reference, datasets=PAPER.datasets[:1], model=replace(PAPER.model, width=w)))
        for w in (256, 768)
    }
    assert round(counts[256].parameters_one_robot / 1e6, 1) == 43.6
    assert round(counts[768].parameters_one_robot / 1e6, 1) == 383.0


def test_declared_table_knows_what_the_registry_knows():
    table = declared_table(("bc_z", "bridge_dataset"), rate=2.0)
    assert [(e.action_dim, e.stride) for e in table.entries] == [(7, 5), (7, 3)]
    assert ONE_ROBOT.action_width == 2
    with pytest.raises(ConfigError, match="unknown dataset"):
        declared_table(("bridge_datase",), rate=2.0)
