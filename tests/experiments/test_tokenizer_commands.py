"""Tokenizers that are not trained here, through the commands: made, adopted by a study, evaluated with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from data_pipelines.registry import get_spec
from data_pipelines.windows.evalset import eval_batches
from experiments.cli.main import main
from experiments.presets import get_preset
from experiments.running.run_trial import open_prepared_data
from experiments.running.workspace import Workspace
from experiments.study import on_tokenizer
from experiments.user_input.override import override
from hma_jax.config import ConfigError, Magvit2Config, PixelsConfig, SvdVaeConfig, TokenizerConfig
from hma_jax.config.json import from_dict, to_json, to_strict_json
from hma_jax.convert.tensors import write_safetensors
from hma_jax.evaluation.summary import summarise
from hma_jax.evaluation.windows import FILE, WindowTable
from hma_jax.tokenizers.io import load_tokenizer
from tests.data_pipelines.fakes import write_rlds
from tests.hma_jax.convert.fakes import DISCRETE, official_config, random_tensors, write_checkpoint
from tests.hma_jax.pretrained import official_tensors, write_published

ARM = get_spec("berkeley_gnm_cory_hall")
LENGTHS = [12, 12, 13, 13, 14, 15]


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> str:
    return str(write_rlds(tmp_path_factory.mktemp("rlds"), ARM, LENGTHS))


@pytest.fixture(autouse=True)
def few_frames(monkeypatch):
    """Of which a tokenizer's quality is measured."""
    monkeypatch.setattr("experiments.preparing.tokenizer.QUALITY_FRAMES", 8)


def hma(*arguments: object) -> int:
    return main([str(a) for a in arguments])


def imported(root: Path, kind: str) -> Path:
    source = write_published(root / "published", kind)
    assert hma("tokenizer", "import", source, "--out", root / "tokenizer", "--image-size", 16) == 0
    return root / "tokenizer"


def released(folder: Path, vocab: int) -> Path:
    """A checkpoint of the official release for 64 tokens of the arm; its weights mean nothing."""
    robots = [(ARM.name, ARM.action_dim, ARM.stride)]
    config = official_config(DISCRETE, robots, S=64, image_vocab_size=vocab, T=4)
    tensors = random_tensors(config, robots)
    small = {name: x if "preprocessor" in name else np.float32(0.02) * x for name, x in tensors.items()}
    return write_checkpoint(folder, config, small)


@pytest.mark.slow
def test_released_model_is_evaluated_on_ids_of_an_imported_tokenizer(arm, tmp_path, capsys):
    """Random weights in both; but for their sizes, all is as with the published ones."""
    tokenizer, out = imported(tmp_path, "magvit2"), tmp_path / "out"
    common = ("--preset", "smoke", "--out", out, "--data", arm, "--tokenizer", tokenizer)
    assert hma("tokenize", *common) == 0
    assert hma("convert", "from-official", released(tmp_path / "a", 64), "--out", tmp_path / "run") == 0
    capsys.readouterr()
    assert hma("evaluate", tmp_path / "run", *common) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert (
        f"assumed that they are those of the tokenizer here, {load_tokenizer(tokenizer).identity}" in said
        and ", step" not in said
    )
    evaluation = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert evaluation[ARM.name]["perplexity"]["mean"] == pytest.approx(64, rel=0.3)
    windows = WindowTable.load(tmp_path / "run" / FILE)
    summary = summarise(windows, get_preset("smoke").eval.perplexity_group)
    assert to_strict_json(summary.to_dict()) == (tmp_path / "run" / "evaluation.json").read_text()
    assert evaluation[ARM.name]["psnr"]["episodes"] == len(set(windows.episode.tolist()))

    assert hma("convert", "from-official", released(tmp_path / "b", 256), "--out", tmp_path / "run2") == 0
    assert hma("evaluate", tmp_path / "run2", *common) == 2
    assert "2 factors with 16 entries" in capsys.readouterr().err


@pytest.mark.parametrize("kind", ["svd-vae", "pixels"])
def test_latents_of_a_given_tokenizer_reach_the_batches_that_a_model_takes(kind, arm, tmp_path, capsys):
    if kind == "pixels":
        tokenizer = tmp_path / "tokenizer"
        assert hma("tokenizer", "pixels", "--out", tokenizer, "--image-size", 16, "--patch", 4) == 0
    else:
        tokenizer = imported(tmp_path, kind)
    common = ("--preset", "smoke-continuous", "--out", tmp_path / "out", "--data", arm)
    assert hma("tokenize", *common, "--tokenizer", tokenizer) == 0
    unknown = "note: it is not written down on which frames the tokenizer was trained"  # pixels are of no training
    assert capsys.readouterr().out.count(unknown) == (kind != "pixels")
    prepared = open_prepared_data(Workspace(tmp_path / "out"))
    assert prepared.tokenizer.identity == load_tokenizer(tokenizer).identity
    table = prepared.store.embodiment_table([ARM.name], rate=2.0)
    batch = next(eval_batches(prepared.store, table, prepared.manifest, 2))
    model = on_tokenizer(get_preset("smoke-continuous"), prepared.tokenizer.config).model
    assert batch["tokens"].shape == (2, 4, model.tokens, model.diffusion.token_channels)
    frames = prepared.tokenizer.decode(batch["tokens"][0])
    assert frames.shape == batch["images"][0].shape
    if kind == "pixels":  # nothing is lost on the way through the store
        assert np.array_equal(frames, batch["images"][0])


def test_importing_again_overwrites_nothing(tmp_path, capsys):
    tokenizer = imported(tmp_path, "svd-vae")
    before = (tokenizer / "weights.npz").read_bytes()
    assert hma("tokenizer", "import", tmp_path / "published", "--out", tokenizer) == 2
    assert "exists already" in capsys.readouterr().err
    assert (tokenizer / "weights.npz").read_bytes() == before


def test_averaged_weights_are_left_out_with_a_note_or_read_instead(tmp_path, capsys):
    source = write_published(tmp_path / "published", "magvit2")
    tensors = official_tensors("magvit2")
    averages = {f"model_ema.{name.replace('.', '')}": 0.5 * x for name, x in tensors.items()}
    write_safetensors(source / "model.safetensors", tensors | averages)
    assert hma("tokenizer", "import", source, "--out", tmp_path / "last", "--image-size", 16) == 0
    assert "note: averaged weights (model_ema.*) are left out, as the release does" in capsys.readouterr().out
    arguments = ("--out", tmp_path / "ema", "--image-size", 16, "--weights", "ema")
    assert hma("tokenizer", "import", source, *arguments) == 0
    assert "note" not in capsys.readouterr().out
    last, average = (load_tokenizer(tmp_path / name).params["encoder"]["conv_in"]["kernel"] for name in ("last", "ema"))
    np.testing.assert_array_equal(average, 0.5 * last)


def test_no_tokenizer_is_trained_where_one_is_given(tmp_path, monkeypatch, capsys):
    """Another one was trained beside it, or the advice was to give it. What comes after the suite says so too."""
    monkeypatch.chdir(tmp_path)
    assert hma("tokenizer", "pixels", "--out", "tok", "--image-size", 16, "--patch", 4) == 0
    given = ("--preset", "smoke-continuous", "--out", "out", "--tokenizer", "tok")
    assert hma("tokenizer", "train", *given) == 2
    assert not Path("out").exists()
    on = f"hma tokenize {' '.join(given)}"
    said = f"given with --tokenizer, so none is trained; to use it: {on}; to train another, leave out --tokenizer"
    assert capsys.readouterr().err.strip().endswith(said)
    monkeypatch.setattr("experiments.preparing.suite.make_suite", lambda *_: [])
    assert hma("data", "suite", *given) == 0
    assert capsys.readouterr().out.strip().endswith(on)


# --- Studies -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("preset", "tokenizer", "expected"),
    [
        ("smoke", Magvit2Config(), {"tokens": 256, "factors": 2, "factor_vocab": 512}),
        ("paper", Magvit2Config(), {"tokens": 256, "factors": 2, "factor_vocab": 512}),
        ("cpu", TokenizerConfig(image_size=64, bits=8), {"tokens": 64, "factors": 2, "factor_vocab": 16}),
        ("smoke-continuous", SvdVaeConfig(), {"tokens": 256, "channels": 4, "patch": 2}),
        ("cpu-continuous", SvdVaeConfig(), {"tokens": 256, "channels": 4, "patch": 2}),  # as many values as its own
        ("smoke-continuous", SvdVaeConfig(patch=1), {"tokens": 1024, "channels": 4, "patch": 1}),
        ("smoke-continuous", PixelsConfig(), {"tokens": 64, "channels": 3, "patch": 8}),
    ],
)
def test_the_model_takes_what_the_given_tokenizer_makes(preset, tokenizer, expected):
    study = on_tokenizer(get_preset(preset), tokenizer)
    fields = {**vars(study.model), **(vars(study.model.diffusion) if study.model.diffusion else {})}
    fields["tokens"] = study.model.tokens
    assert {name: fields[name] for name in expected} == expected
    assert from_dict(type(study), json.loads(to_json(study))) == study
    assert override(study, ["train.steps=7"]).tokenizer == tokenizer


def test_ids_and_latents_do_not_mix():
    with pytest.raises(ConfigError, match="makes latents, the model of preset smoke takes ids"):
        on_tokenizer(get_preset("smoke"), SvdVaeConfig())
    with pytest.raises(ConfigError, match="makes ids, the model of preset smoke-continuous takes latents"):
        on_tokenizer(get_preset("smoke-continuous"), Magvit2Config())
