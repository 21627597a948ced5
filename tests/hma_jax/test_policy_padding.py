"""Sampled actions of a robot do not depend on how wide the widest robot's are, and each value has its own noise."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import DecodeConfig, DiffusionConfig, SamplerConfig
from hma_jax.generation import policy, read_actions
from hma_jax.model.hma import Outputs
from tests.tiny import TABLE, lively_params, model_config

pytestmark = pytest.mark.exact


def test_what_padding_holds_does_not_reach_a_robot_s_own_actions():
    diffusion = DiffusionConfig(channels=1, patch=1, width=16, depth=1, clip=0.5)
    config = model_config(layers=1, diffusion=diffusion)
    declared, params = lively_params(config)
    pusher = jnp.zeros(2, jnp.int32)  # 2 values of 14
    pooled = jax.random.normal(jax.random.key(0), (2, 3, config.width))
    decode = DecodeConfig(sampler=SamplerConfig(steps=4))

    @jax.jit
    def read(params):
        out = Outputs(pooled, pooled, None)
        return read_actions(declared.merge(params), out, pusher, jax.random.split(jax.random.key(1), 2), decode)

    into = params["action_head"]["robots"]["into"]
    before = np.asarray(read(params))
    into["kernel"] = into["kernel"].at[:, 2:].add(1.0)  # rows that only padding meets
    np.testing.assert_array_equal(before[..., :2], read(params)[..., :2])
    assert (before[..., 2:] == 0).all()
    normalised = np.abs((before[..., :2] - TABLE.entries[0].mean) / TABLE.entries[0].std)
    assert normalised.max() == pytest.approx(0.5) and normalised.min() < 0.4  # within the clip, if not all at it


def test_every_value_of_every_frame_is_drawn_with_a_key_of_its_own(monkeypatch):
    found, config = [], model_config(diffusion=DiffusionConfig(steps=20))
    monkeypatch.setattr(policy, "sample", lambda network, keys, shape, *_: found.append(keys) or jnp.zeros(shape))
    model = SimpleNamespace(config=config, table=TABLE, action_head=True, unnormalise=lambda actions, _: actions)
    keys, decode = jax.random.split(jax.random.key(0), 2), DecodeConfig(sampler=SamplerConfig(steps=3))
    features = jnp.zeros((2, 3, config.width))
    read_actions(model, Outputs(features, features, None), jnp.zeros(2, int), keys, decode)
    data = np.asarray(jax.random.key_data(found[0])).reshape(-1, 2)
    assert len(data) == 2 * 3 * TABLE.action_width == len(np.unique(data, axis=0))
