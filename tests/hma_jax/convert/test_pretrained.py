"""Published tokenizers: every tensor in its place or refused by name, and no code of a file run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.convert import find_reader, read_magvit2
from hma_jax.convert.pretrained import MAGVIT2, SVD_VAE, has_average, tokenizer_params, tokenizer_shapes
from hma_jax.convert.tensors import Stored, write_safetensors
from hma_jax.tokenizers.io import load_tokenizer, save_tokenizer
from tests.hma_jax.convert.test_torch_file import Call, Global, Malicious, state_dict, write_torch
from tests.hma_jax.pretrained import OFFICIAL, noise, official_tensors, write_published

LISTS = Path(__file__).parents[2] / "golden" / "00_key_shapes"
FULL_SIZE = {"magvit2": MAGVIT2, "svd_vae": SVD_VAE}


def small(path: Path):
    return find_reader(path)(path, image_size=16)


def checkpoint(folder: Path, others: dict | None = None, tensors: dict | None = None) -> Path:
    """magvit2.ckpt of a training run beside its config.json."""
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(OFFICIAL["magvit2"][1]))
    weights = tensors or official_tensors("magvit2")
    besides = {"loss.logvar": np.zeros(3, np.float32), "model_ema.decay": np.ones((), np.float32)}
    averages = {f"model_ema.{name.replace('.', '')}": 0.5 * x for name, x in weights.items()}
    state, elements = state_dict(weights | besides | averages)
    write_torch(folder / "magvit2.ckpt", {"epoch": 3, "state_dict": state, **(others or {})}, elements)
    return folder


# --- Files -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", OFFICIAL)
def test_what_was_imported_stays_the_same_when_saved_and_loaded(kind, tmp_path):
    tokenizer = small(write_published(tmp_path / "published", kind))
    assert tokenizer.kind == kind
    save_tokenizer(tokenizer, tmp_path / "ours")
    again = load_tokenizer(tmp_path / "ours", expect=tokenizer.config)
    tokens = tokenizer.encode(noise(3))
    assert again.identity == tokenizer.identity and len(np.unique(tokens)) > 3
    assert np.array_equal(again.encode(noise(3)), tokens)
    assert np.array_equal(again.decode(tokens), tokenizer.decode(tokens))


def test_checkpoint_of_a_training_run_is_the_same_tokenizer(tmp_path):
    """Its loss, its averaged weights and what the trainer keeps are left out."""
    trainer = Call(Global("pytorch_lightning.callbacks", "ModelCheckpoint"), Global("typing", "Any"), [1])
    folder = checkpoint(tmp_path / "a", {"callbacks": {"checkpoint": trainer}, "lr_schedulers": [{"t": 1}]})
    plain = write_published(tmp_path / "b", "magvit2")
    assert small(folder).identity == small(plain).identity


def test_averaged_weights_of_a_training_run_are_read_on_request(tmp_path):
    """Those of the parameters that are read, under their names without dots."""
    last, plain = checkpoint(tmp_path / "a"), write_published(tmp_path / "b", "magvit2")
    halved = {name: 0.5 * x for name, x in official_tensors("magvit2").items()}
    expected = small(checkpoint(tmp_path / "c", tensors=halved))
    assert read_magvit2(last, image_size=16, weights="ema").identity == expected.identity != small(last).identity
    assert has_average(last) and not has_average(plain)
    with pytest.raises(ConfigError, match=r"b has no averaged weights \(model_ema.\*\) for (\d+) of \1 tensors"):
        read_magvit2(plain, image_size=16, weights="ema")


def test_a_decoder_with_adaptive_normalisation_is_refused_as_such(tmp_path):
    """Later Open-MAGVIT2: a list of names did not tell it from a wrong file."""
    more = {"decoder.adaptive.0.gamma.weight": np.zeros((8, 6), np.float32)}
    folder = checkpoint(tmp_path / "a", tensors=official_tensors("magvit2") | more)
    with pytest.raises(ConfigError, match=r"adaptive normalisation \(decoder.adaptive.\*\), which is not supported"):
        small(folder)


def test_a_file_alone_is_of_the_published_size(tmp_path):
    """Which these tensors are not."""
    path = write_published(tmp_path / "a", "magvit2") / "model.safetensors"
    shapes = r"expected \(512, 18, 3, 3\), found \(8, 6, 3, 3\)"
    with pytest.raises(ConfigError, match=f"decoder.conv_in.weight: {shapes}"):
        read_magvit2(path)


@pytest.mark.parametrize("name", ["diffusion_pytorch_model.bin", "diffusion_pytorch_model.fp16.safetensors"])
def test_other_files_of_diffusers(name, tmp_path):
    folder = write_published(tmp_path / "a", "svd-vae")
    tensors = official_tensors("svd-vae")
    (folder / "diffusion_pytorch_model.safetensors").unlink()
    if name.endswith(".bin"):
        write_torch(folder / name, *state_dict(tensors))
        assert small(folder).identity == small(write_published(tmp_path / "b", "svd-vae")).identity
    else:
        write_safetensors(folder / name, {n: x.astype(np.float16) for n, x in tensors.items()})
        got = np.asarray(small(folder).params["quant_conv"]["bias"])
        np.testing.assert_array_equal(got, tensors["quant_conv.bias"].astype(np.float16))


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    victim = tmp_path / "was_here"
    alone = write_torch(tmp_path / "magvit2.ckpt", Malicious(victim), {})
    with pytest.raises(ConfigError, match="something other than names and tensors"):
        small(alone)
    small(checkpoint(tmp_path / "hidden", {"hyper_parameters": Malicious(victim)}))  # passed over
    assert not victim.exists()


def test_objects_of_a_trainer_in_place_of_weights_are_refused(tmp_path):
    for call in (Call(Global("omegaconf", "OmegaConf"), 1), Call(Global("builtins", "dict"), [])):
        path = write_torch(tmp_path / "x.ckpt", {"state_dict": {"encoder.conv_in.weight": call}}, {})
        with pytest.raises(ConfigError, match="something other than names and tensors"):
            read_magvit2(path)


# --- Names and shapes --------------------------------------------------------------------------


def full_size(name: str):
    content = json.loads((LISTS / f"{name}.json").read_text())
    source = FULL_SIZE[name]
    declared = source.tokenizer.declare(source.config(content["config"], name))
    return source, declared, {n: tuple(shape) for n, shape in content["shapes"].items()}


def stored(shapes: dict[str, tuple[int, ...]]) -> dict[str, Stored]:
    def read() -> np.ndarray:
        raise AssertionError("names and shapes are looked at before anything is read")

    return {name: Stored(shape, np.dtype(np.float32), read) for name, shape in shapes.items()}


@pytest.mark.parametrize("name", FULL_SIZE)
def test_full_size_lists_are_accepted_and_any_other_is_refused_by_name(name):
    source, declared, shapes = full_size(name)
    assert tokenizer_shapes(source, declared) == shapes
    with pytest.raises(AssertionError, match="before anything is read"):
        tokenizer_params(source, declared, stored(shapes), name)
    victim = "decoder.conv_in.weight"
    changes = {
        rf"1 missing: {victim}": {n: s for n, s in shapes.items() if n != victim},
        r"1 not expected: quantize.mask \(18,\)": shapes | {"quantize.mask": (18,)},
        rf"1 with another shape: {victim}: expected": shapes | {victim: (3, *shapes[victim][1:])},
    }
    for message, changed in changes.items():
        with pytest.raises(ConfigError, match=message):
            tokenizer_params(source, declared, stored(changed), name)


def test_defaults_are_the_published_configurations():
    for name, source in FULL_SIZE.items():
        content = json.loads((LISTS / f"{name}.json").read_text())
        assert source.config(content["config"], name) == source.tokenizer.config_class()


def test_integer_weights_are_refused(tmp_path):
    folder = write_published(tmp_path / "a", "svd-vae")
    tensors = official_tensors("svd-vae")
    tensors["quant_conv.bias"] = tensors["quant_conv.bias"].astype(np.int32)
    write_safetensors(folder / "diffusion_pytorch_model.safetensors", tensors)
    with pytest.raises(ConfigError, match="not of type .*quant_conv.bias.*int32"):
        small(folder)


def test_weights_that_are_not_finite_are_refused(tmp_path):
    folder = write_published(tmp_path / "a", "svd-vae")
    tensors = official_tensors("svd-vae")
    tensors["quant_conv.bias"][0] = np.nan
    write_safetensors(folder / "diffusion_pytorch_model.safetensors", tensors)
    with pytest.raises(ConfigError, match="quant_conv.bias contains values that are not finite"):
        small(folder)


# --- config.json -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        ("svd-vae", {"_class_name": "AutoencoderKL"}, "describes AutoencoderKL, which is not supported; supported are"),
        ("svd-vae", {"in_channels": 1}, "in_channels is 1, but only 3 is supported"),
        ("svd-vae", {"block_out_channels": None}, "missing field.*block_out_channels"),
        ("svd-vae", {"block_out_channels": [4, 7]}, "a level of 7 channels cannot be split into 2 groups"),
        ("svd-vae", {"layers_per_block": "two"}, "expected int, got 'two'"),
        ("magvit2", {"ch_mult": None}, "missing field.*ch_mult"),
        ("magvit2", {"token_factorization": True}, "token_factorization is True"),
    ],
)
def test_other_architectures_are_refused_by_the_field(kind, changes, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        small(write_published(tmp_path / "a", kind, **changes))


def test_a_directory_of_the_published_file_alone_says_to_give_the_file(tmp_path):
    (tmp_path / "magvit2.ckpt").touch()
    with pytest.raises(ConfigError, match=r"no .*config.json.*MAGVIT2 tokenizer give the file itself, magvit2.ckpt"):
        find_reader(tmp_path)


def test_a_directory_of_something_else(tmp_path):
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(ConfigError, match="describes no tokenizer"):
        find_reader(tmp_path)
    folder = write_published(tmp_path / "a", "svd-vae")
    (folder / "diffusion_pytorch_model.safetensors").unlink()
    with pytest.raises(ConfigError, match="has none of diffusion_pytorch_model.safetensors"):
        small(folder)
