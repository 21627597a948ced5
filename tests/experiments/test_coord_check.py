"""`hma coord-check`: what is measured, printed and written."""

import csv
import math

import pytest

from experiments.bench import coord_check
from experiments.cli.main import main
from experiments.presets import get_preset
from experiments.report.plot_coords import plot_coords
from hma_jax.config import ConfigError
from hma_jax.diagnostics.coordinate_check import Size


def made(power: float):
    """A stand-in for `measure`: one activation that grows with this power of the width."""

    def measure(model, train, table, batch, widths, seeds):
        return [
            Size("logits", width, seed, step, width**power, 0.1 * step * width**power)
            for width in widths
            for seed in seeds
            for step in range(train.steps + 1)
        ]

    return measure


@pytest.mark.parametrize(
    ("power", "said"), [(0, "passed"), (0.5, "grows as width^0.50"), (-0.5, "fades as width^-0.50")]
)
def test_powers_are_printed_judged_and_written_with_a_figure(power, said, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(coord_check, "measure", made(power))
    out = tmp_path / "out"
    assert main(["coord-check", "--preset", "smoke", "--steps", "2", "--seeds", "2", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert said in printed and f"{power:+.2f}" in printed and "smoke, muP" in printed
    assert ("try more --steps" in printed) == (power < 0)
    with (out / "coord_check.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [int(r["width"]) for r in rows if r["seed"] == r["step"] == "0"] == [16, 32, 64, 128]
    assert len(rows) == 4 * 2 * 3 and (out / "coord_check.png").stat().st_size > 10_000


def test_the_study_s_model_and_optimiser_are_measured_on_short_windows(monkeypatch):
    asked = []
    monkeypatch.setattr(coord_check, "measure", lambda *all: asked.append(all) or [])
    study = get_preset("cpu")
    coord_check.measure_widths(study, (48, 96), 3, 1, 0.02)
    assert [widths for *_, widths, _ in asked] == [[48], [96]]
    model, train, table, batch, *_ = asked[0]
    assert (model.layers, model.action_alignment, model.trunk_gain) == (2, "causal", 0.5)
    assert batch["tokens"].shape == (coord_check.BATCH, model.frames, model.tokens) == (4, 3, 16)
    assert (train.steps, train.optimizer.learning_rate, train.optimizer.warmup_steps) == (3, 0.02, 0)
    assert (train.optimizer.matrices, train.masking.setting, table.size) == ("adamw", "forward", 1)


def test_models_are_trained_and_observed():
    rows = coord_check.measure_widths(get_preset("smoke"), (8,), 1, 1, 0.01)
    assert {(r.quantity, r.width, r.step) for r in rows} == {
        (quantity, 8, step) for quantity in ("attention logits", "residual stream", "logits") for step in (0, 1)
    }
    assert all(r.size > 0 and (r.change > 0) == (r.step > 0) for r in rows)


def test_the_learning_rate_is_the_study_s_unless_one_is_given(tmp_path, monkeypatch):
    rates = []
    monkeypatch.setattr(coord_check, "measure", lambda _, train, *rest: rates.append(train) or made(0)(_, train, *rest))
    for more in ([], ["--learning-rate", "0.5"]):
        assert main(["coord-check", "--preset", "smoke", "--steps", "1", "--out", str(tmp_path), *more]) == 0
    assert {train.optimizer.learning_rate for train in rates} == {1e-3, 0.5}


@pytest.mark.parametrize("sizes", [(0.0, 1.0, math.inf, math.nan), (math.nan, math.nan), (0.0, math.inf)], ids=str)
def test_a_model_that_diverged_is_drawn_as_far_as_it_can_be(sizes, tmp_path):
    plot_coords([Size("x", 8 * 2**i, 0, 1, size, size) for i, size in enumerate(sizes)], tmp_path / "x.png")
    assert (tmp_path / "x.png").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--widths", "16"], "--widths must be at least two different widths, got 16"),
        (["--widths", "16", "15"], "model.width 15 is not a multiple of model.heads 2"),
        (["--steps", "0"], "--steps must be at least 1"),
        (["--seeds", "0"], "--seeds must be at least 1"),
    ],
)
def test_what_cannot_be_checked_is_refused(arguments, said, capsys):
    assert main(["coord-check", "--preset", "smoke", *arguments]) == 2
    assert said in capsys.readouterr().err


def test_widths_are_sorted_once_each():
    model = get_preset("smoke").model
    assert coord_check.choose_widths(model, (32, 16, 32)) == (16, 32)
    with pytest.raises(ConfigError, match="two different widths"):
        coord_check.choose_widths(model, (16, 16))
