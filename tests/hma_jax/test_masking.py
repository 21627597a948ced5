import dataclasses
import zlib
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from hma_jax.config import ConfigError, MaskingConfig, MaskingSetting
from hma_jax.config.training import ActionLeak
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.objective.losses import LossSums, count_targets, masked_loss
from hma_jax.objective.masking import hidden_at_inference, mask_tokens
from hma_jax.training.state import init_state, state_shapes
from hma_jax.training.step import find_leaking, find_presence, make_train_step
from tests.tiny import (
    DIFFUSION,
    SMALLER,
    TABLE,
    lively_params,
    mask,
    model_config,
    random_batch,
    shallow_config,
    train_config,
)

MIXED = EmbodimentTable(
    (
        Embodiment("arm", 2, 1, (0.0, 1.0), (1.0, 2.0)),
        Embodiment("film", 0, 1, (), ()),  # a video without actions
        Embodiment("blind", 3, 1, (0.0,) * 3, (1.0,) * 3, video_targets=False),
    )
)


def masked_batch(config, masking, table=TABLE, seed=0, batch=64):
    data = random_batch(seed, config, batch, table)
    return data, mask(jax.random.key(0), data["tokens"], data["embodiment"], config, masking, table)


def test_the_settings_differ_in_what_is_hidden_and_predicted():
    config = shallow_config()
    seen = {}
    for setting in get_args(MaskingSetting):
        _, masked = masked_batch(config, MaskingConfig(setting=setting))
        seen[setting] = [
            float(np.mean(x)) for x in (masked.targets_TS, masked.action_hidden_T, masked.action_targets_T)
        ]
    assert seen["forward"][1:] == [0, 0] and seen["passive"][1:] == [1, 0]
    assert seen["inverse"] == [0, 1, pytest.approx(5 / 6)]  # what follows the last frame is shown by none
    assert seen["policy"][0] == 0 and seen["policy"][1] == seen["policy"][2]
    assert all(0.3 < seen[s][0] < 0.7 for s in ("forward", "passive", "full"))
    assert 0.4 < seen["full"][1] == seen["full"][2] < 0.6


def test_frame_zero_is_always_shown():
    for config in (shallow_config(), shallow_config(diffusion=DIFFUSION)):
        _, masked = masked_batch(config, MaskingConfig())
        assert not np.asarray(masked.masked)[:, 0].any() and np.asarray(masked.masked)[:, 1:].any()


def test_an_example_s_masks_do_not_depend_on_its_batch():
    config = shallow_config()
    data, whole = masked_batch(config, MaskingConfig(setting="full"), batch=8)
    part = mask(
        jax.random.key(0), data["tokens"][:3], data["embodiment"][:3], config, MaskingConfig(setting="full"), TABLE
    )
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[:3], b), whole, part)


def test_continuous_tokens_are_masked_whole_unless_by_cell():
    config = shallow_config(diffusion=DIFFUSION)
    _, by_patch = masked_batch(config, MaskingConfig())
    assert by_patch.masked.shape == by_patch.targets_TS.shape
    _, by_cell = masked_batch(config, MaskingConfig(mask_unit="cell"))
    cells = np.asarray(by_cell.masked)
    assert cells.shape[-1] == DIFFUSION.cells
    np.testing.assert_array_equal(cells.any(-1), by_cell.targets_TS)
    assert (cells.any(-1) != cells.all(-1)).any()


@pytest.mark.parametrize("setting", ["full", "policy", "forward"])
def test_robots_without_actions_or_video_targets_train_what_they_can(setting: str):
    _, masked = masked_batch(shallow_config(), MaskingConfig(setting=setting), MIXED)
    robots = random_batch(0, shallow_config(), 64, MIXED)["embodiment"]
    film, blind = robots == 1, robots == 2
    assert np.asarray(masked.action_hidden_T)[film].all() and not np.asarray(masked.action_targets_T)[film].any()
    assert not np.asarray(masked.masked)[blind].any()
    if setting != "policy":
        assert np.asarray(masked.targets_TS)[film].any()
    if setting != "forward":
        assert np.asarray(masked.action_targets_T)[blind].any()
        counted = count_targets(masked, masked.inputs, MaskingConfig(setting=setting)).actions
        assert counted == np.asarray(masked.action_targets_T).sum() < np.asarray(masked.action_hidden_T).sum()


@pytest.mark.parametrize("diffusion, digest", [(None, 1553994923), (DIFFUSION, 988358124)])
def test_without_a_schedule_masks_are_bit_for_bit_those_of_before_there_was_one(diffusion, digest):
    """Recorded at commit 5cf0343."""
    _, masked = masked_batch(shallow_config(diffusion=diffusion), MaskingConfig())
    assert zlib.crc32(np.packbits(np.asarray(masked.masked)).tobytes()) == digest


@pytest.mark.parametrize("least, gain", [(0.0, 0.0), (0.3, 0.0), (0.0, 0.8), (0.25, 0.5)])
def test_the_mean_mask_ratio_of_each_frame_follows_the_schedule_of_the_paper(least, gain):
    """Paper section 3.5: a minimum, and by a cosine more at later frames."""
    masking = MaskingConfig(min_ratio=least, horizon_gain=gain)
    frames, windows, tokens = 8, 4000, 64

    @jax.jit
    def ratios(key):
        u_rate, u_mask = jax.random.uniform(key, (windows, frames)), (windows, frames, tokens)
        u_mask = jax.random.uniform(jax.random.fold_in(key, 1), u_mask)
        return jax.vmap(lambda r, m: mask_tokens(r, m, jnp.int32(1), masking))(u_rate, u_mask).mean(-1)

    found = np.asarray(ratios(jax.random.key(0)))
    floor = np.array([least + (1 - least) * gain * (1 - np.cos(np.pi / 2 * t / 7)) for t in range(1, 8)])
    assert not found[:, 0].any()
    np.testing.assert_allclose(found[:, 1:].mean(0), floor + (1 - floor) * 2 / np.pi, atol=0.02)
    assert np.all(found[:, 1:].min(0) > floor - 0.25)  # what 64 draws leave of the minimum


def test_a_whole_horizon_gain_masks_the_last_frame_wholly():
    for config in (shallow_config(), shallow_config(diffusion=DIFFUSION)):
        _, masked = masked_batch(config, MaskingConfig(horizon_gain=1.0))
        share = np.asarray(masked.masked).reshape(64, config.frames, -1).mean(-1)
        assert np.all(share[:, -1] == 1) and share[:, 1].min() < 1


@pytest.mark.parametrize("name", ["min_ratio", "horizon_gain"])
def test_a_mask_schedule_outside_its_range_is_refused(name):
    with pytest.raises(ConfigError, match=f"masking.{name} must lie in"):
        MaskingConfig(**{name: 1.1})


def losses(config, masking, changes=None, table=TABLE):
    """The loss sums of one batch, optionally with hidden or masked values replaced by nonsense."""
    declared, params = lively_params(config, table, scale=0.1)
    data, masked = masked_batch(config, masking, table, batch=8)
    if changes:
        data, masked = changes(data, masked)
    keys = jax.random.split(jax.random.key(1), 8)
    run = jax.jit(
        lambda p: masked_loss(
            declared.merge(p),
            masked,
            data["tokens"],
            data["actions"],
            data["embodiment"],
            masking,
            keys,
            training=True,
        )
    )
    return np.array(run(params))


def test_tokens_that_change_may_count_more():
    """The sums, and what they are divided by, are those of tokens that change, three times, and of the others."""
    config = shallow_config()
    declared, params = lively_params(config, TABLE, scale=0.1)
    data, masked = masked_batch(config, MaskingConfig(), batch=8)
    # Half of the tokens stand still.
    still = jax.random.bernoulli(jax.random.key(2), shape=data["tokens"].shape)
    tokens = np.where(still, data["tokens"][:, :1], data["tokens"])
    changed = np.zeros(tokens.shape, bool)
    changed[:, 1:] = tokens[:, 1:] != tokens[:, :-1]

    @partial(jax.jit, static_argnums=0)
    def sums_and_counts(weight: float, among):
        model, masking = declared.merge(params), MaskingConfig(change_weight=weight)
        counted = masked._replace(targets_TS=masked.targets_TS & among)
        sums = masked_loss(
            model, counted, tokens, data["actions"], data["embodiment"], masking, jnp.zeros(8), training=True
        )
        return sums.tokens, sums.correct, count_targets(counted, tokens, masking).tokens

    def found(weight, among=np.ones_like(changed)):
        return [float(x) for x in sums_and_counts(weight, among)]

    moving, standing = found(1.0, changed), found(1.0, ~changed)
    assert moving[2] > 20 and standing[2] > 20
    np.testing.assert_allclose(found(1.0), np.add(moving, standing), rtol=1e-5)
    np.testing.assert_allclose(found(3.0), 3 * np.array(moving) + standing, rtol=1e-5)
    with pytest.raises(ConfigError, match="masking.change_weight must be positive, got 0"):
        MaskingConfig(change_weight=0)
    with pytest.raises(ConfigError, match="predicted tokens, but setting 'policy' predicts no frames"):
        MaskingConfig(setting="policy", change_weight=2.0)


def test_the_gradient_of_actions_counts_as_their_loss_does(monkeypatch):
    """Of a loss whose sums are those of the parameters, so that no model is differentiated."""
    config = model_config(**SMALLER)
    declared, batch = declare_model(config, TABLE), random_batch(0, config)
    state = init_state(declared, TABLE, 0)

    def total(model, *_, **__):
        actions = sum(jnp.sum(x) for x in jax.tree.leaves(nnx.state(model)))
        return LossSums(jnp.zeros(()), jnp.zeros(()), actions)

    monkeypatch.setattr("hma_jax.training.step.masked_loss", total)
    policies = (MaskingConfig(setting="policy", action_loss_weight=weight) for weight in (1.0, 3.0))
    steps = [make_train_step(declared, TABLE, config, train_config(masking=policy)) for policy in policies]
    once, thrice = jax.jit(lambda state: [step(state, batch)[1]["grad_norm"] for step in steps])(state)
    assert once > 0
    np.testing.assert_allclose(thrice, 3 * once, rtol=1e-5)


def test_only_in_training_are_latents_noised_and_weighed_as_it_is_configured(monkeypatch):
    """Under `weight_cap` and `noise_shift`; held-out losses of models that were trained otherwise are comparable."""
    config, masking, seen = shallow_config(diffusion=DIFFUSION), MaskingConfig(), []

    def frame_loss(model, z_BTSD, tokens_BTSC, key_B, training=False):
        seen.append(training)
        return jnp.zeros(tokens_BTSC.shape[:3])

    monkeypatch.setattr("hma_jax.objective.losses.frame_diffusion_loss", frame_loss)
    declared, data = declare_model(config, TABLE), random_batch(0, config)

    def both(params, keys):
        model, (_, masked) = declared.merge(params), masked_batch(config, masking, batch=8)
        inputs = masked, data["tokens"], data["actions"], data["embodiment"], masking, keys
        return masked_loss(model, *inputs, training=True), masked_loss(model, *inputs, training=False)

    jax.eval_shape(both, declared.shapes(), jax.random.split(jax.random.key(0), 8))
    assert seen == [True, False]


def test_weights_of_change_are_of_ids():
    config, train = shallow_config(diffusion=DIFFUSION), train_config(masking=MaskingConfig(change_weight=2.0))
    with pytest.raises(ConfigError, match="change_weight works only for models on ids: latents change everywhere"):
        make_train_step(declare_model(config, TABLE), TABLE, config, train)


@pytest.mark.parametrize("setting", ["forward", "passive", "full", "inverse"])
def test_a_window_of_one_frame_has_none_to_predict(setting: str):
    config, declared = shallow_config(frames=1), declare_model(shallow_config(frames=1), TABLE)
    with pytest.raises(ConfigError, match=f"model.frames 1 no frame follows another, so .* '{setting}' has nothing"):
        make_train_step(declared, TABLE, config, train_config(masking=MaskingConfig(setting=setting)))
    make_train_step(declared, TABLE, config, train_config(masking=MaskingConfig(setting="policy")))


def poison_hidden(data, masked):
    """Hidden chunks become nonsense, as the model would be given them; targets are not asked for."""
    nonsense = np.where(np.asarray(masked.action_hidden_T)[..., None], 1e3, data["actions"])
    return data | {"actions": nonsense.astype(np.float32)}, masked


@pytest.mark.parametrize(
    "conditioning, alignment",
    [
        pytest.param("concat+modulate", "released", marks=pytest.mark.slow),
        ("concat+modulate", "causal"),
        pytest.param("concat", "released", marks=pytest.mark.slow),
        pytest.param("add", "causal", marks=pytest.mark.slow),
        pytest.param("cross_attention", "released", marks=pytest.mark.slow),
    ],
)
def test_hidden_actions_do_not_reach_the_frames_on_any_path(conditioning: str, alignment: str):
    config = shallow_config(conditioning=conditioning, action_alignment=alignment)
    passive = MaskingConfig(setting="passive")
    np.testing.assert_array_equal(losses(config, passive), losses(config, passive, poison_hidden))
    leaky = MaskingConfig(setting="full", action_leak="conditioning")
    if conditioning == "concat+modulate":
        assert losses(config, leaky)[0] != losses(config, leaky, poison_hidden)[0]


@pytest.mark.parametrize("alignment", ["released", "causal"])
@pytest.mark.parametrize("conditioning, leak", [("concat+modulate", "conditioning"), ("cross_attention", "all")])
def test_a_robot_without_actions_is_shown_none_through_a_leak_as_at_inference(conditioning, leak, alignment):
    config = shallow_config(conditioning=conditioning, action_alignment=alignment)
    declared, params = lively_params(config, MIXED)
    data, masked = masked_batch(config, MaskingConfig(action_leak=leak), MIXED, batch=8)
    tokens, actions, robots = (jnp.asarray(data[name]) for name in ("tokens", "actions", "embodiment"))
    assert set(robots.tolist()) == {0, 1, 2}
    inference = hidden_at_inference(MIXED, "forward", robots, config.frames)

    @partial(jax.jit, static_argnames="leak")
    def predicted(hidden: jax.Array, leak: ActionLeak) -> jax.Array:
        hma = declared.merge(params)
        hidden = hma.align_hidden(hidden, hidden.shape)
        shown = hma.align(actions), robots
        return hma(tokens, jnp.ones_like(masked.masked), *shown, action_hidden_BT=hidden, leak=leak).token_outputs

    np.testing.assert_array_equal(predicted(masked.action_hidden_T, leak), predicted(inference, "none"))
    presence = find_presence(masked, robots, np.ones(3, bool), config, leaking_E=find_leaking(MIXED, config, leak))
    assert presence.robots["actions_shown"].tolist() == [True, False, True]


def test_a_leak_of_actions_to_a_model_that_is_used_without_any_is_refused():
    with pytest.raises(ConfigError, match="action_leak 'all' shows the actions that setting 'passive' hides"):
        MaskingConfig(setting="passive", action_leak="all")


def test_hidden_actions_are_predicted_without_being_seen():
    """What is read off a frame is the same whatever the hidden chunks hold."""
    config = shallow_config()
    declared, params = lively_params(config)
    data, masked = masked_batch(config, MaskingConfig(setting="full"), batch=8)
    poisoned, _ = poison_hidden(data, masked)
    hma = declared.merge(params)

    @jax.jit
    def read(batch):
        out = hma(
            masked.inputs, masked.masked, batch["actions"], batch["embodiment"], action_hidden_BT=masked.action_hidden_T
        )
        return hma.action_head(out.action_features_BTD, batch["embodiment"])

    np.testing.assert_array_equal(read(data), read(poisoned))


@pytest.mark.slow  # of forward dynamics in every run: test_training
@pytest.mark.parametrize(
    "setting, diffusion",
    [("full", None), ("full", DIFFUSION), ("forward", DIFFUSION), ("policy", None), ("inverse", None)],
)
def test_every_setting_learns_a_repeated_batch(setting: str, diffusion):
    config = shallow_config(diffusion=diffusion, action_alignment="causal", trunk_gain=0.5, stem_gain=0.5, frames=4)
    train = train_config(masking=MaskingConfig(setting=setting), batch=8)
    train = dataclasses.replace(train, steps=80, optimizer=dataclasses.replace(train.optimizer, learning_rate=3e-3))
    declared = declare_model(config, TABLE)
    step = jax.jit(make_train_step(declared, TABLE, config, train))
    state, batch = init_state(declared, TABLE, 0), random_batch(0, config)
    history = []
    for _ in range(train.steps):
        state, metrics = step(state, batch)
        history.append(float(metrics["loss"]))
    assert np.mean(history[-10:]) < 0.92 * np.mean(history[:10])


def test_what_a_step_does_not_concern_stands_still():
    config = shallow_config(recall=True)
    for setting, still in (("passive", "actions_shown"), ("policy", "frames_predicted")):
        train = train_config(masking=MaskingConfig(setting=setting), steps=1)
        declared = declare_model(config, TABLE)
        _, params = lively_params(config)
        state = init_state(declared, TABLE, 0)._replace(params=params)
        new, _ = jax.jit(make_train_step(declared, TABLE, config, train))(state, random_batch(0, config))
        for (path, spec), old, moved in zip(
            declared.leaves().items(), jax.tree.leaves(params), jax.tree.leaves(new.params), strict=True
        ):
            if spec.use == still or (path in ("embed/mask", "recall/gain") and setting == "policy"):
                np.testing.assert_array_equal(old, moved, err_msg=f"{setting}: {path}")
            elif spec.use == "always":
                assert (np.asarray(old) != np.asarray(moved)).any(), f"{setting}: {path}"


def test_presence_is_by_use_and_robot():
    config = shallow_config()
    data, masked = masked_batch(config, MaskingConfig(setting="full"), MIXED)
    presence = find_presence(masked, jnp.asarray(data["embodiment"]), jnp.ones(3, bool), config)
    assert presence.robots["actions_shown"].tolist() == [True, False, True]
    assert presence.robots["actions_predicted"].tolist() == [True, False, True]
    assert presence.robots["frames_predicted"].tolist() == [True, True, False]
    no_target = masked._replace(targets_TS=jnp.zeros_like(masked.targets_TS))  # masked in padding alone, say
    presence = find_presence(no_target, jnp.asarray(data["embodiment"]), jnp.ones(3, bool), config)
    assert not presence.shared["frames_predicted"]
    shown = masked._replace(action_hidden_T=jnp.zeros_like(masked.action_hidden_T))
    for alignment in ("released", "causal"):  # the first frame is never shown an action where it is causal
        aligned = shallow_config(action_alignment=alignment)
        presence = find_presence(shown, jnp.asarray(data["embodiment"]), jnp.ones(3, bool), aligned)
        assert bool(presence.shared["actions_hidden"]) == (alignment == "causal")


@pytest.mark.parametrize(
    "conditioning, leak, alignment",
    [
        ("concat", "all", "released"),
        ("concat", "all", "causal"),
        ("modulate", "conditioning", "released"),
        ("modulate", "conditioning", "causal"),
        ("concat", "conditioning", "released"),
    ],
)
def test_stems_and_modulation_learn_from_hidden_actions_that_leak(conditioning: str, leak: str, alignment: str):
    """But not from what would lead to the first frame, which nothing does."""
    config = shallow_config(conditioning=conditioning, action_alignment=alignment)
    data, masked = masked_batch(config, MaskingConfig(setting="passive"), batch=8)
    leaking_E = find_leaking(TABLE, config, leak)
    presence = find_presence(masked, data["embodiment"], np.ones(TABLE.size, bool), config, leaking_E=leaking_E)
    declared, params = lively_params(config)
    hma, actions = declared.merge(params), data["actions"]
    hidden = hma.align_hidden(masked.action_hidden_T, actions.shape[:2])

    @jax.jit
    def predictions(actions):
        shown = hma.align(actions), data["embodiment"]
        return hma(masked.inputs, masked.masked, *shown, action_hidden_BT=hidden, leak=leak).token_outputs

    reached = np.asarray(predictions(actions) != predictions(actions + 1))
    assert reached.any() == bool(presence.shared["actions_shown"]) == (conditioning != "concat" or leak == "all")
    assert reached[:, 0].any() == (reached.any() and alignment == "released")


def test_a_step_updates_what_its_real_frames_and_its_leak_concern(monkeypatch):
    """Else stems stood still that learn from hidden actions alone, and what only padding shows moved."""
    config, seen = model_config(**SMALLER), []

    def find(masked, embodiment_B, trained_E, model, everything=True, real_BT=None, leaking_E=None):
        seen.append((real_BT, leaking_E))
        return find_presence(masked, embodiment_B, trained_E, model, everything, real_BT, leaking_E)

    monkeypatch.setattr("hma_jax.training.step.find_presence", find)
    train = train_config(masking=MaskingConfig(setting="inverse", action_leak="all"))
    declared, batch = declare_model(config, TABLE), random_batch(0, config)
    step = make_train_step(declared, TABLE, config, train)
    given = batch | {"real": np.ones(batch["tokens"].shape[:2], bool)}
    state = jax.eval_shape(lambda: init_state(declared, TABLE, 0))

    def traced(state, given):
        step(state, given)
        ((real_BT, leaking_E),) = seen
        assert real_BT is given["real"] and leaking_E.all()

    jax.eval_shape(traced, state, given)


@pytest.mark.parametrize(
    "setting, only, what",
    [("policy", "film", "actions"), ("inverse", "film", "actions"), ("forward", "blind", "frames")],
)
def test_robots_of_which_nothing_is_predicted_are_refused(setting: str, only: str, what: str):
    """Training ended well, with losses of 0."""
    config, masking = shallow_config(), MaskingConfig(setting=setting)
    declared = declare_model(config, MIXED)
    with pytest.raises(ConfigError, match=f"'{setting}' predicts {what}, but {only} and all other robots"):
        make_train_step(declared, MIXED, config, train_config(masking=masking, only=(only,)))
    make_train_step(declared, MIXED, config, train_config(masking=masking, only=(only, "arm")))


@pytest.mark.parametrize(
    "setting, only, why", [("forward", "film", "these robots have none"), ("passive", "arm", "passive shows none")]
)
def test_robots_that_have_nothing_to_train_alone_are_refused(setting: str, only: str, why: str):
    """Training ended well, and had moved no parameter."""
    config, masking = shallow_config(), MaskingConfig(setting=setting)
    declared = declare_model(config, MIXED)
    with pytest.raises(ConfigError, match=f"train.only: {only} would have no parameters to train: .*{why}"):
        make_train_step(declared, MIXED, config, train_config(masking=masking, only=(only,)))
    make_train_step(declared, MIXED, config, train_config(masking=masking))
    if setting == "forward":
        make_train_step(declared, MIXED, config, train_config(masking=masking, only=(only, "arm")))


def test_only_the_named_robots_own_parameters_are_trained():
    config = shallow_config()
    declared, params = lively_params(config)
    train = train_config(steps=1, only=("arm",))
    state = init_state(declared, TABLE, 0, state_shapes(declared, TABLE, only=train.only))._replace(params=params)
    new, _ = jax.jit(make_train_step(declared, TABLE, config, train))(state, random_batch(0, config))
    for (path, spec), old, moved in zip(
        declared.leaves().items(), jax.tree.leaves(params), jax.tree.leaves(new.params), strict=True
    ):
        changed = np.asarray(old) != np.asarray(moved)
        axis = spec.embodiment_axis
        if axis is None:
            assert not changed.any(), path
        else:
            own = np.moveaxis(changed, axis, 0)
            assert not own[[0, 2]].any(), path
            assert own[1].any() == (spec.use == "actions_shown"), path


@pytest.mark.parametrize(
    "changes, masking, message",
    [
        ({"action_heads": False}, {"setting": "policy"}, "set model.action_heads=true"),
        ({"conditioning": "modulate"}, {"setting": "full"}, "choose one with concat"),
    ],
)
def test_predicting_actions_without_the_means_is_refused(changes, masking, message):
    config = shallow_config(**changes)
    with pytest.raises(ConfigError, match=message):
        train = train_config(masking=MaskingConfig(**masking))
        make_train_step(declare_model(config, TABLE), TABLE, config, train)
