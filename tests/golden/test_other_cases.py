"""Reference cases of other kinds than those kept here: what the checker must take in."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest

from hma_jax.convert import read_magvit2
from hma_jax.convert.tensors import read_safetensors
from tests.golden import verify
from tests.golden.test_cases import rewrite, said
from tests.hma_jax.pretrained import write_published


def test_a_training_case_without_mup_is_trained_without_it(copy, capsys):
    """Adam's first step moves every parameter with a gradient by the learning rate, here one and the same."""
    case = copy("13_discrete_train_steps")
    settings = json.loads((case / "config.json").read_text())
    (case / "config.json").write_text(json.dumps(settings | {"use_mup": False}))
    info = json.loads((case / "case.json").read_text())
    optimizer = info["optimizer"] | {"weight_decay": 0.0, "eps": 1e-12}
    name = "decoder.layers.1.mlp.fc1.weight"  # under muP by a rate of its own
    moved = read_safetensors(case / "model.safetensors")[name].read().size ** 0.5 * optimizer["lr"]
    steps = {"step_domains": info["step_domains"][:1], "optimizer": optimizer}
    tolerance = {f"final_change_norm::{name}": {"atol": 0.0, "rtol": 1e-4}}
    (case / "case.json").write_text(json.dumps(info | steps | {"mup": "off", "tolerance": tolerance}))
    np.savez(case / "outputs.npz", **{f"final_change_norm::{name}": np.float32(moved)})
    assert verify.main([str(case)]) == 0, said(capsys)


@pytest.mark.parametrize(
    "sizes", [*(pytest.param(s, marks=pytest.mark.slow) for s in ([(12, 20)], [(20, 12), (4, 2)])), []], ids=str
)
def test_images_of_any_size_that_the_levels_can_halve_are_compared(sizes, tmp_path, capsys):
    """Of a tokenizer of two levels; without images there are ids to decode."""
    case = write_published(tmp_path / "case", "magvit2")
    (case / "case.json").write_text(json.dumps({"kind": "tokenizer"}))
    ids = np.random.default_rng(1).integers(0, 64, (2, 3, 5), np.int32)
    inputs, outputs = {"random_indices": ids}, {}
    tokenizer = read_magvit2(case, image_size=(6, 10))
    images = np.asarray(jax.jit(tokenizer.decode_fn)(tokenizer.params, ids.reshape(2, 15)))
    outputs["decoded_uint8__random_indices"] = np.moveaxis(images.astype(np.uint8), -1, 1)
    for height, width in sizes:
        tokenizer, name = read_magvit2(case, image_size=(height, width)), f"images_{height}x{width}"
        images = np.random.default_rng(0).integers(0, 256, (2, height, width, 3), np.uint8)
        inputs[name] = np.moveaxis(images, -1, 1).astype(np.float32) / 127.5 - 1
        outputs[f"indices__{name}"] = tokenizer.encode(images).reshape(2, height // 2, width // 2)
    np.savez(case / "inputs.npz", **inputs)
    np.savez(case / "outputs.npz", **outputs)
    assert verify.main([str(case)]) == 0, said(capsys)
    rewrite(case / "inputs.npz", lambda arrays: arrays.update(random_indices=ids[:, ::-1]))
    assert verify.main([str(case)]) == 1
