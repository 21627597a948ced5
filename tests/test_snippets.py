"""Python programs of docs/ that need a model run as they are printed, on one that has learnt nothing."""

from __future__ import annotations

import re
from pathlib import Path

from tests.experiments.applications.runs import make_run
from tests.hma_jax.simulator.small import CONFIG

PAGE = Path(__file__).parents[1] / "docs" / "models.md"
SHIPPED = '"experiments/results/simulator"'


def test_the_program_of_the_page_on_models_rolls_out(tmp_path):
    """Its model is exchanged for a small one, which compiles in seconds; names, shapes and calls stay."""
    (text,) = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert text.count(SHIPPED) == 1
    names: dict = {}
    exec(text.replace(SHIPPED, repr(str(make_run(tmp_path)))), names)
    assert names["frames"].shape == (2, 3, 12 - 4, CONFIG.tokens)
