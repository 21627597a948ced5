import dataclasses

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError, DecodeConfig, SamplerConfig
from hma_jax.generation import read_actions
from hma_jax.model.embodiments import Embodiment
from hma_jax.model.hma import declare_model
from hma_jax.training.adapt import add_embodiments
from tests.tiny import DIFFUSION, TABLE, lively_params, model_config, random_batch

pytestmark = pytest.mark.exact

NEWCOMERS = (
    Embodiment("humanoid", 26, 3, (0.1,) * 26, (2.0,) * 26),  # wider than anyone before
    Embodiment("cart", 1, 1, (0.0,), (1.0,)),
)


@pytest.mark.parametrize(
    ("diffusion", "conditioning"),
    [
        (None, "concat+modulate"),
        pytest.param(DIFFUSION, "concat+modulate", marks=pytest.mark.slow),
        pytest.param(None, "cross_attention", marks=pytest.mark.slow),
        pytest.param(DIFFUSION, "cross_attention", marks=pytest.mark.slow),
    ],
    ids=["discrete", "continuous", "discrete-cross", "continuous-cross"],
)
def test_old_robots_answers_stay_bit_identical(diffusion, conditioning: str):
    config = model_config(diffusion=diffusion, conditioning=conditioning)
    declared, params = lively_params(config)
    with jax.transfer_guard_host_to_device("disallow_explicit"):  # one device may be too small for all parameters
        wider, table = add_embodiments(params, config, TABLE, NEWCOMERS, seed=3)
    batch = random_batch(0, config)
    decode = DecodeConfig(sampler=SamplerConfig(steps=3, temperature=0.0))

    def answer(declared, params, table):
        actions = np.pad(batch["actions"], ((0, 0), (0, 0), (0, table.action_width - TABLE.action_width)))

        def run(p):
            hma = declared.merge(p)
            out = hma(batch["tokens"], None, actions, batch["embodiment"])
            if out.action_features_BTD is None:
                return out.token_outputs, 0
            keys = jax.random.split(jax.random.key(0), 8)
            chunks = read_actions(hma, out, batch["embodiment"], keys, decode)
            return out.token_outputs, chunks[..., : TABLE.action_width]

        return jax.jit(run)(params)

    before = answer(declared, params, TABLE)
    after = answer(declare_model(config, table), wider, table)
    np.testing.assert_array_equal(before[0], after[0])
    np.testing.assert_array_equal(before[1], after[1])


@pytest.mark.parametrize(
    ("rows", "frames"), [(8, 6), *(pytest.param(*n, marks=pytest.mark.slow) for n in ((1, 1), (3, 4)))]
)
def test_an_old_robot_s_answer_does_not_depend_on_how_wide_the_table_is(rows: int, frames: int):
    """Kernels choose their blocks by the shapes they get: none of these may be the table's."""
    config = model_config(layers=1, frames=max(frames, 2))
    declared, params = lively_params(config)
    batch = {k: v[:rows] for k, v in random_batch(0, config).items()}
    tokens = batch["tokens"][:, :frames]

    def answer(declared, params, width: int) -> tuple[jax.Array, jax.Array]:
        actions = np.pad(batch["actions"][:, :frames], ((0, 0), (0, 0), (0, width - TABLE.action_width)))
        out = jax.jit(lambda p: declared.merge(p)(tokens, None, actions, batch["embodiment"]))(params)
        return out.token_outputs, out.action_features_BTD

    predictions, pooled = answer(declared, params, TABLE.action_width)
    for width in (33, 300):
        newcomer = Embodiment("newcomer", width, 1, (0.1,) * width, (2.0,) * width)
        wider, table = add_embodiments(params, config, TABLE, (newcomer,), seed=3)
        again = answer(declare_model(config, table), wider, table.action_width)
        np.testing.assert_array_equal(again[0], predictions)
        np.testing.assert_array_equal(again[1], pooled)


def test_new_robots_start_as_they_would_have_from_the_beginning():
    config = model_config()
    _, params = lively_params(config)
    wider, table = add_embodiments(params, config, TABLE, NEWCOMERS, seed=3)
    fresh = declare_model(config, table).init(3)
    assert table.names == (*TABLE.names, "humanoid", "cart")
    np.testing.assert_array_equal(wider["stem"]["into"]["kernel"][3:], fresh["stem"]["into"]["kernel"][3:])
    assert not wider["stem"]["into"]["kernel"][:3, TABLE.action_width :].any()
    np.testing.assert_array_equal(wider["trunk"]["blocks"]["space"]["qkv"], params["trunk"]["blocks"]["space"]["qkv"])


def test_a_name_the_model_knows_is_refused():
    config = model_config()
    _, params = lively_params(config)
    with pytest.raises(ConfigError, match="already knows arm"):
        add_embodiments(params, config, TABLE, [dataclasses.replace(NEWCOMERS[0], name="arm")], seed=0)
