"""What a block keeps for its backward pass, under every policy."""

from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax._src.cudnn import fused_attention_stablehlo

from hma_jax.config import DiffusionConfig, ExecutionConfig
from hma_jax.config.execution import Remat
from hma_jax.kernels import cudnn
from hma_jax.kernels.remat import checkpointed
from hma_jax.model.hma import declare_model
from tests.tiny import SMALLER, TABLE, lively_params, model_config, random_batch

CONFIG = model_config(width=16, layers=5, tokens=12, action_tokens=4)
BATCH = random_batch(0, CONFIG, 2)


def loss_of(remat: str, config=CONFIG):
    declared = declare_model(config, TABLE, ExecutionConfig(remat=remat))

    def loss(params):
        out = declared.merge(params)(BATCH["tokens"], None, BATCH["actions"], BATCH["embodiment"])
        return jnp.sum(jnp.sin(out.token_outputs))

    return loss


def widths_kept(remat: str) -> float:
    """Per layer and token, in units of D."""
    _, params = lively_params(CONFIG)
    backward = jax.eval_shape(lambda p: jax.vjp(loss_of(remat), p)[1], params)
    kept = sum(x.size for x in jax.tree.leaves(backward) if x.shape[:2] == (CONFIG.layers, 2))
    return kept / (CONFIG.layers * 2 * CONFIG.frames * CONFIG.frame_tokens * CONFIG.width)


INPUT, QUERIES_KEYS_VALUES, ATTENDED, SUM, MLP = 1, 3, 1, 1, 4
WEIGHTS_OVER_TIME = CONFIG.frames * CONFIG.heads / CONFIG.width


@pytest.mark.parametrize(
    "remat, widths",
    [
        ("everything", INPUT),
        ("attention", INPUT + 2 * ATTENDED + MLP),
        ("products", INPUT + 2 * (QUERIES_KEYS_VALUES + ATTENDED) + 3 * SUM + MLP + WEIGHTS_OVER_TIME),
    ],
)
def test_a_block_keeps_what_its_policy_says(remat: str, widths: float):
    assert widths_kept(remat) == pytest.approx(widths, rel=0.02)


@pytest.mark.parametrize("remat, computed", [("products", 1), ("attention", 1), ("everything", 2)])
def test_what_cudnn_leaves_for_its_gradient_is_kept(monkeypatch, remat: str, computed: int):
    """Traced only, as without a GPU the kernel does not run."""
    monkeypatch.setattr(fused_attention_stablehlo, "check_cudnn_version", lambda: 91000)
    block = checkpointed(lambda x, _: (jnp.sin(cudnn.within(x, 1.0)), None), remat, scanned=True)
    qkv = jnp.zeros((1, 2, 8, 3, 2, 8), jnp.bfloat16)
    traced = str(jax.make_jaxpr(jax.grad(lambda x: jnp.sum(block(x, None)[0])))(qkv))
    assert traced.count("dot_product_attention_bwd") == 1
    assert traced.count("dot_product_attention_fwd") == computed


def test_the_denoiser_keeps_what_its_policy_says_and_its_gradients_are_the_same():
    tokens, width, depth = 16, 8, 2
    config = model_config(**SMALLER, diffusion=DiffusionConfig(channels=3, patch=1, width=width, depth=depth))
    _, params = lively_params(config)
    x, z = jnp.linspace(-1, 1, 3 * tokens).reshape(-1, 3), jnp.ones((tokens, config.width))
    kept, gradients = {}, {}
    for remat in ("none", "products", "attention", "everything"):
        declared = declare_model(config, TABLE, ExecutionConfig(remat=remat))

        def loss(params, declared=declared):
            return jnp.sum(declared.merge(params).denoiser(x, jnp.arange(tokens), z) ** 2)

        backward = jax.eval_shape(lambda p, loss=loss: jax.vjp(loss, p)[1], params)
        numbers = sum(leaf.size for leaf in jax.tree.leaves(backward) if leaf.shape[:1] == (tokens,))
        kept[remat] = numbers / (tokens * width * depth)
        if remat in ("none", "everything"):
            gradients[remat] = jax.tree.leaves(jax.jit(jax.grad(loss))(params))
    assert kept["attention"] - kept["everything"] == 1  # the first product
    assert kept["products"] - kept["everything"] == 5  # shift, scale, gate, and both products
    assert kept["none"] > kept["products"] + 3
    for got, want in zip(gradients["everything"], gradients["none"], strict=True):
        np.testing.assert_allclose(got, want, atol=2e-5 * np.abs(want).max())


@pytest.mark.slow
@pytest.mark.parametrize("layers", [2, 5], ids=["written out", "scanned"])
def test_gradients_are_the_same_under_every_policy_and_the_more_is_kept_the_more_memory(layers: int):
    config = model_config(width=16, layers=layers, tokens=64, action_tokens=4)
    batch = random_batch(0, config, 2)
    _, params = lively_params(config)
    gradients, memory = {}, {}
    for remat in get_args(Remat):
        declared = declare_model(config, TABLE, ExecutionConfig(remat=remat))

        def loss(params, declared=declared):
            out = declared.merge(params)(batch["tokens"], None, batch["actions"], batch["embodiment"])
            return jnp.sum(jnp.sin(out.token_outputs))

        compiled = jax.jit(jax.grad(loss)).lower(params).compile()
        gradients[remat] = compiled(params)
        memory[remat] = compiled.memory_analysis().temp_size_in_bytes
    for remat, found in gradients.items():
        for got, want in zip(jax.tree.leaves(found), jax.tree.leaves(gradients["none"]), strict=True):
            np.testing.assert_allclose(got, want, atol=2e-5 * np.abs(want).max(), err_msg=remat)
    if layers > 2:
        assert memory["none"] > 1.2 * memory["products"]
        assert memory["products"] > 1.2 * memory["attention"] > 1.2 * memory["everything"]
