"""Recorded demonstrations, and policies that are trained on them."""

import json
from dataclasses import replace
from functools import partial
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from data_pipelines.suite.rollout import episode_seeds
from data_pipelines.suite.simulator import SPECS, SuiteSimulator, suite_robot
from data_pipelines.suite.tasks import Reach
from data_pipelines.suite.world import World
from experiments.applications.judging.rollouts import run
from experiments.applications.policies import (
    RandomPolicy,
    demonstrations,
    diffusion,
    find_task,
    load_policy,
    record,
    save_policy,
)
from experiments.applications.policies.acting import Scale, make_examples, scale_of
from experiments.applications.policies.cloning import BcConfig, ClonedPolicy, init_bc, train_bc
from experiments.applications.policies.closed_loop import goal_distance, run_policy, start_seeds
from experiments.applications.policies.demonstrations import Demonstrations, load_demonstrations, save_demonstrations
from experiments.applications.policies.diffusion import (
    DiffusionConfig,
    DiffusionPolicy,
    init_diffusion,
    train_diffusion,
)
from experiments.applications.policies.kinds import KINDS
from experiments.applications.policies.learning import FitConfig, log_spaced_steps
from experiments.applications.policies.network import EncoderConfig, as_floats, random_shift
from experiments.applications.policies.tasks import held
from hma_jax.config import ConfigError
from hma_jax.kernels.random import key_of
from hma_jax.simulator import Start

SMALL = EncoderConfig(8, (4, 4, 4), 16)
TASK = find_task("gripper_wood", frames=8)
ROBOT = suite_robot("gripper_wood", [-2.0] * 4, [2.0] * 4, [0.0] * 4, 1)


@pytest.fixture(scope="module")
def demos():
    return record(TASK, 24, noise=(0.0, 0.4), image_size=8, after=1, seed=3)


@pytest.mark.parametrize("stride", [1, 2])
def test_demonstrations_are_what_the_simulator_does_under_their_actions(stride):
    """Each is held for as many native steps as a frame has."""
    demos = record(TASK, 3, stride=stride, noise=0.2, seed=1)
    simulator = SuiteSimulator([replace(ROBOT, stride=stride)], episodes=3)
    nothing = np.zeros((0, 4), np.float32)
    starts = [Start("gripper_wood", demos.images[i, :1], nothing, int(demos.seeds[i])) for i in range(3)]
    seen = [simulator.reset(starts)]
    for t in range(TASK.frames - 1):
        seen.append(simulator.step(list(demos.actions[:, t])))
    np.testing.assert_array_equal(np.stack(seen, 1), demos.images)
    assert demos.successes.tolist() == held(demos.reached, TASK.hold).any(1).tolist()


def test_experts_succeed_more_often_than_play_and_their_episodes_end_soon_after(demos):
    play = record(TASK, 24, image_size=8, play=True)
    assert len(demos) == 24 and demos.successes.mean() > play.successes.mean() + 0.3
    done = np.flatnonzero(demos.successes)
    first = held(demos.reached, TASK.hold).argmax(1)
    assert (demos.lengths[done] == np.minimum(first[done] + 2, TASK.frames)).all()
    shorter = int(done[demos.lengths[done].argmin()])
    assert not demos.images[shorter, demos.lengths[shorter] :].any()


def test_only_successes_are_recorded_where_that_is_asked(demos):
    found = record(TASK, 10, noise=0.4, image_size=8, only_successes=True, seed=3)
    assert len(found) == 10 == len(set(found.seeds.tolist())) and found.successes.all()


def test_as_many_are_recorded_as_were_asked_for_where_noises_share_them_unevenly(monkeypatch):
    shares, drive = [], demonstrations.drive

    def watched(task, seeds, *given, noise, play):
        shares.append((noise, len(seeds)))
        return drive(task, seeds, *given, noise=noise, play=play)

    monkeypatch.setattr(demonstrations, "drive", watched)
    found = record(TASK, 3, noise=(0.0, 0.4), image_size=8, seed=3)
    assert len(found) == 3 == len(set(found.seeds.tolist())) and shares == [(0.0, 2), (0.4, 1)]


def test_policies_are_tried_at_starts_that_are_in_no_demonstration():
    """Nor in the dataset that a model was trained on."""
    task = find_task("pusher_sand", "reach", frames=8)
    recorded = [record(task, 20, image_size=8, seed=seed).seeds for seed in (0, 1)]
    recorded += [episode_seeds(task.spec, 200, 0, split) for split in ("train", "val")]
    assert not np.isin(start_seeds(task, 20), np.concatenate(recorded)).any()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count and stride must be at least 1, got 0 and 1"),
        ({"stride": 0}, "count and stride must be at least 1, got 2 and 0"),
        ({"after": -1}, "after must not be negative, got -1"),
        ({"noise": float("nan")}, "noise must be one or more finite numbers that are not negative, got nan"),
        ({"noise": (0.1, -0.1)}, "noise must be .* got .0.1, -0.1."),
        ({"noise": []}, "noise must be one or more"),
    ],
)
def test_what_cannot_be_recorded_is_said(options, message):
    """With a stride of 0 nothing moved, and successes were cut off 1 frame before they came."""
    with pytest.raises(ConfigError, match=message):
        record(TASK, **{"count": 2, "image_size": 8, **options})


def test_a_noise_may_be_a_number_of_numpy():
    one, other = (record(TASK, 1, noise=noise, image_size=8) for noise in (0.5, np.float32(0.5)))
    np.testing.assert_array_equal(one.actions, other.actions)


def test_an_example_is_the_frames_seen_and_the_actions_from_there_on():
    """Padding, whose actions are 0, is no part of it nor of the scale."""
    images, actions = np.zeros((2, 3, 8, 8, 3), np.uint8), np.array([[[1], [2], [3]], [[11], [12], [0]]], np.float32)
    known = np.zeros((2, 3), bool), np.zeros(2, bool), np.zeros(2, np.int64)
    demos = Demonstrations(images, actions, np.array([3, 2]), *known)
    scale, examples = scale_of(demos), make_examples(demos, frames=2, chunk=2, size=8)
    assert (scale.mean, scale.low, scale.high) == ((pytest.approx(5.8),), (1,), (12,))
    assert examples["episode"].tolist() == [0, 0, 0, 1, 1]
    assert examples["seen"].tolist() == [[0, 0], [0, 1], [1, 2], [0, 0], [0, 1]]
    expected = [[1, 2], [2, 3], [3, 3], [11, 12], [12, 12]]
    np.testing.assert_allclose(examples["chunk"] * scale.std[0] + scale.mean[0], expected, rtol=1e-6)


def test_demonstrations_are_kept_in_a_file(demos, tmp_path):
    path = tmp_path / "demos.npz"
    save_demonstrations(demos, path)
    np.testing.assert_array_equal(load_demonstrations(path).images, demos.images)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(ConfigError, match="record them again"):
        load_demonstrations(path)


class Replayed:
    """A policy that gives the actions of recorded episodes."""

    def __init__(self, actions):
        self.actions = actions

    def reset(self, episodes=None, *, seeds=None):
        self.frame = -1

    def act(self, images):
        self.frame += 1
        return self.actions[:, self.frame]


def test_a_rollout_is_what_its_actions_do_and_the_control_executes_those_of_another_episode():
    demos, nothing = record(TASK, 6, noise=0.0), np.zeros((0, 4), np.float32)
    starts = [Start("gripper_wood", demos.images[i, :1], nothing, int(demos.seeds[i])) for i in range(6)]
    simulator, policy = SuiteSimulator([ROBOT], episodes=6), Replayed(demos.actions)
    good, elsewhere = (run(simulator, policy, starts, range(6), TASK, shuffled=s) for s in (False, True))
    np.testing.assert_array_equal(good.images[:, :-1], demos.images)
    np.testing.assert_array_equal(good.reached[:, :-1], demos.reached)
    np.testing.assert_array_equal(elsewhere.actions, np.roll(demos.actions, 1, axis=0))
    assert good.reached.any(1).mean() > 0.6 > 0.4 > elsewhere.reached.any(1).mean()


def test_whole_chunks_of_a_policy_are_executed_action_by_action():
    """The same in a simulator's rollouts and in the true world of a task; a chunk of equal actions is a held one."""
    seeds, task = start_seeds(TASK, 2), replace(TASK, frames=4)
    low, high = (np.array(x, np.float32) for x in (ROBOT.low, ROBOT.high))
    chunks = np.random.default_rng(0).uniform(low, high, (2, 4, 2, 4)).astype(np.float32)
    world = World(TASK.spec, seeds)
    for t in range(3):
        for i in range(2):
            world.step(chunks[:, t, i].astype(np.float64))
    outcome = run_policy(task, Replayed(chunks), seeds, 32, stride=2)
    np.testing.assert_array_equal(outcome.distance, goal_distance(world))

    simulator, nothing = SuiteSimulator([replace(ROBOT, stride=2)], episodes=2, image_size=8), np.zeros((0, 4))
    starts = [Start("gripper_wood", simulator.images[:1], nothing.astype(np.float32), int(seed)) for seed in seeds]
    made = run(simulator, Replayed(chunks), starts, range(2), task)
    np.testing.assert_array_equal(made.actions, chunks)
    simulator.reset(starts)
    for t in range(4):
        np.testing.assert_array_equal(made.images[:, t + 1], simulator.step(list(chunks[:, t])))
    held, repeated = (
        run(simulator, Replayed(a), starts, range(2), task) for a in (chunks[:, :, 0], chunks[:, :, [0, 0]])
    )
    np.testing.assert_array_equal(held.images, repeated.images)
    assert held.actions.shape == (2, 4, 4) and (held.images != made.images).any()


def test_native_actions_are_no_frames_of_a_rollout():
    simulator = SuiteSimulator([ROBOT], episodes=2, image_size=8)
    simulator.rate = "native"  # which learned ones may have
    with pytest.raises(ConfigError, match="a rollout needs a simulator of rate='model', .* not native actions"):
        run(simulator, RandomPolicy(ROBOT), [], [], TASK)


@pytest.mark.parametrize("name", ["own", "reach"])
def test_the_distance_from_a_goal_is_that_of_the_farthest_tool(name):
    robot = next(r for r, spec in SPECS.items() if len(spec.body.tools) == 2 and isinstance(spec.task, Reach))
    task = find_task(robot, name)
    world = World(task.spec, start_seeds(task, 3))
    away = np.linalg.norm(world.tools - world.goals, axis=-1)
    assert away.shape == (3, 2) and (np.ptp(away, axis=1) > 0).all()
    np.testing.assert_array_equal(goal_distance(world), away.max(1))


def test_cloning_learns_and_is_a_function_of_its_seed(demos):
    config = BcConfig(encoder=SMALL, fit=FitConfig(steps=150, batch=16, keep=(1, 50), learning_rate=5e-3))
    losses = {}
    kept = train_bc(demos, config, 1, lambda done, total, note: losses.update({done: float(note.split()[1])}))
    assert sorted(kept) == [1, 50, 150]
    assert losses[150] < 0.8 * losses[50]
    short = BcConfig(encoder=SMALL, fit=FitConfig(steps=1, batch=16))
    one, again, other = (train_bc(demos, short, seed, lambda *_: None)[1].params["mlp"][0]["w"] for seed in (1, 1, 2))
    np.testing.assert_array_equal(one, again)
    assert not np.array_equal(one, other)


def trained(demos) -> tuple[list[np.ndarray], np.ndarray]:
    config = DiffusionConfig(encoder=SMALL, samples=2, fit=FitConfig(steps=2, batch=4))
    images = demos.images[:2, 0]
    policy = train_diffusion(demos, config, 1, lambda *_: None)[2]
    shown = jax.jit(lambda key: random_shift(as_floats(images[:, None]), key, 2))(key_of(1))
    return [*jax.tree.leaves(policy.params), shown], policy.act(images)


@pytest.fixture(scope="module")
def usual(demos):
    return trained(demos)


@pytest.mark.parametrize("setting", [partial(jax.enable_x64, True), partial(jax.default_prng_impl, "rbg")])
def test_settings_of_jax_change_no_policy(setting, demos, usual):
    learnt, acted = usual
    with setting():
        other, acted_there = trained(demos)
    for mine, theirs in zip([*learnt, acted], [*other, acted_there], strict=True):
        assert mine.dtype == theirs.dtype == np.float32
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("name", KINDS)
def test_trained_policies_of_every_kind_do_the_same_when_saved_and_damaged_ones_are_refused(name, demos, tmp_path):
    kind, fit = KINDS[name], FitConfig(steps=2, batch=4, keep=(1,))
    trained = kind.train(demos, kind.config(frames=1, encoder=SMALL, fit=fit), 1, lambda *_: None)
    assert sorted(trained) == [1, 2]
    policy = trained[2]
    assert type(policy) is kind.policy and policy.kind == name
    save_policy(policy, tmp_path / "one", {"robot": "gripper_wood"})
    loaded, images = load_policy(tmp_path / "one"), demos.images[:2, 0]
    for each in (policy, loaded):
        each.reset(seeds=[5, 6])
    first = policy.act(images)
    np.testing.assert_array_equal(first, loaded.act(images))
    assert first.shape == (2, 4) and first.dtype == np.float32
    weights, about = (tmp_path / "one" / name for name in ("weights.safetensors", "policy.json"))
    assert weights.stat().st_mode == about.stat().st_mode  # not their owner's alone
    weights.write_bytes(b"x")
    with pytest.raises(ConfigError, match="train it again"):
        load_policy(tmp_path / "one")


def test_a_policy_whose_description_lacks_something_is_refused(demos, tmp_path):
    """All of its actions were scaled alike, or it ended with another error."""
    config = BcConfig(encoder=SMALL)
    save_policy(ClonedPolicy(config, init_bc(config, 4, 0), scale_of(demos)), str(tmp_path / "one"))
    path = tmp_path / "one/policy.json"
    whole = json.loads(path.read_text())
    assert load_policy(str(tmp_path / "one")).config == config
    for damaged, message in (
        ([], "does not say all of kind, config, scale"),
        ({"kind": "cloned"}, "does not say all of kind, config, scale"),
        (whole | {"scale": whole["scale"] | {"std": [1.0]}}, "a scale has a value for each dimension of an action"),
    ):
        path.write_text(json.dumps(damaged))
        with pytest.raises(ConfigError, match=message):
            load_policy(tmp_path / "one")


@pytest.mark.parametrize("which", [[0], np.flatnonzero([True, False])], ids=["a list", "an array"])
def test_an_episode_that_begins_anew_forgets_its_past_and_the_others_keep_theirs(demos, which):
    config = BcConfig(encoder=SMALL, chunk=3, execute=3)
    policy = ClonedPolicy(config, init_bc(config, 4, 0), scale_of(demos))
    policy.reset()
    policy.act(demos.images[:2, 0])
    for unusable in ([-1], [2], [True, False]):
        with pytest.raises(ConfigError, match="episodes must be "):
            policy.reset(unusable)
    with pytest.raises(ConfigError, match="1 episodes need as many seeds, got 2"):
        policy.reset([0], seeds=[5, 6])
    policy.reset(which)
    policy.act(demos.images[:2, 3])
    np.testing.assert_array_equal(policy._seen[0], demos.images[[0, 0], 3])
    np.testing.assert_array_equal(policy._seen[1], demos.images[1, [0, 3]])
    assert [len(left) for left in policy._left] == [2, 1]


@pytest.mark.parametrize(
    "images",
    [
        np.zeros((2, 8, 8, 3)),
        np.zeros((2, 8, 8, 3), int),
        np.zeros((8, 8, 3), np.uint8),
        np.zeros((0, 8, 8, 3), np.uint8),
    ],
    ids=["in 0..1", "int64", "one", "none"],
)
def test_a_policy_acts_after_images_of_256_levels(images):
    """After those in 0..1, which look black, it acted too."""
    policy = ClonedPolicy(BcConfig(encoder=SMALL), {}, Scale((0.0,), (1.0,), (0.0,), (1.0,)))
    with pytest.raises(ConfigError, match=r"need images uint8 \[B, H, W, 3\], got "):
        policy.act(images)


def test_a_new_chunk_is_planned_when_as_many_actions_as_configured_were_executed(monkeypatch, demos):
    config, planned = BcConfig(encoder=SMALL, chunk=3, execute=2), []
    policy = ClonedPolicy(config, {}, Scale((0.0,), (1.0,), (0.0,), (99.0,)))
    monkeypatch.setattr(policy, "plan", lambda *_: planned.append(0) or np.arange(3.0)[None] + 10 * len(planned))
    assert [policy.act(demos.images[:1, 0]).item() for _ in range(5)] == [10, 11, 20, 21, 30]


def test_what_a_diffusion_policy_draws_depends_on_seed_and_step(demos):
    config = DiffusionConfig(encoder=SMALL, frames=1, chunk=1, execute=1, samples=2)
    policy = DiffusionPolicy(config, init_diffusion(config, 4, 0), scale_of(demos))

    def act(*seeds: int) -> list[np.ndarray]:
        policy.reset(seeds=seeds)
        return [policy.act(demos.images[[0, 0], 0]) for _ in range(2)]

    (first, second), again, (exchanged, _) = act(1, 2), act(1, 2), act(2, 1)
    np.testing.assert_array_equal([first, second], again)
    np.testing.assert_array_equal(exchanged, first[::-1])
    assert (first[0] != first[1]).any() and (first != second).any(1).all()


def test_random_actions_depend_on_the_seed_of_an_episode_alone():
    policy, images = RandomPolicy(ROBOT, hold=2), np.zeros((2, 8, 8, 3), np.uint8)
    policy.reset(seeds=[1, 2])
    first = [policy.act(images) for _ in range(3)]
    for seeds in ([2, 1], np.array([2, 1])):
        policy.reset(seeds=seeds)
        np.testing.assert_array_equal(policy.act(images), first[0][::-1])
    policy.reset(np.array([0, 1]), seeds=np.array([1, 2]))
    np.testing.assert_array_equal(policy.act(images), first[0])
    np.testing.assert_array_equal(first[0], first[1])
    assert not np.array_equal(first[1], first[2])


@pytest.mark.parametrize("predicts", get_args(diffusion.Predicts))
def test_denoising_with_the_true_noise_or_chunk_gives_the_chunk(monkeypatch, demos, predicts):
    config = DiffusionConfig(encoder=SMALL, samples=10, predicts=predicts)
    params, wanted = init_diffusion(config, 4, 0), jnp.linspace(-1, 1, 16)
    kept = jnp.asarray(diffusion.signal(config.levels))

    def exact(params, seen, noised, level):
        share = kept[level.astype(int)][:, None]
        noise = (noised - jnp.sqrt(share) * wanted) / jnp.sqrt(1 - share)
        return noise if predicts == "noise" else jnp.broadcast_to(wanted, noised.shape)

    monkeypatch.setattr(diffusion, "denoise", exact)
    frames = jnp.zeros((2, 2, 8, 8, 3))
    limits = np.array([[-3.0], [3.0]]) * np.ones(16)
    drawn = diffusion.draw(params, config, frames, jnp.ones((2, 16)), limits)
    np.testing.assert_allclose(drawn, np.broadcast_to(wanted, (2, 16)), atol=1e-4)


def test_a_denoiser_learns_the_noise_or_the_chunk_as_its_config_says(monkeypatch, demos):
    """Of constant actions, which are 0 in their own scale, a network that gives 0 knows the chunk, and no noise."""
    monkeypatch.setattr(diffusion, "denoise", lambda params, seen, noised, level: 0 * noised)
    still, losses = replace(demos, actions=np.ones_like(demos.actions)), []
    for predicts in ("chunk", "noise"):
        config = DiffusionConfig(encoder=SMALL, predicts=predicts, fit=FitConfig(steps=1, batch=64))
        train_diffusion(still, config, 0, lambda done, total, note: losses.append(float(note.split()[1])))
    assert losses[0] == 0 and losses[1] == pytest.approx(1, abs=0.1)
    with pytest.raises(ConfigError, match="predicts: .velocity. is not allowed; choose one of noise, chunk"):
        DiffusionConfig(predicts="velocity")


def test_the_share_of_signal_falls_as_a_squared_cosine():
    """Nichol and Dhariwal 2021, equation 17; saved policies were trained with it."""
    at = (np.arange(5) / 4 + 0.008) / 1.008 * np.pi / 2
    np.testing.assert_allclose(diffusion.signal(4)[:3], (np.cos(at) ** 2 / np.cos(at[0]) ** 2)[1:4], rtol=1e-5)
    assert diffusion.signal(4)[3] == np.float32(1e-4)


def test_limits_of_a_chunk_are_those_of_each_action_in_turn():
    scale = Scale((0.0, 1.0), (1.0, 2.0), (-1.0, -3.0), (2.0, 5.0))
    of = lambda limits: diffusion.bounds(DiffusionConfig(chunk=2, limits=limits), scale).tolist()  # noqa: E731
    assert of("range") == [[-1, -2, -1, -2], [2, 2, 2, 2]]
    assert of("spread") == [[-3] * 4, [3] * 4]


@pytest.mark.parametrize("given", [0.5, 9.0], ids=["within the limits", "beyond them"])
def test_noise_is_added_in_training_as_drawing_takes_it_away(monkeypatch, demos, given):
    """Who knows all chunks knows the noise: those beyond the limits are learnt as the limit, here 3."""
    config = DiffusionConfig(encoder=SMALL, limits="spread", fit=FitConfig(steps=1, batch=16))
    kept, examples, losses = jnp.asarray(diffusion.signal(config.levels)), diffusion.make_examples, []

    def exact(params, seen, noised, level):
        share = kept[level.astype(int)][:, None]
        return (noised - jnp.sqrt(share) * min(given, diffusion.SPREAD)) / jnp.sqrt(1 - share)

    def alike(*asked):
        made = examples(*asked)
        return made | {"chunk": np.full_like(made["chunk"], given)}

    monkeypatch.setattr(diffusion, "denoise", exact)
    monkeypatch.setattr(diffusion, "make_examples", alike)
    train_diffusion(demos, config, 0, lambda done, total, note: losses.append(float(note.split()[1])))
    assert losses == [pytest.approx(0, abs=1e-3)]


def test_drawing_begins_at_the_strongest_noise_and_ends_at_the_weakest(monkeypatch):
    """A denoiser says the level here, and what it says last is drawn."""
    monkeypatch.setattr(diffusion, "denoise", lambda params, seen, noised, level: 0 * noised + level[:, None])
    frames, limits = jnp.zeros((1, 2, 8, 8, 3)), np.array([[-200.0], [200.0]]) * np.ones(16)
    for samples, last in ((1, 99), (2, 0)):
        config = DiffusionConfig(encoder=SMALL, samples=samples, predicts="chunk")
        drawn = diffusion.draw(init_diffusion(config, 4, 0), config, frames, jnp.ones((1, 16)), limits)
        np.testing.assert_allclose(drawn, np.full((1, 16), last), atol=1e-4)


def test_an_action_that_is_demonstrated_seldom_can_be_given(monkeypatch, demos):
    """A gripper closed in one frame of twenty is 4.4 standard deviations away: the policy could close it to 0.7."""
    monkeypatch.setattr(diffusion, "denoise", lambda params, seen, noised, level: 0 * noised + 9)
    scale = Scale((0.05,), (0.05**0.5 * 0.95**0.5,), (0.0,), (1.0,))
    closed = {}
    for limits in get_args(diffusion.Limits):
        config = DiffusionConfig(encoder=SMALL, samples=2, predicts="chunk", limits=limits)
        policy = DiffusionPolicy(config, init_diffusion(config, 1, 0), scale)
        closed[limits] = float(policy.act(demos.images[:1, 0])[0, 0])
    assert closed["range"] == 1 and closed["spread"] == pytest.approx(0.704, abs=0.001)


def test_saved_diffusion_policies_without_later_fields_are_as_they_were(demos, tmp_path):
    config, path = DiffusionConfig(encoder=SMALL, samples=2, predicts="chunk"), tmp_path / "one/policy.json"
    save_policy(DiffusionPolicy(config, init_diffusion(config, 4, 0), scale_of(demos)), tmp_path / "one")
    assert load_policy(tmp_path / "one").config == config
    description = json.loads(path.read_text())
    del description["config"]["predicts"], description["config"]["limits"]
    path.write_text(json.dumps(description))
    assert load_policy(tmp_path / "one").config == replace(config, predicts="noise", limits="spread")


def test_a_ladder_has_its_first_and_last_rung():
    assert log_spaced_steps(1000, 4, 1) == (1, 10, 100, 1000)
    with pytest.raises(ConfigError, match="at 60 steps, so training must be longer than that, got 50 steps"):
        log_spaced_steps(50, 4, 60)


@pytest.mark.parametrize("name", ["reach", "hover"])
def test_another_task_changes_no_frame_and_no_start(name):
    other, own = (record(find_task("gripper_wood", task, 4), 2) for task in (name, "own"))
    np.testing.assert_array_equal(other.images[:, 0], own.images[:, 0])
