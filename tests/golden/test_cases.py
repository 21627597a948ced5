"""The small copies of reference cases kept here, and that a wrong number is not overlooked."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hma_jax.convert.tensors import read_safetensors, write_safetensors
from tests.golden import verify

HERE = Path(__file__).parent
CASES = sorted(path.name for path in HERE.iterdir() if (path / "README.md").exists())


VARIANTS = {
    "01b_discrete_concat_modulate_mup", "08d_mar_joint_actions", "08e_mar_mup_unit_width", "10b_vae_decoder_32groups",
}  # fmt: skip
"""Cases that say little beyond others (of 01b: 01d has loss and gradients of its logits; of 08d: 08c its sampler, 07 its
joint actions; of 10b: 10a); `make test-slow` has them."""


@pytest.mark.slow  # compiled as users compile, which takes three times as long
@pytest.mark.exact
@pytest.mark.parametrize("name", CASES)
def test_the_official_release_s_numbers(name: str):
    assert verify.main([str(HERE / name)]) == 0


@pytest.mark.parametrize("name", sorted(set(CASES) - VARIANTS))
def test_the_official_release_s_numbers_compiled_quickly(name: str):
    assert verify.main([str(HERE / name)]) == 0


def rewrite(path: Path, change) -> None:
    arrays = dict(np.load(path))
    change(arrays)
    np.savez(path, **arrays)


def said(capsys) -> str:
    return capsys.readouterr().out


def test_one_wrong_number_fails(copy, capsys):
    case = copy("14_collators")

    def change(arrays):
        arrays["mlm__input_ids"][1, 20] += 1

    rewrite(case / "outputs.npz", change)
    assert verify.main([str(case)]) == 1
    assert "FAIL mlm__input_ids  1 of 128 differ" in said(capsys)


def test_a_float_outside_its_tolerance_or_not_a_number_fails(copy, capsys):
    case = copy("04_discrete_mlp")
    allowed = json.loads((case / "case.json").read_text())["tolerance"]["logits__arm7"]["atol"]

    def change(arrays):
        arrays["logits__arm7"][0, 3, 1, 2, 0] += 3 * allowed + 1e-3
        arrays["logits__push2"][0, 0, 0, 0, 0] = np.nan

    rewrite(case / "outputs.npz", change)
    assert verify.main([str(case)]) == 1
    out = said(capsys)
    assert "FAIL logits__arm7" in out and "FAIL logits__push2" in out


def test_other_weights_fail(copy, capsys):
    case = copy("04_discrete_mlp")
    path = case / "model.safetensors"
    tensors = {name: tensor.read() for name, tensor in read_safetensors(path).items()}
    tensors["decoder.layers.1.temporal_attn.proj.bias"][5] += 0.1
    write_safetensors(path, tensors)
    assert verify.main([str(case)]) == 1
    assert "FAIL logits__arm7" in said(capsys)


def test_what_is_not_compared_fails(copy, capsys):
    case = copy("14_collators")
    rewrite(case / "outputs.npz", lambda arrays: arrays.update(mystery=np.zeros(3)))
    assert verify.main([str(case)]) == 1
    assert "FAIL not compared: mystery" in said(capsys)


def test_unknown_kinds_are_named(tmp_path, capsys):
    (tmp_path / "telepathy").mkdir()
    (tmp_path / "telepathy" / "case.json").write_text(json.dumps({"kind": "telepathy"}))
    assert verify.main([str(tmp_path / "telepathy")]) == 1
    assert "FAIL unknown" in said(capsys)


@pytest.mark.parametrize(
    ("name", "weight"),
    [
        ("09b_tokenizer_five_levels", "encoder.down.3.downsample.bias"),
        pytest.param(
            "10b_vae_decoder_32groups", "decoder.up_blocks.1.resnets.2.time_mixer.mix_factor", marks=pytest.mark.slow
        ),
    ],
)
def test_other_weights_of_a_tokenizer_fail(name, weight, copy, capsys):
    case = copy(name)
    path = case / "model.safetensors"
    tensors = {name: tensor.read() for name, tensor in read_safetensors(path).items()}
    tensors[weight] = tensors[weight] + np.float32(0.5)
    write_safetensors(path, tensors)
    assert verify.main([str(case)]) == 1
    out = said(capsys)
    assert "FAIL pre_quantised__images" in out or "FAIL decoded_num_frames2" in out


def test_pixels_off_by_more_than_rounding_fail(copy, capsys):
    case = copy("10a_vae")

    def change(arrays):
        pixels = arrays["decoded_uint8_num_frames1"]
        pixels[0, 0, 3, 3] = (int(pixels[0, 0, 3, 3]) + 2) % 256

    rewrite(case / "outputs.npz", change)
    assert verify.main([str(case)]) == 1
    assert "FAIL decoded_uint8_num_frames1" in said(capsys)


# --- What other cases of the format hold ---------------------------------------------------------


def test_a_schedule_is_compared_at_any_points(tmp_path, capsys):
    points, values = [2 / 3, 0.0, 0.5, 1 / 3, 1.0], [0.5, 1.0, 0.5**0.5, 0.75**0.5, 6.123233995736766e-17]
    path = tmp_path / "cosine_schedule.json"
    path.write_text(json.dumps({"u": points, "value": values}))
    assert verify.main([str(tmp_path)]) == 0
    path.write_text(json.dumps({"u": points, "value": [*values[:3], values[3] + 1e-9, values[4]]}))
    assert verify.main([str(tmp_path)]) == 1
    assert "FAIL cosine_schedule" in said(capsys)


def test_learning_rates_without_warm_up_start_at_once(tmp_path):
    table = {"warmup_steps": 0, "total_steps": 10, "index": [0, 1, 9], "constant_with_warmup": [1.0, 1.0, 1.0]}
    (tmp_path / "learning_rate.json").write_text(json.dumps(table))
    assert verify.main([str(tmp_path)]) == 0


def test_norms_of_changes_are_compared(copy, capsys):
    """Those of the release's own parameters before and after; one of them is then made wrong."""
    case = copy("13_discrete_train_steps")
    start = {name: tensor.read() for name, tensor in read_safetensors(case / "model.safetensors").items()}
    before = len(np.load(case / "outputs.npz").files)

    def change(arrays):
        for key in [key for key in arrays if key.startswith("final::")]:
            name, final = key.removeprefix("final::"), arrays.pop(key)
            arrays[f"final_change_norm::{name}"] = np.linalg.norm(final - start[name])
        arrays["final_change_norm::pos_embed_TSC"] *= 1.01

    rewrite(case / "outputs.npz", change)
    info = json.loads((case / "case.json").read_text())
    tolerance = {key.replace("final::", "final_change_norm::"): value for key, value in info["tolerance"].items()}
    (case / "case.json").write_text(json.dumps(info | {"tolerance": tolerance}))
    assert verify.main([str(case)]) == 1
    out = said(capsys)
    assert out.count("FAIL") == 1 and "FAIL final_change_norm::pos_embed_TSC" in out
    assert out.count("ok   final_change_norm::") == before - 3


def test_a_broken_case_does_not_stop_the_others(copy, capsys):
    broken = copy("04_discrete_mlp")
    (broken / "model.safetensors").write_bytes(b"not a safetensors file")
    assert verify.main([str(broken), str(HERE / "14_collators")]) == 1
    assert "2 cases: 1 good, 1 failed" in said(capsys)
