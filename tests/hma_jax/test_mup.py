"""muP in both variants: what each parameter is to the width, and what becomes of activations."""

from dataclasses import replace
from typing import get_args

import jax
import numpy as np
import pytest

from hma_jax.config import (
    Conditioning,
    ConfigError,
    DiffusionConfig,
    MaskingConfig,
    ModelConfig,
    MupConfig,
    OptimizerConfig,
    TrainConfig,
)
from hma_jax.diagnostics.coordinate_check import Size, check_coordinates, measure, slopes
from hma_jax.model.hma import declare_model
from hma_jax.training.optimizer import learning_rate_multiplier
from hma_jax.training.state import init_state
from hma_jax.training.step import make_train_step
from tests.tiny import TABLE, model_config, random_batch, train_config

BASE, WIDE = 32, 256
VARIANTS = {
    "discrete": {"trunk_gain": 0.25},
    "continuous": {
        "trunk_gain": 0.5,
        "diffusion": DiffusionConfig(channels=2, patch=2, width=32, depth=1, steps=100),
    },
}
IN_BLOCKS = {ModelConfig(conditioning=kind).block_conditioning: kind for kind in get_args(Conditioning)}
ROLES = [("continuous", "concat+modulate"), *(("discrete", kind) for kind in IN_BLOCKS.values())]
# A rate that learns the batch by heart in ten steps: a smaller one hides what is wrong.
TRAIN = train_config(
    steps=10,
    batch=4,
    optimizer=OptimizerConfig(learning_rate=1e-2, warmup_steps=0, weight_decay=0.0),
    masking=MaskingConfig(prompt_frames=1),
)

FAST_TO_COMPILE = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}


def variant(name: str, **changes) -> ModelConfig:
    """Few tokens, actions that matter, a trunk in which what is learned soon outweighs the start.

    At the base width 4 / head width is 1 / sqrt(head width).
    """
    settings = dict(
        width=BASE, layers=1, heads=2, frames=3, tokens=4, action_tokens=1, action_heads=False,
        stem_gain=1.0, mup=MupConfig(base_width=BASE, attention_scale=4.0),
    )  # fmt: skip
    return model_config(**settings | VARIANTS[name] | changes)


def without(config: ModelConfig, ingredient: str) -> ModelConfig:
    if ingredient == "everything":
        return replace(config, mup=replace(config.mup, enabled=False))
    return replace(config, mup=replace(config.mup, without=(ingredient,)))


def windows(config: ModelConfig) -> dict[str, np.ndarray]:
    return random_batch(0, config, TRAIN.batch)


def measured(config: ModelConfig, seeds: int, train: TrainConfig = TRAIN) -> list[Size]:
    return measure(config, train, TABLE, windows(config), (BASE, WIDE), range(seeds), FAST_TO_COMPILE)


# --- Parameters ------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "conditioning"), ROLES)
def test_a_parameter_is_hidden_exactly_if_two_of_its_axes_grow_with_the_width(name, conditioning):
    config = variant(name, conditioning=conditioning, action_heads=True)
    narrow, wide = (declare_model(replace(config, width=w), TABLE).leaves() for w in (BASE, WIDE))
    for path, spec in narrow.items():
        growing = sum(a != b for a, b in zip(spec.shape, wide[path].shape, strict=True))
        roles = {2: {"hidden"}, 1: {"input", "output", "vector"}, 0: {"vector"}}[growing]
        assert spec.role in roles, path


@pytest.mark.parametrize(("name", "conditioning"), ROLES)
def test_hidden_matrices_start_and_learn_smaller_in_wider_models_and_nothing_else_does(name, conditioning):
    config = variant(name, conditioning=conditioning, action_heads=True)
    models = [declare_model(replace(config, width=w), TABLE) for w in (BASE, WIDE)]
    sizes = []
    for params in (declared.init(0) for declared in models):
        sizes.append(jax.tree.leaves(jax.tree.map(lambda p: float(np.sqrt(np.mean(np.square(p)))), params)))
    m = WIDE / BASE
    for (path, spec), narrow, wide in zip(models[1].leaves().items(), *sizes, strict=True):
        hidden = spec.role == "hidden"
        assert learning_rate_multiplier(spec, replace(config, width=WIDE)) == (1 / m if hidden else 1), path
        assert wide == pytest.approx(narrow / m**0.5 if hidden else narrow, rel=0.12), path


@pytest.mark.parametrize("name", ["discrete", pytest.param("continuous", marks=pytest.mark.slow)])
def test_at_the_base_width_mup_is_the_standard_parametrisation_bit_for_bit(name):
    config = variant(name)
    programs, starts = [], []
    for one in (config, without(config, "everything")):
        declared = declare_model(one, TABLE)
        starts.append(init_state(declared, TABLE, 0))
        step = jax.jit(make_train_step(declared, TABLE, one, TRAIN))
        programs.append(step.lower(starts[-1], windows(one)).as_text())
    assert programs[0] == programs[1]
    jax.tree.map(np.testing.assert_array_equal, *starts)


# --- Activations -----------------------------------------------------------------------------


@pytest.mark.beside
@pytest.mark.parametrize("name", ["discrete", pytest.param("continuous", marks=pytest.mark.slow)])
def test_activations_and_what_training_changes_keep_their_size_at_every_width(name):
    rows = measured(variant(name), 6)
    assert check_coordinates(rows) == [], slopes(rows)


@pytest.mark.slow
@pytest.mark.parametrize("name", VARIANTS)
def test_they_keep_their_size_under_muon_too(name):
    train = replace(TRAIN, optimizer=replace(TRAIN.optimizer, matrices="muon"))
    changes = {"chain_factors": True} if name == "discrete" else {}
    rows = measured(variant(name, recall=True, **changes), 6, train)
    assert check_coordinates(rows) == [], slopes(rows)


INGREDIENTS = ("init", "learning_rate", "readout", "attention", "everything")


@pytest.mark.slow  # minutes of compilation
@pytest.mark.parametrize("name", VARIANTS)
@pytest.mark.parametrize("ingredient", INGREDIENTS)
def test_each_ingredient_is_needed(name, ingredient):
    rows = measured(without(variant(name), ingredient), 6 if ingredient == "attention" else 2)
    assert check_coordinates(rows) != [], slopes(rows)


def test_findings_name_what_grows_fades_and_overflows():
    rows = [
        Size(quantity, width, 0, step, size(width), change(width))
        for width in (10, 100)
        for step in (0, 1, 2)
        for quantity, size, change in [
            ("steady", lambda w: 2.0, lambda w: 1.0),
            ("growing", lambda w: 3 * w, lambda w: w),
            ("fading", lambda w: 1.0, lambda w: w**-0.5),
            ("overflowing", lambda w: np.inf if w == 100 else 1.0, lambda w: 1.0),
        ]
    ]
    assert slopes(rows)["growing"] == pytest.approx((1, 1))
    assert check_coordinates(rows) == [
        "growing: grows as width^1.00",
        "growing: its change in training grows as width^1.00",
        "fading: its change in training fades as width^-0.50",
        "overflowing: zero or not finite at some width",
    ]
    with pytest.raises(ConfigError, match="at least two widths"):
        slopes(rows[:4])
