"""The tokenizer of a user's own code that docs/own_data.md shows, through the commands."""

from __future__ import annotations

import json

import pytest

from data_pipelines.registry import get_spec
from experiments.cli.main import main
from experiments.running.run_trial import open_prepared_data
from experiments.running.workspace import Workspace
from hma_jax.tokenizers.io import load_tokenizer
from tests.data_pipelines.fakes import write_rlds
from tests.experiments.idle import SMOKE
from tests.hma_jax.test_own_tokenizer import COLOURS, write

ARM = get_spec("berkeley_gnm_cory_hall")
LENGTHS = [12, 12, 13, 13, 14, 15]


def hma(*arguments: object) -> int:
    return main([str(a) for a in arguments])


@pytest.mark.slow
def test_the_tokenizer_of_the_page_goes_from_tokens_to_evaluation(tmp_path, capsys):
    data, tok, out = write_rlds(tmp_path / "rlds", ARM, LENGTHS), tmp_path / "tok", tmp_path / "out"
    colours = write(tmp_path / "colours", COLOURS)
    assert hma("tokenizer", "python", colours, "--out", tok) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "64 x 64 pixels to 64 tokens, ids of 1 factor with 1,000 entries" in said and f"--tokenizer {tok}" in said
    common = (*SMOKE, "--set", "train.steps=3", "--out", out, "--data", data)
    assert hma("tokenize", *common, "--tokenizer", tok) == 0
    prepared, tokenizer = open_prepared_data(Workspace(out)), load_tokenizer(tok)
    assert prepared.tokenizer.identity == tokenizer.identity
    assert prepared.tokenizer.folder == out / "tokenizer" / "files"

    assert hma("train", *common, "--tokenizer", tok) == 0
    assert hma("evaluate", out / "model", *common, "--tokenizer", tok) == 0
    (found,) = json.loads((out / "model" / "evaluation.json").read_text()).values()
    assert found["perplexity"]["mean"] == pytest.approx(1000, rel=0.3) and 0 < found["psnr"]["mean"] < 40

    changed = write(tmp_path / "changed", COLOURS, it=("digits + 0.5", "digits + 0.4"))
    assert hma("tokenizer", "python", changed, "--out", tmp_path / "other") == 0
    capsys.readouterr()
    assert hma("tokenize", *common, "--tokenizer", tmp_path / "other") == 2
    assert load_tokenizer(tmp_path / "other").identity in capsys.readouterr().err
