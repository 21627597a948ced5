"""Held-out loss while a run trains."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from hma_jax.config import ConfigError, ExecutionConfig, MaskingConfig
from hma_jax.model.hma import declare_model
from hma_jax.training import validation
from hma_jax.training.loop import LoopOptions
from hma_jax.training.train import train_model
from hma_jax.training.validation import Validation, make_sums, make_validation_hook
from tests.hma_jax.test_training import other_statistics
from tests.tiny import (
    DIFFUSION,
    SMALLER,
    TABLE,
    batches,
    lively_params,
    model_config,
    random_batch,
    train_config,
)

MODEL = model_config(**SMALLER)


def held_out():
    return [random_batch(1000 + n, MODEL, 4) for n in range(2)]


def run(run_dir: Path, validation: Validation | None):
    return train_model(
        MODEL, TABLE, train_config(batch=4, ema_decay=0.2), batches(MODEL, 4), run_dir=run_dir, provenance={},
        options=LoopOptions(log_every=1), validation=validation,
    )  # fmt: skip


def test_validation_changes_nothing_of_the_run_and_is_no_part_of_it(tmp_path: Path):
    plain = run(tmp_path / "plain", None)
    seen = run(tmp_path / "seen", Validation(2, held_out))
    series = [(tmp_path / d / "metrics.jsonl").read_bytes() for d in ("plain", "seen")]
    assert series[0] == series[1]
    for a, b in zip(jax.tree.leaves(plain.state), jax.tree.leaves(seen.state), strict=True):
        assert np.asarray(a).tobytes() == np.asarray(b).tobytes()
    lines = [json.loads(line) for line in (tmp_path / "seen" / "validation.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4, 6]
    assert lines[0].keys() == {"step", "loss", "accuracy", "ema_loss", "ema_accuracy"}
    assert len({line["loss"] for line in lines}) == 3 and lines[-1]["loss"] != lines[-1]["ema_loss"]
    assert not (tmp_path / "plain" / "validation.jsonl").exists()
    again = run(tmp_path / "seen", Validation(3, held_out))  # a finished run, watched otherwise: the same run
    assert again.resumed_from == 6


def test_datasets_that_batches_name_have_a_loss_each(tmp_path: Path):
    """With one number over all, a robot that gets worse among forty is not seen."""
    one, other, more = (random_batch(1000 + n, MODEL, 4) for n in range(3))
    named = [one | {"dataset": "arm"}, other | {"dataset": "base"}, more | {"dataset": "arm"}]

    def last_line(name: str, batches: list) -> dict[str, float]:
        run(tmp_path / name, Validation(6, lambda: batches))
        return json.loads((tmp_path / name / "validation.jsonl").read_text().splitlines()[-1])

    losses, unnamed = last_line("named", named), last_line("unnamed", [one, other, more])
    assert losses.keys() - unnamed.keys() == {f"{of}loss/{name}" for of in ("", "ema_") for name in ("arm", "base")}
    assert unnamed.items() <= losses.items()
    assert "loss/arm" not in last_line("one", [one | {"dataset": "arm"}]), "it is the loss"
    assert min(losses["loss/arm"], losses["loss/base"]) < losses["loss"] < max(losses["loss/arm"], losses["loss/base"])


def test_the_next_run_of_a_process_is_watched_by_the_same_program(tmp_path: Path):
    """Runs of a sweep over seeds, and a run that goes on, do not compile the held-out loss again."""
    run(tmp_path / "one", Validation(3, held_out))
    compiled: list[str] = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, _, **more: compiled.append(name) if name.endswith("backend_compile_duration") else None
    )
    run(tmp_path / "two", Validation(3, held_out))
    assert not compiled, f"{len(compiled)} programs were compiled again"
    jax.jit(lambda x: x + len(compiled))(np.float32(1))
    assert compiled, "the listener hears nothing"


def test_runs_that_differ_in_the_statistics_of_actions_are_watched_by_the_same_program(monkeypatch):
    """A sweep over how many trajectories there are compiled the held-out loss of every run anew."""
    model, measured = replace(MODEL, action_heads=False), []

    def measure_only(step, shapes, init, make, *, validation, **kwargs):
        measured.append(validation.measure(init())["loss"])

    monkeypatch.setattr("hma_jax.training.train.fit", measure_only)
    tables = TABLE, other_statistics(TABLE)
    for table in tables:
        train_model(
            model, table, train_config(batch=4), batches(model, 4), run_dir="never written", provenance={},
            validation=Validation(2, held_out),
        )  # fmt: skip
    assert validation._jitted_sums.cache_info().misses == 1
    for table, loss in zip(tables, measured, strict=True):
        declared, params = declare_model(model, table), declare_model(model, table).init(0)
        sums = jax.jit(make_sums(declared, table, model, train_config().masking))
        found = [sums(params, batch | {"valid": np.ones(4, bool)}, np.int32(n)) for n, batch in enumerate(held_out())]
        want = sum(float(sums.tokens) for sums, _ in found) / sum(int(counts.tokens) for _, counts in found)
        assert loss == pytest.approx(want, rel=1e-6)
    assert measured[0] != measured[1]


@pytest.mark.parametrize(
    ("changes", "masking"),
    [
        pytest.param({}, MaskingConfig(), id="discrete"),
        pytest.param({}, MaskingConfig(setting="full"), id="full", marks=pytest.mark.slow),
        pytest.param({"diffusion": DIFFUSION}, MaskingConfig(), id="continuous", marks=pytest.mark.slow),
    ],
)
def test_points_are_comparable_and_rows_that_fill_up_do_not_count(changes, masking):
    model = model_config(**SMALLER, **changes)
    declared, params = lively_params(model)
    sums = jax.jit(make_sums(declared, TABLE, model, masking))
    batch = random_batch(0, model, 4)
    whole = batch | {"valid": np.ones(4, bool)}
    first, second, other = sums(params, whole, 0), sums(params, whole, 0), sums(params, whole, 1)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        assert np.array_equal(a, b)
    assert float(first[0].tokens) != float(other[0].tokens)  # another batch draws other masks
    noise = {
        name: np.concatenate([batch[name][:3], random_batch(9, model, 1)[name]])
        for name in ("tokens", "actions", "embodiment")
    }
    valid = np.array([True, True, True, False])
    padded, cut = sums(params, noise | {"valid": valid}, 0), sums(params, batch | {"valid": valid}, 0)
    np.testing.assert_array_equal(jax.tree.leaves(padded[1]), jax.tree.leaves(cut[1]))
    for a, b in zip(padded[0], cut[0], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)
    assert int(cut[1].tokens) < int(first[1].tokens)


FORCED = MaskingConfig(teacher_forcing=True)


@pytest.mark.parametrize(
    ("diffusion", "trained", "masking"),
    [
        pytest.param(None, None, replace(FORCED, change_weight=3.0), id="weighed ids"),
        pytest.param(None, None, replace(FORCED, own_past=0.5, own_past_rounds=2), id="own past"),
        pytest.param(None, None, replace(FORCED, displaced_past=0.5), id="displaced past"),
        pytest.param(DIFFUSION, replace(DIFFUSION, weight_cap=5.0, noise_shift=4.0), FORCED, id="weighed noise"),
    ],
)
def test_what_weighs_or_degrades_in_training_alone_changes_no_held_out_loss(diffusion, trained, masking):
    def program(diffusion, masking) -> str:
        model = model_config(**SMALLER, diffusion=diffusion)
        declared, batch = declare_model(model, TABLE), random_batch(0, model, 2) | {"valid": np.ones(2, bool)}
        return jax.jit(make_sums(declared, TABLE, model, masking)).lower(declared.shapes(), batch, 0).as_text()

    assert program(trained, masking) == program(diffusion, FORCED)


def test_held_out_loss_is_of_micro_batches_where_training_is():
    """A run whose steps just fitted into memory ended at its first look at held-out windows."""
    declared, params = lively_params(MODEL)
    batch = random_batch(0, MODEL, 32) | {"valid": np.arange(32) < 30}
    batch["real"] = np.arange(MODEL.frames) < np.random.default_rng(0).integers(2, MODEL.frames + 1, 32)[:, None]
    ways = [jax.jit(make_sums(declared, TABLE, MODEL, MaskingConfig(), n)) for n in (1, 8)]
    whole, parts = (way.lower(params, batch, 0).compile() for way in ways)
    for a, b in zip(*(jax.tree.leaves(way(params, batch, 0)) for way in (whole, parts)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)
    assert parts.memory_analysis().temp_size_in_bytes < 0.6 * whole.memory_analysis().temp_size_in_bytes
    with pytest.raises(ConfigError, match="32 is not a multiple of execution.accumulate 5"):
        jax.eval_shape(make_sums(declared, TABLE, MODEL, MaskingConfig(), 5), params, batch, 0)


def test_a_validation_without_windows_is_refused_by_words(tmp_path: Path):
    watch = make_validation_hook(
        Validation(1, list), MODEL, TABLE, MaskingConfig(), ExecutionConfig(), lambda batch: batch
    )
    with pytest.raises(ConfigError, match="no window to validate on"):
        watch.measure(None)
    with pytest.raises(ConfigError, match="between validations must be at least 1, got 0"):
        Validation(0, list)
