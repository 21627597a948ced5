"""Models that never were official: written so that the release computes the same, or refused by name."""

from __future__ import annotations

import json
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import Conditioning, ConfigError, ExecutionConfig, MaskingConfig, MupConfig
from hma_jax.convert import loads_in_release, read_official, write_official
from hma_jax.convert.multipliers import folded, query_ratio, readout_ratio
from hma_jax.convert.official import official_config, official_tensors
from hma_jax.convert.official_config import NETWORKS, write_config
from hma_jax.convert.release_limits import require_official
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.training.runs import Run
from tests.hma_jax.convert.fakes import CONTINUOUS, make_checkpoint
from tests.tiny import DIFFUSION, TABLE, in_float64, lively_params, model_config, random_batch, train_config

RELEASED = replace(DIFFUSION, steps=1000)
"""The process that the release has."""


@contextmanager
def computing_in_float64():
    """What is float32 otherwise is computed in float64: how products round depends on the processor, and only the
    float32 in which weights are written is left to tell two models apart."""
    with jax.enable_x64(True), pytest.MonkeyPatch.context() as patch:
        patch.setattr(jnp, "float32", jnp.float64)
        yield in_float64()


def everything(config, params, execution: ExecutionConfig) -> dict[str, np.ndarray]:
    """All that a model computes: of frames, and of actions where it has heads for them."""
    declared, batch = declare_model(config, TABLE, execution), jax.tree.map(jnp.asarray, random_batch(0, config, 2))
    params = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), execution.dtype), params)
    rng, robots = np.random.default_rng(0), batch["embodiment"]
    own = np.arange(TABLE.action_width) < TABLE.chunks[np.asarray(robots), None]  # beyond it is padding
    alive = TABLE.alive()[np.asarray(robots)][:, None]  # other values are 0, also when noised

    def apply(params):
        model = declared.merge(params)
        out = model(batch["tokens"], None, batch["actions"], robots)
        made = {"frames": out.token_outputs}
        if config.diffusion:
            time = jnp.asarray(rng.integers(0, 1000, batch["tokens"].shape[:3]))
            made["denoiser"] = model.denoiser(batch["tokens"], time, out.token_outputs)
        if config.action_heads:
            noised = (jnp.where(alive, batch["actions"], 0), time[..., 0]) if config.diffusion else ()
            actions = model.action_head(*noised, out.action_features_BTD, robots)
            actions = actions.reshape(*actions.shape[:2], -1, TABLE.action_width)
            made["actions"] = jnp.where(own[:, None, None], actions, 0)
        return made

    return jax.jit(apply)(params)


def written(config, params, folder: Path, step: int = 7) -> tuple[Run, dict, list[str]]:
    """What is read back, its config.json and the remarks, without that on the tiny vocabulary of all models here."""
    remarks = write_official(Run(config, train_config(), TABLE, params, step, {}), folder)
    remarks = [remark for remark in remarks if "2 factors of 8 entries" not in remark]
    return read_official(folder), json.loads((folder / "config.json").read_text()), remarks


def same_numbers(config, params, back: Run) -> None:
    assert back.table.names == TABLE.names
    np.testing.assert_array_equal(back.table.statistics(), TABLE.statistics())
    with computing_in_float64() as execution:
        ours, theirs = everything(config, params, execution), everything(back.model, back.params, execution)
    for name, want in ours.items():
        np.testing.assert_allclose(theirs[name], want, rtol=0, atol=1e-6 * np.abs(want).max(), err_msg=name)


def test_a_discrete_model_keeps_mup_at_the_base_width_of_the_release(tmp_path):
    """Another muP base width, no action heads: read-outs are rescaled, heads are untrained."""
    config = model_config(action_heads=False, frames=3)
    _, params = lively_params(config)
    back, official, remarks = written(config, params, tmp_path / "a")
    assert any("0.125" in remark for remark in remarks) and any("untrained" in remark for remark in remarks)
    assert official["use_mup"] and back.model.mup.base_width == 256 and loads_in_release(official)
    same_numbers(config, params, back)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        pytest.param(
            {"diffusion": RELEASED, "mup": MupConfig()}, "continuous models of width 256 only", marks=pytest.mark.slow
        ),
        ({"qkv_bias": True, "mup": MupConfig(base_width=64, attention_scale=3.0)}, "attention scales of 8 /"),
        pytest.param(
            {"qk_norm": True, "mup": MupConfig(attention_scale=3.0)}, "attention scales of 8 /", marks=pytest.mark.slow
        ),
    ],
    ids=["continuous", "attention_scale", "attention_scale-qk_norm"],
)
def test_mup_that_the_release_cannot_hold_is_folded_into_the_weights(changes, said, tmp_path):
    config = model_config(frames=3, **changes)
    _, params = lively_params(config)
    back, official, remarks = written(config, params, tmp_path / "a")
    assert len(remarks) == 1 and said in remarks[0]
    assert official["use_mup"] is False and not back.model.mup.enabled and loads_in_release(official)
    same_numbers(config, params, back)


def test_folding_writes_only_what_stands_beside_a_multiplier():
    config = model_config(qkv_bias=True, mup=MupConfig(base_width=8))
    target = replace(config, mup=MupConfig(enabled=False))
    declared, params = lively_params(config)
    leaves = declared.leaves()
    arrays = {path: np.asarray(x) for path, x in zip(leaves, jax.tree.leaves(params), strict=True)}
    out = folded(arrays, leaves, config, target)
    assert readout_ratio(config, target) == 0.25 and query_ratio(config, target) == pytest.approx(8**0.5)
    changed = {path for path, x in out.items() if x is not arrays[path]}
    attention = {f"trunk/blocks/{axis}/{name}" for axis in ("space", "time") for name in ("qkv", "qkv_bias")}
    assert changed == attention | {"action_head/linear/kernel", "frame_head/linear/kernel"}
    for path in attention:
        np.testing.assert_array_equal(out[path][..., 1:, :, :], arrays[path][..., 1:, :, :])


def test_attention_that_does_not_follow_mup_folds_to_what_it_is(tmp_path):
    config = model_config(mup=MupConfig(base_width=8, without=("attention",)))
    params = declare_model(config, TABLE).init(0)
    back, _, remarks = written(config, params, tmp_path / "a")
    assert "queries are multiplied by 1, read-outs are multiplied by 0.25" in remarks[0]
    assert (back.params["trunk"]["blocks"]["time"]["qkv"] == params["trunk"]["blocks"]["time"]["qkv"]).all()


def test_mup_that_the_release_has_stays_on(tmp_path):
    config = model_config(diffusion=RELEASED, width=256, layers=1, frames=2, mup=MupConfig())
    _, official, remarks = written(config, declare_model(config, TABLE).init(0), tmp_path / "a")
    assert official["use_mup"] and loads_in_release(official) and not remarks


def test_what_came_with_mup_that_the_release_refuses_loses_it_once_it_is_trained(tmp_path):
    start = make_checkpoint(tmp_path / "a", CONTINUOUS, [("push", 2, 1)])
    trained = replace(read_official(start), step=3)
    remarks = write_official(trained, tmp_path / "b")
    assert "queries are multiplied by 2.82843" in remarks[0] and "heads is multiplied by 1." in remarks[0]
    before, after = (json.loads((tmp_path / x / "config.json").read_text()) for x in "ab")
    assert after == before | {"use_mup": False, "factored_vocab_size": 64}
    assert not loads_in_release(before) and loads_in_release(after)


def test_action_heads_that_a_model_lacks_can_be_trained_by_the_release():
    """Of a head that is all zeros, gains included, no gradient leaves zero."""
    config = model_config(diffusion=RELEASED, frames=3, action_heads=False)
    run = Run(config, train_config(), TABLE, declare_model(config, TABLE).init(0), 7, {})
    tensors, _ = official_tensors(run)
    head = "action_diff_losses.arm.net."
    assert (tensors[head + "res_blocks.0.in_ln.weight"] == 1).all()
    assert all(tensors[head + f"{layer}.weight"].any() for layer in ("input_proj", "cond_embed", "time_embed.mlp.0"))


@pytest.mark.parametrize("changes", [{}, {"diffusion": RELEASED}], ids=["discrete", "continuous"])
def test_action_values_that_do_not_vary_are_nothing_to_the_release_either(changes):
    """It divides their rounding noise by 1e-10."""
    config = model_config(frames=3, **changes)
    _, params = lively_params(config)
    tensors, _ = official_tensors(Run(config, train_config(), TABLE, params, 7, {}))
    takes = ["action_mlp.{}.model.0.weight", *(["action_diff_losses.{}.net.input_proj.weight"] if changes else [])]
    for name in takes:
        assert (tensors[name.format("base")] == 0).all(axis=0).tolist() == 3 * [False, True, False]
        assert (tensors[name.format("arm")] != 0).all()


def test_the_release_is_given_the_scale_that_the_model_has_in_both_files():
    config, robot = (
        model_config(frames=3),
        Embodiment("push", 2, 1, (0.0, 1.0), (1.0, 2.0), low=(-3.0, 0.0), high=(1.0, 8.0)),
    )
    table = EmbodimentTable((robot,))
    run = Run(config, train_config(), table, declare_model(config, table).init(0), 7, {})
    tensors, said = official_tensors(run)[0], official_config(run)["action_stats"]
    assert said == [[[-1.0, 4.0], [2.0, 4.0]]]
    assert said == [[tensors[f"action_preprocessor.push.{name}"].tolist() for name in ("mean", "std")]]


@pytest.mark.parametrize(("vocab", "said"), [(256, True), (512, False)])
def test_a_vocabulary_for_which_the_release_has_no_loss_is_said(vocab, said):
    config = model_config(frames=3, action_heads=True, factors=2, factor_vocab=vocab)
    _, remarks = official_tensors(Run(config, train_config(), TABLE, declare_model(config, TABLE).init(0), 7, {}))
    assert any("2 factors of 256 entries: the release generates frames" in remark for remark in remarks) == said


def test_another_range_of_clean_values_is_said(tmp_path):
    config = model_config(diffusion=replace(RELEASED, clip=4.0), mup=MupConfig(enabled=False))
    _, _, remarks = written(config, declare_model(config, TABLE).init(0), tmp_path / "a")
    assert remarks == ["while sampling the release keeps predicted clean values in +-10, this model in +-4"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"action_alignment": "causal"}, "action_alignment"),
        ({"conditioning": "cross_attention"}, "conditioning is 'cross_attention'"),
        ({"tokens": 12}, "model.tokens 12 is not a square number"),
        ({"recall": True}, "model.recall is true"),
        ({"chain_factors": True}, "model.chain_factors is true"),
        ({"diffusion": DIFFUSION}, "diffusion.steps is 20"),
    ],
)
def test_what_the_release_cannot_compute_is_refused_by_name(changes, message, tmp_path):
    config = model_config(**changes)
    run = Run(config, train_config(), TABLE, declare_model(config, TABLE).init(0), 0, {})
    with pytest.raises(ConfigError, match=message):
        write_official(run, tmp_path / "a")
    assert not (tmp_path / "a").exists()


@pytest.mark.parametrize("conditioning", [*get_args(Conditioning), "new"])
def test_a_way_of_conditioning_is_one_of_the_release_or_refused_by_name(conditioning):
    config = model_config()
    object.__setattr__(config, "conditioning", conditioning)  # as if a new one were there already
    if conditioning == "cross_attention" or conditioning not in NETWORKS.values():
        with pytest.raises(ConfigError, match=f"model.conditioning is '{conditioning}'"):
            require_official(config, TABLE)
    else:
        require_official(config, TABLE)
        assert NETWORKS[write_config(config, TABLE, MaskingConfig())["action_network"]] == conditioning


@pytest.mark.parametrize("setting", ["passive", "inverse"])
def test_a_model_that_is_used_otherwise_than_the_release_uses_all_is_refused(setting, tmp_path):
    train, config = train_config(masking=MaskingConfig(setting=setting)), model_config()
    run = Run(config, train, TABLE, declare_model(config, TABLE).init(0), 7, {})
    with pytest.raises(ConfigError, match=f"train.masking.setting is '{setting}'"):
        write_official(run, tmp_path / "a")
