"""What a model computes in its first steps is on record."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.golden.first_steps import COMMAND, MODELS, RECORD, first_steps


@pytest.mark.parametrize("name", MODELS)
def test_first_steps_give_the_metrics_on_record(name: str, tmp_path: Path):
    recorded, found = json.loads(RECORD.read_text())[name], first_steps(name, tmp_path)
    wrong = [
        f"step {step + 1}: {key}: {then.get(key)} on record, {now.get(key)} now"
        for step, (then, now) in enumerate(zip(recorded, found, strict=True))
        for key in sorted({*then, *now})
        if key not in then or key not in now or now[key] != pytest.approx(then[key], rel=2e-5, abs=1e-7)
    ]
    assert not wrong, "\n".join([*wrong, f"If a change was meant to alter them, record them anew: {COMMAND}"])
