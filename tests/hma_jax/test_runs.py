"""Runs on disk: what came later, what may differ between starts, and models for inference."""

from __future__ import annotations

import errno
import json
import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hma_jax
from experiments.applications.ship import Shipped
from hma_jax.config import ConfigError, ExecutionConfig, MeshConfig
from hma_jax.config.json import to_dict
from hma_jax.model.hma import declare_model
from hma_jax.model.params import inference_params
from hma_jax.training import reading, runs
from hma_jax.training.branch import branch
from hma_jax.training.checkpoints import Checkpoints
from hma_jax.training.hashes import NAME, ReadError
from hma_jax.training.reading import CheckpointError, read_description
from hma_jax.training.runs import describe_run, load_model, load_run, modernise, read_configs
from hma_jax.training.train import train_model
from tests.hma_jax.test_training import equal_trees
from tests.tiny import DIFFUSION, SMALLER, TABLE, batches, lively_params, model_config, train_config

MODEL = model_config(**SMALLER)
AVERAGED = train_config(steps=2, batch=4, ema_decay=0.2)


@pytest.fixture(scope="module")
def averaged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, object]:
    """(a run that keeps an average, its final state)."""
    run_dir = tmp_path_factory.mktemp("averaged")
    result = train_model(MODEL, TABLE, AVERAGED, batches(MODEL, 4), run_dir=run_dir, provenance={})
    return run_dir, result.state


def replace_checkpoint(old: Path, new: Path) -> None:
    """As training does it, on another host."""
    aside = shutil.copytree(old, new.parents[1] / "aside")
    os.replace(aside, new)
    shutil.rmtree(old)


@pytest.mark.parametrize("code", [errno.ENOENT, errno.ESTALE])
def test_a_checkpoint_that_training_removes_while_it_is_read_gives_way_to_the_newer_one(
    code, averaged, tmp_path, monkeypatch
):
    """Training and evaluating go together; it was said to be damaged, or no run of this project. NFS says ESTALE of
    what another host removed."""
    shutil.copytree(averaged[0], tmp_path / "run")
    old, new = (tmp_path / "run" / "checkpoints" / step for step in "23")

    def replaced(checkpoint: Path):
        if old.is_dir():
            replace_checkpoint(old, new)
            if code == errno.ESTALE:
                raise ReadError(f"{old} cannot be read now")
        return read_description(checkpoint)

    monkeypatch.setattr(runs, "read_description", replaced)
    assert load_run(tmp_path / "run").step == 3


def test_a_checkpoint_that_was_not_written_or_copied_to_its_end_is_neither_loaded_nor_branched(
    averaged, tmp_path: Path
):
    run = shutil.copytree(averaged[0], tmp_path / "run")
    shutil.copytree(run / "checkpoints" / "2", run / "checkpoints" / "1")
    (run / "checkpoints" / "2" / NAME).unlink()
    message = f"{NAME} is missing, .* copied to its end; that of step 1 is undamaged"
    with pytest.raises(CheckpointError, match=message):
        load_run(run)
    with pytest.raises(CheckpointError, match=message):
        branch(run, tmp_path / "new")
    assert not (tmp_path / "new").exists() and branch(run, tmp_path / "new", 1) == 1


@pytest.mark.parametrize("code", [errno.ENOENT, errno.ESTALE])
def test_so_does_one_that_is_removed_before_its_items_are_looked_for(code, averaged, tmp_path, monkeypatch):
    """It was said to keep no average."""
    shutil.copytree(averaged[0], tmp_path / "run")
    old, new = (tmp_path / "run" / "checkpoints" / step for step in "23")

    def refused(look):
        def refuse(path, *arguments, **options):
            if Path(path).is_relative_to(old):
                raise OSError(code, os.strerror(code), str(path))
            return look(path, *arguments, **options)

        return refuse

    def replaced(checkpoint: Path):
        described = read_description(checkpoint)
        if checkpoint == old:
            replace_checkpoint(old, new)
            monkeypatch.setattr(Path, "stat", refused(Path.stat))
            monkeypatch.setattr(os, "listdir", refused(os.listdir))
        return described

    monkeypatch.setattr(runs, "read_description", replaced)
    assert load_run(tmp_path / "run", "ema").step == 3


@pytest.mark.parametrize("code", [errno.ENOENT, errno.ENOTDIR, errno.ESTALE])
def test_checkpoints_that_cannot_be_listed_now_are_not_called_one_that_can_be_removed(code, averaged, monkeypatch):
    def fail(directory: Path) -> list[int]:
        raise OSError(code, os.strerror(code), str(directory))

    monkeypatch.setattr(reading, "list_steps", fail)
    place = averaged[0] / "checkpoints"
    with pytest.raises(ReadError, match=f"{place} cannot be read now .{os.strerror(code)}.*same command") as refused:
        load_run(averaged[0])
    assert "remove" not in str(refused.value)


def test_a_folder_whose_name_is_no_plain_number_is_no_checkpoint(tmp_path):
    for name in ("4", "²", "٣", "5.orbax-checkpoint-tmp"):
        (tmp_path / name).mkdir()
    assert reading.list_steps(tmp_path) == [4]


def test_checkpoints_that_process_0_cannot_list_now_are_refused_by_all(averaged, monkeypatch):
    monkeypatch.setattr(reading, "is_writer", lambda: False)
    monkeypatch.setattr(reading, "all_gather", lambda name, own: ["ReadError: why", own])
    with pytest.raises(ReadError, match="why"):
        load_run(averaged[0])
    monkeypatch.setattr(reading, "all_gather", lambda name, own: ["", own])
    monkeypatch.setattr(reading, "broadcast_from_writer", lambda *_: "2")
    assert load_run(averaged[0]).step == 2  # what the others see does not matter


def test_several_processes_read_the_step_that_process_0_sees_and_another_one_together(averaged, tmp_path, monkeypatch):
    """As process 1 does it, which sees a newer step already, while the first one is removed under the hands of
    process 0."""
    shutil.copytree(averaged[0], tmp_path / "run")
    for step in "345":
        shutil.copytree(tmp_path / "run" / "checkpoints" / "2", tmp_path / "run" / "checkpoints" / step)
    latest, removed = iter("34"), iter(["CheckpointError: the checkpoint is removed"])
    monkeypatch.setattr(reading, "broadcast_from_writer", lambda *_: next(latest), raising=False)
    monkeypatch.setattr(
        reading, "all_gather", lambda name, own: [next(removed, "") if name == "parameters" else "", own]
    )
    assert load_run(tmp_path / "run").step == 4


# --- Fields that came later ------------------------------------------------------------------


def test_a_field_that_came_later_takes_its_default_and_an_unknown_one_is_named():
    today = describe_run(MODEL, AVERAGED, TABLE, {})
    earlier = json.loads(json.dumps(today))
    del earlier["train"]["ema_decay"], earlier["model"]["mup"]["without"]
    assert modernise(earlier) == describe_run(MODEL, replace(AVERAGED, ema_decay=0.0), TABLE, {})
    assert modernise(today) == today
    earlier["model"]["telepathy"] = True
    with pytest.raises(ConfigError, match=r"RUN: model: unknown field\(s\) telepathy"):
        read_configs(earlier, "RUN")


# --- Reading a model -------------------------------------------------------------------------


def test_a_model_whose_training_is_not_finished_is_read_with_one_warning(averaged, tmp_path: Path, caplog):
    """It passed for a finished one, in `hma evaluate`, `hma play`, `hma generate` and all others."""
    run_dir = shutil.copytree(averaged[0], tmp_path / "run")
    load_run(run_dir)
    assert "not finished" not in caplog.text
    (run_dir / "checkpoints" / "2").rename(run_dir / "checkpoints" / "1")
    for _ in range(2):
        assert not load_run(run_dir).finished
    assert caplog.text.count(f"{run_dir} is at step 1 of 2: its training is not finished") == 1


def test_loading_a_model_does_not_read_the_moments(averaged, tmp_path: Path):
    run_dir = shutil.copytree(averaged[0], tmp_path / "run")
    shutil.rmtree(run_dir / "checkpoints" / "2" / "opt_state")
    assert equal_trees(load_run(run_dir).params, averaged[1].params)
    damaged = next((run_dir / "checkpoints" / "2" / "params").rglob("_METADATA"))
    damaged.write_bytes(damaged.read_bytes()[:-1])
    with pytest.raises(CheckpointError, match="params/_METADATA"):
        load_run(run_dir)


def test_a_run_is_read_into_memory_of_the_host(averaged):
    """One device may be too small for a model that trains split over several."""
    with jax.transfer_guard("disallow_explicit"):
        run = load_run(averaged[0])
    assert all(isinstance(x, np.ndarray) for x in jax.tree.leaves(run.params))


def test_which_weights_are_read_is_said_and_can_be_chosen(averaged, tmp_path: Path):
    run_dir, state = averaged
    train_model(MODEL, TABLE, replace(AVERAGED, ema_decay=0.0), batches(MODEL, 4), run_dir=tmp_path, provenance={})
    assert not equal_trees(state.ema, state.params)
    for weights, want, which in (("last", "params", "last"), ("ema", "ema", "ema"), ("auto", "ema", "ema")):
        run = load_run(run_dir, weights)
        assert run.weights == which and equal_trees(run.params, getattr(state, want))
    assert load_run(tmp_path, "auto").weights == "last"
    with pytest.raises(ConfigError, match="keeps no average of its weights"):
        load_run(tmp_path, "ema")
    with pytest.raises(ConfigError, match="weights: 'newest' is not allowed; choose one of auto, last, ema"):
        load_run(run_dir, "newest")  # gave the average


def test_an_execution_that_is_none_is_refused_before_the_run_is_read(tmp_path: Path):
    with pytest.raises(ConfigError, match=r"ExecutionConfig\(dtype='bfloat16'\), got 'bfloat16'"):
        load_model(tmp_path, "bfloat16")


def test_a_run_that_was_shipped_with_its_average_alone_says_so(averaged, tmp_path: Path):
    """As `ship` leaves it: the average is its `params`. It was called the last weights."""
    saved = tmp_path / "run" / "checkpoints"
    about = describe_run(MODEL, AVERAGED, TABLE, {})
    with Checkpoints(saved, about) as checkpoints:
        checkpoints.save(2, Shipped(averaged[1].ema))
    for weights in ("auto", "ema"):
        run = load_run(tmp_path / "run", weights)
        assert run.weights == "ema" and equal_trees(run.params, averaged[1].ema)
    with pytest.raises(ConfigError, match="keeps only the average of its weights, not the last ones; use ema"):
        load_run(tmp_path / "run", "last")


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_a_model_is_loaded_as_it_is_executed(dtype: str, averaged):
    run_dir, state = averaged
    model = load_model(run_dir, ExecutionConfig(dtype=dtype), weights="last")
    assert model.config == MODEL and model.table == TABLE and model.step == 2
    for x, y in zip(jax.tree.leaves(model.params), jax.tree.leaves(state.params), strict=True):
        assert x.devices() == {jax.local_devices()[0]}
        np.testing.assert_array_equal(x, np.asarray(y).astype(x.dtype))
    assert model.params["trunk"]["blocks"]["mlp_in"]["kernel"].dtype == dtype
    assert model.params["embed"]["tables"].dtype == "float32"

    def logits(params, batch):
        merged = model.declared.merge(params)
        return merged(batch["tokens"], None, merged.align(batch["actions"]), batch["embodiment"]).token_outputs

    assert jax.eval_shape(logits, model.params, next(batches(MODEL, 4)(0))).shape == (4, 3, 4, 2, 4)


@pytest.mark.parametrize(
    "changes",
    [{}, {"chain_factors": True}, pytest.param({"diffusion": DIFFUSION}, marks=pytest.mark.slow)],
    ids=["discrete", "chained", "continuous"],
)
def test_casting_parameters_once_changes_nothing_that_is_computed(changes):
    """Nothing that is cast is used in a finer type."""
    config = model_config(**SMALLER, **changes)
    declared, batch = declare_model(config, TABLE, ExecutionConfig(dtype="bfloat16")), next(batches(config, 4)(0))
    _, params = lively_params(config)

    @jax.jit
    def outputs(params):
        model = declared.merge(params)
        out = model(batch["tokens"], None, model.align(batch["actions"]), batch["embodiment"])
        if not config.diffusion:
            return model.logits(out.token_outputs, batch["tokens"]), model.action_head(
                out.action_features_BTD, batch["embodiment"]
            )
        times = jnp.full((4, config.frames), 3)
        tokens, actions = batch["tokens"], batch["actions"]
        return (
            model.denoiser(tokens, jnp.full(tokens.shape[:-1], 3), out.token_outputs),
            model.action_head(actions, times, out.action_features_BTD, batch["embodiment"]),
        )

    cast = inference_params(declared, params, "bfloat16")
    assert sum(x.nbytes for x in jax.tree.leaves(cast)) < 0.6 * sum(x.nbytes for x in jax.tree.leaves(params))
    for a, b in zip(outputs(cast), outputs(params), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_package_offers_what_loads_a_model(averaged):
    assert hma_jax.load_model is load_model and hma_jax.load_model(averaged[0]).run.weights == "ema"
    code = "import sys, hma_jax.config; assert 'jax' not in sys.modules and 'load_model' in hma_jax.__all__"
    subprocess.run([sys.executable, "-c", code], check=True)
    with pytest.raises(AttributeError, match="no attribute 'load_modle'; it offers .*load_model"):
        hma_jax.load_modle  # noqa: B018


def test_a_model_goes_to_another_process_and_is_shown_in_a_few_lines(averaged):
    """Its initialisers cannot be pickled, and its repr had all weights in it."""
    model = load_model(averaged[0], ExecutionConfig("bfloat16"))
    other = pickle.loads(pickle.dumps(model))
    assert equal_trees(other.params, model.params) and other.execution == model.execution
    assert other.run.provenance == model.run.provenance and other.declared is model.declared
    assert len(repr(model)) < 4000 and len({model, other}) == 2


# --- How a run is computed -------------------------------------------------------------------


def test_how_a_run_is_computed_is_recorded_and_may_change_with_every_start(averaged, tmp_path: Path):
    run_dir = shutil.copytree(averaged[0], tmp_path / "run")
    other = ExecutionConfig("bfloat16", "products", "plain", accumulate=2, mesh=MeshConfig(min_shard_size=1))
    result = train_model(
        MODEL, TABLE, replace(AVERAGED, steps=3), batches(MODEL, 4),
        run_dir=run_dir, provenance={}, execution=other,
    )  # fmt: skip
    assert result.resumed_from == 2 and len(result.losses) == 3
    starts = [json.loads(line) for line in (run_dir / "execution.jsonl").read_text().splitlines()]
    assert [start["execution"] for start in starts] == [to_dict(ExecutionConfig()), to_dict(other)]
    assert [start["resumed_from"] for start in starts] == [0, 2]


ROWS = next(batches(MODEL, 4)(0))


@pytest.mark.parametrize(
    ("batch", "message"),
    [
        (next(batches(MODEL, 2)(0)), r"has tokens \(4, 3, 4\), got \(2, 3, 4\); actions \(4, 3, 14\), got \(2, "),
        ({"tokens": ROWS["tokens"]}, r"a batch of this run has actions \(4, 3, 14\), got None; embodiment"),
        (
            ROWS | {"tokens": ROWS["tokens"] + MODEL.vocab_size},
            "a batch has ids from 16 to 31, but the model allows 0 to 15",
        ),
        (ROWS | {"embodiment": ROWS["embodiment"] - 1}, "a batch has robots from -1 to 1, but the model allows 0 to 2"),
        (ROWS | {"embodiment": ROWS["embodiment"].tolist()}, r"has embodiment \(4,\), got list"),
        (ROWS | {"tokens": ROWS["tokens"] / 2}, "a batch has ids of type float64, not integers"),
        (ROWS | {"real": np.ones(4, bool)}, r"has real \(4, 3\), got \(4,\)"),
        (ROWS | {"real": np.ones((4, 3))}, "a batch has marks of padding, `real`, of type float64, not bool"),
    ],
    ids=["fewer rows", "no actions", "ids", "robots", "list", "halves", "real windows", "real numbers"],
)
def test_batches_of_another_model_are_refused(batch, message, tmp_path: Path):
    """Such ids and fewer rows were trained on without a word; other robots were told as a divergence. Whole windows
    that are marked as real, instead of frames, were taken for frames."""
    with pytest.raises(ConfigError, match=message):
        train_model(MODEL, TABLE, AVERAGED, lambda start: iter([batch]), run_dir=tmp_path, provenance={})


def test_a_run_whose_batches_do_not_all_mark_their_padding_is_refused(tmp_path: Path):
    """It ended in an error of JAX about trees."""
    later_marked = [ROWS, ROWS | {"real": np.ones((4, 3), bool)}]
    with pytest.raises(ConfigError, match="some batches have `real`, .* and some do not; give it with all"):
        train_model(MODEL, TABLE, AVERAGED, lambda start: iter(later_marked), run_dir=tmp_path, provenance={})


def test_parameters_of_another_model_and_words_that_are_not_json_are_refused(tmp_path: Path):
    other = declare_model(replace(MODEL, recall=True), TABLE).init(0)
    given = dict(run_dir=tmp_path, provenance={})
    with pytest.raises(ConfigError, match=r"do not fit the model: recall/gain should be absent but is \(8,\)"):
        train_model(MODEL, TABLE, AVERAGED, batches(MODEL, 4), initial=other, **given)
    with pytest.raises(ConfigError, match="including its provenance, must be JSON: Object of type float32 is not"):
        train_model(MODEL, TABLE, AVERAGED, batches(MODEL, 4), **given | {"provenance": {"hz": np.float32(2)}})
