"""Policies of Stable-Baselines3, which knows nothing of this project, learn and act in the learned simulator."""

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="needs the extra `simulator`")
sb3 = pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3, which brings PyTorch, to run it")

from hma_jax.simulator.environment import ID  # noqa: E402
from tests.hma_jax.simulator.small import simulator, start  # noqa: E402

pytestmark = pytest.mark.slow
STARTS = [start(1, 2, seed) for seed in range(3)]
NAME = f"hma_jax.simulator.environment:{ID}"
OPTIONS = {"starts": STARTS, "robot": "arm", "max_episode_steps": 4}


def brightness(sim) -> tuple[np.ndarray, np.ndarray]:
    """A judge: rewards are the mean of an image's values."""
    return sim.images.mean((1, 2, 3)) / 255, np.zeros(len(sim), bool)


def test_a_policy_learns_in_the_environment_and_steps_the_vector_environment_unchanged():
    alone = gymnasium.make(NAME, simulator=simulator(), judge=brightness, **OPTIONS)
    model = sb3.PPO("MlpPolicy", alone, n_steps=8, batch_size=8, n_epochs=1, device="cpu", seed=0)
    model.learn(16)
    assert model.num_timesteps == 16
    several = gymnasium.make_vec(
        NAME, num_envs=3, vectorization_mode="vector_entry_point", simulator=simulator(episodes=3), judge=brightness,
        **OPTIONS,
    )  # fmt: skip
    images, _ = several.reset(seed=0)
    ended = np.zeros(3, bool)
    for _ in range(6):
        actions, _ = model.predict(images)
        assert several.action_space.contains(actions)
        images, rewards, terminated, truncated, _ = several.step(actions)
        assert images.shape == (3, 8, 8, 3) and np.isfinite(rewards).all() and not terminated.any()
        ended |= truncated
    assert ended.all(), "no episode reached its length"
