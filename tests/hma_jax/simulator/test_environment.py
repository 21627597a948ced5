"""Gymnasium's view of a simulator."""

import copy
import os
import warnings
from dataclasses import replace

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra `simulator`")

from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.wrappers.vector import DictInfoToList  # noqa: E402

from data_pipelines.suite.simulator import SuiteSimulator, suite_robot  # noqa: E402
from hma_jax.config import ConfigError  # noqa: E402
from hma_jax.simulator import Simulator  # noqa: E402
from hma_jax.simulator.environment import ID, MAX_STEPS, RobotEnv, RobotVectorEnv  # noqa: E402
from tests.hma_jax.simulator.small import ROBOTS, simulator, start  # noqa: E402

STARTS = [start(robot, 2, seed) for robot in (0, 1) for seed in range(3)]
NAME = f"hma_jax.simulator.environment:{ID}"


class Still:
    """In place of a simulator, for what hangs on no frame."""

    def __init__(self, episodes: int):
        self.images, self.robots = np.zeros((episodes, 8, 8, 3), np.uint8), {"arm": ROBOTS[1]}
        self.clipped = [()] * episodes

    def __len__(self):
        return len(self.images)

    def reset(self, starts, *, seeds, episodes):
        return self.images

    def step(self, actions):
        return self.images


def make(**options):
    return gymnasium.make(NAME, simulator=simulator(), starts=STARTS, **{"robot": "arm", **options})


def test_gymnasium_s_own_check_finds_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(not within the default range|symmetric|normalized).*")
        check_env(make(render_mode="rgb_array").unwrapped)


def test_spaces_are_the_robot_s_range_and_the_frame_s_size():
    env = make()
    np.testing.assert_array_equal(env.action_space.low, np.array(ROBOTS[1].low, np.float32))
    np.testing.assert_array_equal(env.action_space.high, np.array(ROBOTS[1].high, np.float32))
    assert env.observation_space.shape == (8, 8, 3) and env.observation_space.dtype == np.uint8


def play(env, seed: int, steps: int = 5) -> np.ndarray:
    env.action_space.seed(seed)
    first, _ = env.reset(seed=seed)
    return np.stack([first, *(env.step(env.action_space.sample())[0] for _ in range(steps))])


def test_a_seed_gives_the_same_episode_and_another_seed_another():
    env = make()
    one = play(env, 3)
    np.testing.assert_array_equal(play(env, 3), one)
    assert (play(env, 4) != one).any()


def test_an_episode_ends_by_its_judge_or_its_length():
    env = make(max_episode_steps=3)
    env.reset(seed=0)
    ends = [env.step(env.action_space.sample())[2:4] for _ in range(3)]
    assert ends == [(False, False), (False, False), (False, True)]
    env = make(judge=lambda sim: (np.full(1, 2.5), np.full(1, True)))
    env.reset(seed=0)
    assert env.step(env.action_space.sample())[1:3] == (2.5, True)


def test_an_episode_is_as_long_as_gymnasium_is_told_and_not_shorter():
    """Also one longer than those that nothing is told of."""
    for told, longest in (
        ({"max_episode_steps": MAX_STEPS + 1}, MAX_STEPS + 1),
        ({}, MAX_STEPS),
        ({"max_episode_steps": None}, MAX_STEPS),
    ):
        alone, several = (
            made(NAME, simulator=Still(count.get("num_envs", 1)), starts=STARTS, robot="arm", **told, **count)
            for made, count in ((gymnasium.make, {}), (gymnasium.make_vec, {"num_envs": 2}))
        )
        for env in (alone, several):
            env.reset(seed=0)
            cut = [np.all(env.step(env.action_space.sample())[3]) for _ in range(longest)]
            assert cut == [False] * (longest - 1) + [True]
    with pytest.raises(
        ConfigError, match="max_steps is not an option: set the length of an episode with Gymnasium's max_episode_steps"
    ):
        make(max_steps=3)


@pytest.mark.parametrize(("hz", "stride", "rate"), [(0.0, 1, 4), (6.0, 1, 6), (5.0, 2, 2.5)])
def test_films_are_in_the_robot_s_own_time(hz, stride, rate):
    sim = Still(1)
    sim.robots = {"arm": replace(ROBOTS[1], hz=hz, stride=stride, dimensions=())}
    for env in (RobotEnv, RobotVectorEnv):
        assert env(simulator=sim, starts=STARTS, robot="arm").metadata["render_fps"] == rate


def test_a_judge_is_told_of_episodes_that_begin():
    class Judge:
        def __init__(self):
            self.begun = []

        def begin(self, simulator, episodes):
            self.begun.append((list(episodes), simulator.images.copy()))

        def __call__(self, simulator):
            return np.zeros(2), np.array([True, False])

    judge = Judge()
    env = RobotVectorEnv(2, simulator=simulator(episodes=2), starts=STARTS, robot="arm", judge=judge)
    first, _ = env.reset(seed=0)
    for _ in range(2):  # the first episode ends with the first step and begins anew with the second
        images = env.step(np.stack([env.single_action_space.low] * 2))[0]
    assert [episodes for episodes, _ in judge.begun] == [[0, 1], [0]]
    np.testing.assert_array_equal(judge.begun[0][1], first)
    np.testing.assert_array_equal(judge.begun[1][1][0], images[0])


@pytest.mark.parametrize("several", [False, True])
@pytest.mark.parametrize(
    ("judge", "message"),
    [
        (lambda n: (np.ones((n, 1)), np.zeros(n, bool)), r"it returned float64 \[., 1\] and bool \[.\]"),
        (lambda n: (1.0, np.zeros(n, bool)), r"it returned float64 \[\] and"),
        (lambda n: (np.ones(n), np.zeros(n, int)), r"and int64 \[.\]"),
        (lambda n: (np.ones(n), np.zeros(n)), r"and float64 \[.\]"),
        (lambda n: (np.full(n, np.nan), np.zeros(n, bool)), "rewards of a judge must be finite, got .nan"),
    ],
)
def test_what_is_no_judgement_is_refused(several, judge, message):
    """It was broadcast, or ended other episodes; alone and in a vector it did different things."""
    options = {"starts": STARTS, "robot": "arm", "judge": lambda simulator: judge(len(simulator))}
    env = RobotVectorEnv(2, simulator=Still(2), **options) if several else RobotEnv(simulator=Still(1), **options)
    env.reset(seed=0)
    with pytest.raises(ConfigError, match=message):
        env.step(env.action_space.low)


def test_a_clipped_action_is_said_alike_alone_and_in_a_vector():
    env = RobotEnv(simulator=simulator(), starts=STARTS, robot="arm")
    several = DictInfoToList(vector(2, max_episode_steps=1))
    env.reset(seed=0)
    several.reset(seed=0)
    action = env.action_space.high.copy()
    action[1] += 1
    *_, info = env.step(action)
    named = np.array(env.get_wrapper_attr("robot").dimensions)[info["clipped"]]
    assert info["clipped"].dtype == bool and named.tolist() == [ROBOTS[1].dimensions[1]]
    *_, infos = several.step(np.stack([action, env.action_space.high]))
    assert infos[0].keys() == info.keys() and infos[1]["clipped"].tolist() == [False] * len(action)
    np.testing.assert_array_equal(infos[0]["clipped"], info["clipped"])
    *_, infos = several.step(np.stack([action] * 2))  # both begin anew, and their actions are ignored
    assert infos == [{}, {}]


def test_a_spec_does_not_copy_the_simulator():
    """A copy of the model was made, and kept, by every wrapper."""
    sim, true = simulator(), SuiteSimulator([suite_robot("pusher_sand", (-1.0,) * 2, (1.0,) * 2, (0.0,) * 2, 1)])
    assert gymnasium.make(NAME, simulator=sim, starts=STARTS, robot="arm").spec.kwargs["simulator"] is sim
    assert copy.deepcopy(true) is true


def test_the_vector_environment_begins_episodes_anew_when_they_end():
    env = gymnasium.make_vec(
        NAME, num_envs=2, simulator=simulator(episodes=2), starts=STARTS, robot="arm", max_episode_steps=2
    )
    env.action_space.seed(0)
    first, _ = env.reset(seed=1)
    assert first.shape == (2, 8, 8, 3) and env.unwrapped._task.simulator.counts == (2, 2)
    truncated = [env.step(env.action_space.sample())[3].tolist() for _ in range(4)]
    assert truncated == [[False] * 2, [True] * 2, [False] * 2, [False] * 2]
    assert env.unwrapped._task.simulator.counts == (3, 3)


def test_a_step_in_which_an_episode_begins_anew_rewards_and_ends_nothing():
    """The judge still sees where the last one ended: its reward would count twice, and the new episode end at once."""
    judge = lambda simulator: (np.full(2, 2.5), np.array([True, False]))  # noqa: E731
    env = RobotVectorEnv(2, simulator=Still(2), starts=STARTS, robot="arm", judge=judge)
    env.reset(seed=0)
    low = np.stack([env.single_action_space.low] * 2)
    seen = [[x.tolist() for x in env.step(low)[1:3]] for _ in range(3)]
    ended, began = [[2.5, 2.5], [True, False]], [[0.0, 2.5], [False, False]]
    assert seen == [ended, began, ended]


def test_each_of_a_vector_is_what_the_environment_alone_makes():
    """For the same starts, seeds and actions."""
    sim = simulator(episodes=2)
    env = RobotVectorEnv(2, simulator=sim, starts=STARTS, robot="arm")
    env.action_space.seed(0)
    env.reset(seed=1)
    seeds, plan = [e.seed for e in sim._episodes], [env.action_space.sample() for _ in range(3)]
    images = [env.step(actions)[0] for actions in plan]
    drawn, _ = gymnasium.utils.seeding.np_random(1)
    for b in range(2):
        number, seed = int(drawn.integers(3)), int(drawn.integers(2**32))
        assert seed == seeds[b]
        alone = simulator()
        alone.reset(STARTS[3 + number], seeds=[seed])
        for t, actions in enumerate(plan):
            np.testing.assert_array_equal(alone.step([actions[b]])[0], images[t][b])


def vector(episodes: int = 2, **options):
    return RobotVectorEnv(episodes, simulator=simulator(episodes=episodes), starts=STARTS, robot="arm", **options)


def test_each_episode_of_a_vector_may_have_its_own_seed():
    """It is then what the environment alone shows with that seed, also where it begins anew."""
    env, seeds, low = vector(max_episode_steps=1), [5, 9], np.stack([np.array(ROBOTS[1].low, np.float32)] * 2)
    shown = [env.reset(seed=seeds)[0], env.step(low)[0], env.step(low)[0]]
    for b, seed in enumerate(seeds):
        alone = RobotEnv(simulator=simulator(), starts=STARTS, robot="arm")
        expected = [alone.reset(seed=seed)[0], alone.step(low[0])[0], alone.reset()[0]]
        np.testing.assert_array_equal([images[b] for images in shown], expected)
    again, _ = env.reset(seed=[None, 5])
    np.testing.assert_array_equal(again[1], shown[0][0])
    with pytest.raises(ConfigError, match="2 episodes need as many seeds, got 3"):
        env.reset(seed=[1, 2, 3])
    with pytest.raises(ConfigError, match="2 episodes need as many actions, got 1"):
        env.step(low[:1])


@pytest.mark.slow
def test_a_part_of_a_vector_begins_anew_where_a_mask_says_so():
    env, mask = vector(3, max_episode_steps=3), np.array([False, True, False])
    env.reset(seed=0)
    before = env.step(np.stack([env.single_action_space.low] * 3))[0]
    images, _ = env.reset(options={"reset_mask": mask, "start": 2})
    assert env._task.simulator.counts == (3, 2, 3)
    np.testing.assert_array_equal(images[[0, 2]], before[[0, 2]])
    ends = [env.step(np.stack([env.single_action_space.low] * 3))[3].tolist() for _ in range(3)]
    assert ends == [[False] * 3, [True, False, True], [False, True, False]]
    for unusable in (np.zeros(3, bool), np.ones(2, bool), [0, 1, 0], "x"):
        with pytest.raises(ConfigError, match="reset_mask must be 3 truth values"):
            env.reset(options={"reset_mask": unusable})


def test_a_vector_of_episodes_without_a_step_is_refused():
    with pytest.raises(ConfigError, match="at least 1 step, got max_episode_steps=0"):
        vector(max_episode_steps=0)
    with pytest.raises(ConfigError, match=r"max_episode_steps must be whole numbers, got \[2.5\]"):
        vector(max_episode_steps=2.5)


@pytest.mark.parametrize("env", [RobotEnv, RobotVectorEnv])
def test_a_way_to_be_shown_that_there_is_not_is_refused(env):
    """Nothing was shown, and nothing said so."""
    with pytest.raises(ConfigError, match="render_mode: 'human' is not allowed; choose one of None, rgb_array"):
        env(simulator=Still(1), starts=STARTS, robot="arm", render_mode="human")


@pytest.mark.parametrize("start_", ["x", None, 1.5, 3, -1])
def test_a_start_that_is_none_is_refused(start_):
    for env in (RobotEnv(simulator=simulator(), starts=STARTS, robot="arm"), vector(2)):
        with pytest.raises(ConfigError, match=f"there are 3 starts, counted from 0; there is no start {start_!r}"):
            env.reset(options={"start": start_})


def test_a_step_without_an_action_is_refused():
    """The episode waited, and the step counted."""
    for env, none in (
        (RobotEnv(simulator=simulator(), starts=STARTS, robot="arm"), None),
        (vector(2), [ROBOTS[1].low, None]),
    ):
        env.reset(seed=0)
        with pytest.raises(ConfigError, match="needs an action for every step, but that of episode .* is None"):
            env.step(none)
        assert set(env._task.simulator.counts) == {2}


def test_native_actions_are_no_steps_of_an_environment():
    with pytest.raises(ConfigError, match="not native actions"):
        RobotEnv(simulator=simulator(rate="native"), starts=STARTS, robot="arm")


@pytest.mark.parametrize(
    "options, message",
    [
        ({"rate": "model", "history": 3}, "rate, history: only for loading a `run`"),
        ({"robot": "base"}, "no start of robot 'base'; there are starts of pusher, arm"),
        ({"starts": iter(STARTS)}, r"an episode begins at a Start .*, not at \[<"),
        ({"starts": []}, r"there are no starts, so no episode can begin: .*make_simulator\('RUN', episodes=1\)"),
        ({"episodes": 1}, "episodes is not an option: .* as many as num_envs"),
        ({"run": "somewhere"}, "either `run` or `simulator`"),
    ],
)
def test_what_cannot_be_made_is_said(options: dict, message: str):
    with pytest.raises(ConfigError, match=message):
        RobotEnv(**{"simulator": simulator(), "starts": STARTS, "robot": "arm", **options})


def test_environments_that_share_a_simulator_do_not_step_each_other_s_episodes():
    """All of a vector in mode "sync", or training and evaluation, drove the same one without a word."""
    train, evaluate = (gymnasium.make(NAME, simulator=sim, starts=STARTS, robot="arm") for sim in [Still(1)] * 2)
    low = train.action_space.low
    for one, other in ((train, evaluate), (evaluate, train)):
        one.reset(seed=0)
        one.step(low)
        other.reset(seed=0)
        with pytest.raises(ConfigError, match="another environment has begun its episodes in this one's simulator"):
            one.step(low)
        other.step(low)
    several = gymnasium.make_vec(
        NAME, num_envs=2, vectorization_mode="sync", simulator=Still(1), starts=STARTS, robot="arm"
    )
    several.reset(seed=0)
    with pytest.raises(ConfigError, match="simulator of its own, or leave out vectorization_mode"):
        several.step(several.action_space.sample())


def test_a_part_of_a_vector_does_not_begin_in_another_s_simulator():
    sim = Still(2)
    first, second = (RobotVectorEnv(2, simulator=sim, starts=STARTS, robot="arm") for _ in range(2))
    first.reset(seed=0)
    second.reset(seed=0)
    with pytest.raises(ConfigError, match="another environment has begun its episodes"):
        first.reset(options={"reset_mask": np.array([True, False])})
    second.step(second.action_space.sample())


def test_a_forked_process_uses_no_model_of_the_process_that_it_was_forked_from(monkeypatch, tmp_path):
    """Neither one that it loads nor one that it is given; JAX would wait there for ever."""
    given, before = simulator(), RobotEnv(simulator=simulator(), starts=STARTS, robot="arm")
    monkeypatch.setattr(Simulator, "made_in", os.getpid() + 1)
    for use in (
        lambda: RobotEnv(tmp_path),
        lambda: RobotEnv(simulator=given, starts=STARTS, robot="arm"),
        lambda: before.reset(seed=0),
    ):
        with pytest.raises(ConfigError, match="forked from one that had made a model's simulator, .* leave out vector"):
            use()
    RobotEnv(simulator=Still(1), starts=STARTS, robot="arm").reset(seed=0)  # a true one computes without JAX
    for made_in in (None, os.getpid()):
        monkeypatch.setattr(Simulator, "made_in", made_in)
        with pytest.raises(ConfigError, match="no checkpoints"):
            RobotEnv(tmp_path)
