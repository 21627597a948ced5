"""Names of trials, of tokenizers and of what is made of them: a field that is added changes none of them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from pathlib import Path

import pytest

from experiments.preparing.made_from import read_stamp
from experiments.preparing.tokenizer import training_settings
from experiments.presets import CPU_FULL, SMOKE
from experiments.running import trial as trial_module
from experiments.running.trial import Trial, trial_id
from experiments.running.workspace import Workspace, load_record
from experiments.sweeps.sweep import reference_trial
from hma_jax.config import DiffusionConfig, TokenizerConfig
from hma_jax.config.base import later
from hma_jax.config.json import from_dict, identity_of, to_dict
from hma_jax.tokenizers.autoencoder import declare_tokenizer
from hma_jax.tokenizers.io import DESCRIPTION, load_tokenizer
from hma_jax.tokenizers.lfq import LfqTokenizer
from tests.experiments.fakes import PROVENANCE

RESULTS = Path(__file__).parents[2] / "experiments" / "results"
TOKENIZERS = [place.parent for place in sorted(RESULTS.rglob(DESCRIPTION))]

ADDED = (
    "was a field added to a configuration? Declare it with `later` (hma_jax/config/base.py), or all that is finished has "
    "to be made again"
)


def with_field(config, declared, **values):
    """`config` with one more field, `added`; `values` of it, if given."""

    @dataclass(frozen=True)
    class More(type(config)):
        added: float = declared

    return More(**{f.name: getattr(config, f.name) for f in fields(config)}, **values)


def with_masking(trial, masking):
    return replace(trial, train=replace(trial.train, masking=masking))


def test_names_of_trials_stay():
    """Published trials have such names."""
    inputs = replace(PROVENANCE, results=2)
    assert trial_id(reference_trial(SMOKE, 0), inputs) == "4925133387f6a4df", ADDED
    assert trial_id(reference_trial(CPU_FULL, 0), inputs) == "c3091af5fd3a8aa1", ADDED


@pytest.mark.parametrize("place", TOKENIZERS, ids=lambda place: place.parent.name)
def test_every_committed_tokenizer_is_read(place):
    """Its identity is that of its weights and its configuration of today."""
    assert load_tokenizer(place).identity, ADDED


def test_committed_tokenizers_would_be_trained_as_they_were():
    studies = [RESULTS / name for name in ("cpu-full", "cpu-full-continuous")]
    for study in (load_record(Workspace(place)).study for place in studies):
        stamp = read_stamp(RESULTS / study.name / "tokenizer")
        wanted = training_settings(study) | {"store": identity_of(study.store.held_out)}
        assert {name: stamp.inputs[name] for name in wanted} == wanted, ADDED


@pytest.mark.parametrize("before", [0.5, 0.0])
def test_a_field_within_a_configuration_may_come_later(before):
    """At any depth, in a source too, and in a configuration that not every trial has."""
    plain = replace(reference_trial(CPU_FULL, 0), source=reference_trial(CPU_FULL, 1))
    latents = replace(plain, model=replace(plain.model, diffusion=DiffusionConfig()))
    names = []
    for value in (before, 1.0):
        masking = with_field(plain.train.masking, later(0.5, before=before), added=value)
        diffusion = with_field(DiffusionConfig(), later(0.5, before=before), added=value)
        names.append(
            {
                "masking": trial_id(with_masking(plain, masking), PROVENANCE),
                "of the source": trial_id(replace(plain, source=with_masking(plain.source, masking)), PROVENANCE),
                "diffusion": trial_id(replace(plain, model=replace(plain.model, diffusion=diffusion)), PROVENANCE),
            }
        )
    same = {"masking": trial_id(plain, PROVENANCE), "of the source": trial_id(plain, PROVENANCE)}
    assert names[0] == same | {"diffusion": trial_id(latents, PROVENANCE)}
    assert len({*names[0].values(), *names[1].values()}) == 5


def test_a_tokenizer_keeps_its_identity_when_a_field_is_added():
    config = TokenizerConfig(
        image_size=8, downsample=4, bits=4, factors=2, channels=4, encoder_blocks=1, decoder_blocks=1
    )
    params = declare_tokenizer(config).init(0)
    identity = LfqTokenizer(config, params).identity
    assert LfqTokenizer(with_field(config, later(0.5)), params).identity == identity
    others = [with_field(config, 0.5), with_field(config, later(0.5), added=1.0)]
    assert len({identity, *(LfqTokenizer(other, params).identity for other in others)}) == 3


def test_a_tokenizer_is_trained_on_and_not_again_when_a_field_is_added():
    plain = training_settings(SMOKE)
    for name in plain:
        added = replace(SMOKE, **{name: with_field(getattr(SMOKE, name), later(0.5))})
        assert training_settings(added) == plain
        changed = replace(SMOKE, **{name: with_field(getattr(SMOKE, name), later(0.5), added=1.0)})
        assert training_settings(changed)[name]["added"] == 1.0


def test_a_change_that_alters_some_trials_renames_these_alone(monkeypatch):
    one = reference_trial(CPU_FULL, 0)
    attends = replace(one, model=replace(one.model, conditioning="cross_attention"))
    after = replace(one, source=attends)
    averages = [replace(one, train=replace(one.train, ema_decay=decay)) for decay in (0.5, 0.9999)]
    trials = one, attends, after, *averages
    name = trial_id.__wrapped__  # not what is remembered, nor to be remembered
    before = [name(trial, PROVENANCE) for trial in trials]
    monkeypatch.setattr(trial_module, "OF_SOME", {})
    changed = [name(trial, PROVENANCE) != id for trial, id in zip(trials, before, strict=True)]
    assert changed == [False, True, True, True, True]


def test_a_whole_number_is_as_good_as_a_float():
    """The trial of an axis of one's own ran in a directory whose job.json named another."""
    one = replace(reference_trial(CPU_FULL, 0), tau=3.0, rate=2.0)
    whole = replace(one, tau=3, rate=2, model=replace(one.model, mlp_ratio=int(one.model.mlp_ratio)))
    assert one.model.mlp_ratio.is_integer()
    name = trial_id.__wrapped__  # what is remembered does not distinguish equal trials
    assert name(whole, PROVENANCE) == name(from_dict(Trial, to_dict(whole)), PROVENANCE) == name(one, PROVENANCE)
