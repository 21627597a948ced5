"""Python programs of docs/ that need a model run as they are printed, with a small one that has learnt nothing."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

from data_pipelines.tokens.import_tokens import import_tokens
from hma_jax import ExecutionConfig, load_model
from tests.data_pipelines.tokens.test_import_tokens import write_folder
from tests.experiments.applications.runs import make_run
from tests.hma_jax.simulator.small import CONFIG
from tests.tiny import SMALLER, model_config, train_config

DOCS = Path(__file__).parents[1] / "docs"
PAGE = DOCS / "models.md"
SHIPPED = '"experiments/results/simulator"'


def test_the_program_of_the_page_on_models_rolls_out(tmp_path):
    """Its model is exchanged for a small one, which compiles in seconds; names, shapes and calls stay."""
    (text,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert text.count(SHIPPED) == 1
    names: dict = {}
    exec(text.replace(SHIPPED, repr(str(make_run(tmp_path)))), names)
    assert names["frames"].shape == (2, 3, 12 - 4, CONFIG.tokens)


def test_the_program_of_the_page_on_own_data_trains_on_imported_tokens(tmp_path, monkeypatch):
    """Its preset is exchanged for a small one; the command before it is parsed with those of all pages."""
    import_tokens(*(write_folder(tmp_path / f"toy_{split}") for split in ("train", "val")), tmp_path / "imported", hz=4)
    programs = re.findall(r"^```python\n(.*?)^```", (DOCS / "own_data.md").read_text(), re.MULTILINE | re.DOTALL)
    (text,) = [program for program in programs if "train_model" in program]
    assert text.count('get_preset("accelerator")') == 1
    train = train_config(steps=2, batch=2)
    small = SimpleNamespace(model=model_config(**SMALLER), train=train, execution=ExecutionConfig())
    monkeypatch.chdir(tmp_path)
    names: dict = {"small": small}
    exec(text.replace('get_preset("accelerator")', "small"), names)
    model = load_model("imported_model")
    assert len(names["result"].losses) == train.steps
    assert model.table.names == ("toy_arm",) and model.config.tokens == 16
