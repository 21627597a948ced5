import functools
from dataclasses import replace
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from hma_jax.config import ConfigError, ExecutionConfig, MeshConfig, MupConfig, OptimizerConfig, TrainConfig
from hma_jax.config.training import Matrices
from hma_jax.model.hma import declare_model
from hma_jax.model.params import ParamSpec, Use, is_spec
from hma_jax.training import optimizer
from hma_jax.training.optimizer import (
    Presence,
    apply_update,
    check_schedule,
    clip_by_global_norm,
    init_adam,
    learning_rate_multiplier,
    make_schedule,
    muon_direction,
)
from hma_jax.training.state import init_state
from hma_jax.training.step import make_train_step
from tests.tiny import TABLE, lively_params, random_batch, shallow_config

USES = get_args(Use)
CONFIG = OptimizerConfig(learning_rate=1e-2, weight_decay=0.1)
MUON = OptimizerConfig(learning_rate=1e-2, weight_decay=0.1, matrices="muon")


def gradients(params, seed=0):
    leaves, treedef = jax.tree.flatten(params)
    rng = np.random.default_rng(seed)
    return jax.tree.unflatten(treedef, [rng.normal(size=x.shape).astype(np.float32) for x in leaves])


@jax.jit
def begun(params):
    return init_adam(params, TABLE.size)


def update(params, state, present, seed=0, config=CONFIG):
    return compiled(config)(gradients(params, seed), state, params, jnp.array(present))


@functools.cache
def compiled(config: OptimizerConfig):
    """One program for all updates of the shallow model, in place of one for each operation and shape."""
    specs = declare_model(shallow_config(), TABLE).specs
    ones = jax.tree.map(lambda _: 1.0, specs, is_leaf=is_spec)

    def step(gradients, state, params, present):
        here = Presence(dict.fromkeys(USES, jnp.array(True)), dict.fromkeys(USES, present))
        return apply_update(gradients, state, params, specs, ones, here, 1e-2, config, 2**14)

    return jax.jit(step)


def slices(declared, tree, robot):
    """The given robot's slice of every per-robot array."""
    specs = declared.leaves()
    out = {}
    for path, leaf in jax.tree.leaves_with_path(tree):
        name = "/".join(str(k.key) for k in path)
        axis = specs[name].embodiment_axis
        if axis is not None:
            out[name] = np.take(np.asarray(leaf), robot, axis)
    return out


@pytest.mark.parametrize("matrices", get_args(Matrices))
def test_a_step_goes_against_the_gradient_and_robots_absent_from_it_do_not_move(matrices):
    config = replace(CONFIG, matrices=matrices)
    declared, params = lively_params(shallow_config())
    state = begun(params)
    params1, state1 = update(params, state, [True, True, True], config=config)
    trees = (jax.tree.leaves(jax.tree.map(np.asarray, tree)) for tree in (params, params1, gradients(params)))
    for before, after, gradient in zip(*trees, strict=True):
        assert np.sum((before * (1 - 1e-3) - after) * gradient) > 0  # decay apart
    params2, state2 = update(params1, state1, [True, False, True], seed=1, config=config)
    for name, before in slices(declared, params1, 1).items():
        np.testing.assert_array_equal(before, slices(declared, params2, 1)[name], err_msg=name)
    for old, new in ((state1.first, state2.first), (state1.second, state2.second)):
        for name, before in slices(declared, old, 1).items():
            np.testing.assert_array_equal(before, slices(declared, new, 1)[name], err_msg=name)
    assert all(count.tolist() == [2, 1, 2] for count in state2.count_E.values())
    assert all(int(count) == 2 for count in state2.count.values())
    moved = slices(declared, params2, 0)
    assert all((moved[n] != x).any() for n, x in slices(declared, params1, 0).items() if x.any())


def test_a_robot_that_returns_goes_on_as_if_the_steps_between_had_not_been():
    declared, params = lively_params(shallow_config())
    state = begun(params)
    a, sa = update(params, state, [True, True, True], seed=0)
    away, s_away = update(a, sa, [True, False, True], seed=5)
    back, _ = update(away, s_away, [True, True, True], seed=1)
    direct, _ = update(a, sa, [True, True, True], seed=1)
    for name, expected in slices(declared, direct, 1).items():
        np.testing.assert_array_equal(expected, slices(declared, back, 1)[name], err_msg=name)


def test_with_everyone_present_it_is_adamw():
    declared, params = lively_params(shallow_config())
    decayed = jax.tree.map(lambda s: s.decay, declared.specs, is_leaf=is_spec)
    reference = optax.adamw(1e-2, CONFIG.beta1, CONFIG.beta2, CONFIG.epsilon, weight_decay=0.1, mask=decayed)

    @jax.jit
    def step(gradient, opt, theirs):
        updates, opt = reference.update(gradient, opt, theirs)
        return optax.apply_updates(theirs, updates), opt

    theirs, opt = params, reference.init(params)
    ours, state = params, init_adam(params, TABLE.size)
    for seed in range(3):
        ours, state = update(ours, state, [True] * 3, seed)
        theirs, opt = step(gradients(params, seed), opt, theirs)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-5), ours, theirs)


def singular_values(x: jax.Array, spec: ParamSpec) -> np.ndarray:
    """Of every matrix of a parameter: [matrices, least side]."""
    axes = [axis for side in spec.matrix for axis in side]
    rows = int(np.prod([spec.shape[axis] for axis in spec.matrix[0]]))
    turned = np.moveaxis(np.asarray(x), axes, range(-len(axes), 0))
    columns = int(np.prod([spec.shape[axis] for axis in spec.matrix[1]]))
    return np.linalg.svd(turned.reshape(-1, rows, columns), compute_uv=False)


def test_muon_moves_every_matrix_by_as_much_in_every_direction_and_all_else_as_adamw():
    declared, params = lively_params(shallow_config())
    state, here = begun(params), [True, True, True]
    (adamw, _), (muon, after) = (update(params, state, here, config=c) for c in (CONFIG, MUON))
    flat = [list(map(np.asarray, jax.tree.leaves(tree))) for tree in (params, adamw, muon, after.second)]
    matrices = 0
    for (path, spec), was, usual, moved, second in zip(declared.leaves().items(), *flat, strict=True):
        if spec.role != "hidden":
            np.testing.assert_array_equal(moved, usual, err_msg=path)
            continue
        step = (was - moved) / 1e-2 - 0.1 * was
        found = singular_values(step, spec)
        low, high = np.quantile(found / np.median(found), (0.1, 1.0))  # the smallest of all are raised by less
        assert 0.5 < low and high < 1.7, path
        assert 0.1 < np.std(step) < 0.3, path
        assert not second.any(), path
        matrices += len(found)
    assert matrices == 2 * (3 + 1) + 2 + 4 * TABLE.size  # q, k, v, out, twice; MLP; of each robot modulation and stem
    # The next step looks ahead: the momentum has the new gradient in it, and then once more.
    again, _ = update(muon, after, here, seed=1, config=MUON)
    first, second = (jax.tree.leaves(gradients(params, seed)) for seed in (0, 1))
    specs = list(declared.leaves().values())
    at = next(i for i, spec in enumerate(specs) if spec.role == "hidden")
    momentum = 0.95 * 0.05 * first[at] + 0.05 * second[at]
    ahead = jax.jit(lambda x: muon_direction(x, specs[at], 1.0, min_shard_size=2**14))(
        0.95 * momentum + 0.05 * second[at]
    )
    was, moved = (np.asarray(jax.tree.leaves(tree)[at]) for tree in (muon, again))
    np.testing.assert_allclose((was - moved) / 1e-2 - 0.1 * was, ahead, atol=2e-4)


def test_a_step_shares_out_matrices_of_the_size_that_the_mesh_s_settings_say(monkeypatch):
    config = shallow_config()
    declared = declare_model(config, TABLE, ExecutionConfig(mesh=MeshConfig(min_shard_size=7)))
    train = TrainConfig(steps=1, batch=8, optimizer=MUON)
    state = init_state(declared, TABLE, 0)
    sizes = []
    monkeypatch.setattr(optimizer, "muon_direction", lambda momentum, *rest: sizes.append(rest[-1]) or momentum)
    jax.eval_shape(make_train_step(declared, TABLE, config, train), state, random_batch(0, config))
    assert set(sizes) == {7}


def test_a_step_clips_to_the_norm_that_is_configured(monkeypatch):
    config, limits = shallow_config(), []
    declared = declare_model(config, TABLE)
    train = TrainConfig(steps=1, batch=8, optimizer=replace(CONFIG, warmup_steps=0, clip_norm=7.0))
    clip = lambda grads, limit: limits.append(limit) or clip_by_global_norm(grads, limit)  # noqa: E731
    monkeypatch.setattr("hma_jax.training.step.clip_by_global_norm", clip)
    state = jax.eval_shape(lambda: init_state(declared, TABLE, 0))
    jax.eval_shape(make_train_step(declared, TABLE, config, train), state, random_batch(0, config))
    assert limits == [7.0]


def test_under_mup_muon_s_updates_keep_their_spectral_norm_at_every_width():
    def norms(width: int) -> dict[str, float]:
        config = shallow_config(width=width, mup=MupConfig(base_width=32))
        hidden = {path: s for path, s in declare_model(config, TABLE).leaves().items() if s.role == "hidden"}
        moved = {path: np.random.default_rng(0).normal(size=s.shape).astype(np.float32) for path, s in hidden.items()}

        @jax.jit
        def directions(moved):
            return {
                p: muon_direction(moved[p], s, learning_rate_multiplier(s, config), min_shard_size=2**14)
                for p, s in hidden.items()
            }

        return {p: float(singular_values(x, hidden[p]).max()) for p, x in directions(moved).items()}

    narrow, wide = norms(32), norms(64)
    assert narrow and narrow.keys() == wide.keys()
    for path in narrow:
        assert wide[path] == pytest.approx(narrow[path], rel=0.15), path


def test_biases_are_never_decayed_and_matrices_are():
    leaves = declare_model(shallow_config(), TABLE).leaves()
    assert all(spec.decay != name.endswith("bias") for name, spec in leaves.items())


def test_mup_divides_the_rate_of_hidden_matrices_only():
    config = shallow_config(width=128, mup=MupConfig(base_width=32))
    leaves = declare_model(config, TABLE).leaves()
    scaled = {n for n, s in leaves.items() if learning_rate_multiplier(s, config) == 0.25}
    assert {"trunk/blocks/space/qkv", "trunk/blocks/mlp_in/kernel", "stem/out/kernel"} <= scaled
    for name in ("stem/into/kernel", "frame_head/linear/kernel", "embed/tables", "positions"):
        assert name not in scaled
    assert all(s.role == "hidden" for n, s in leaves.items() if n in scaled)


def test_mup_leaves_decay_as_it_is():
    """Of a hidden matrix muP scales it up as much as the rate down."""
    specs = {"matrix": declare_model(shallow_config(), TABLE).leaves()["trunk/blocks/mlp_in/kernel"]}
    params = {"matrix": jnp.ones(specs["matrix"].shape)}
    nothing, state = jax.tree.map(np.zeros_like, params), init_adam(params, TABLE.size)
    here = Presence(dict.fromkeys(USES, jnp.array(True)), dict.fromkeys(USES, jnp.ones(TABLE.size, bool)))
    new, _ = apply_update(nothing, state, params, specs, {"matrix": 0.25}, here, 1e-2, CONFIG, 2**14)
    np.testing.assert_allclose(new["matrix"], 1 - 1e-2 * CONFIG.weight_decay, rtol=1e-6)


def test_schedules_warm_up_hold_and_fall():
    def rates(**settings):
        schedule = make_schedule(OptimizerConfig(learning_rate=1.0, **settings), 100)
        return np.array([schedule(s) for s in range(100)])

    constant = rates(schedule="constant", warmup_steps=10)
    np.testing.assert_allclose(constant[:10], np.arange(1, 11) / 10, rtol=1e-5)
    assert (constant[10:] == 1).all()
    cosine = rates(schedule="cosine", warmup_steps=10)
    assert cosine[10] == 1 and (np.diff(cosine[10:]) <= 0).all() and 0.1 <= cosine[-1] < 0.102
    wsd = rates(schedule="wsd", warmup_steps=10)
    assert (wsd[10:80] == 1).all() and wsd[90] == pytest.approx(0.55, abs=0.02) and wsd[-1] < 0.16


def test_a_decay_that_fits_after_the_warm_up_comes_to_its_end():
    """Of the shortest run that is not refused as well."""
    config = OptimizerConfig(learning_rate=1.0, warmup_steps=90, schedule="wsd", decay_fraction=0.25)
    check_schedule(config, 120)
    assert make_schedule(config, 120)(119) == pytest.approx(0.1 + 0.9 / 30, abs=1e-3)
    with pytest.raises(ConfigError, match=r"train.steps=119 are too few .*decay of schedule wsd \(29: "):
        check_schedule(replace(config, warmup_steps=91), 119)
    check_schedule(replace(config, schedule="constant"), 1)


def test_a_cosine_without_a_step_after_the_warm_up_is_refused():
    config = OptimizerConfig(learning_rate=1.0, warmup_steps=90, schedule="cosine")
    check_schedule(config, 91)
    with pytest.raises(ConfigError, match=r"train.steps=90 are too few .*warmup_steps=90\), so with schedule cosine"):
        check_schedule(config, 90)


def test_training_refuses_a_decay_that_the_warm_up_leaves_no_room_for():
    """From Python too, where no command has checked it."""
    config = TrainConfig(steps=300, optimizer=OptimizerConfig(schedule="wsd", warmup_steps=500))
    with pytest.raises(ConfigError, match="train.steps=300 are too few for the warm-up"):
        make_train_step(declare_model(shallow_config(), TABLE), TABLE, shallow_config(), config)


def test_clipping_leaves_small_gradients_alone_and_reports_the_norm_before():
    grads = {"a": jnp.array([3.0, 4.0])}
    same, norm = clip_by_global_norm(grads, 10.0)
    np.testing.assert_array_equal(same["a"], grads["a"])
    small, _ = clip_by_global_norm(grads, 1.0)
    assert norm == 5.0
    np.testing.assert_allclose(small["a"], [0.6, 0.8], rtol=1e-6)
