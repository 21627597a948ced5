import dataclasses
import json
import signal
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError, ExecutionConfig, MaskingConfig, OptimizerConfig
from hma_jax.model.embodiments import Embodiment, EmbodimentTable
from hma_jax.model.hma import declare_model
from hma_jax.model.params import inference_params
from hma_jax.training.checkpoints import CheckpointError
from hma_jax.training.divergence import DivergedError
from hma_jax.training.loop import Interrupted, LoopOptions
from hma_jax.training.runs import load_run
from hma_jax.training.state import init_state
from hma_jax.training.step import make_train_step
from hma_jax.training.train import _normalised, train_model
from tests.tiny import DIFFUSION, SMALLER, TABLE, batches, model_config, random_batch, train_config

MODEL = model_config(**SMALLER)
EVERY_TWO = LoopOptions(checkpoint_every=2, log_every=1)


def train(
    run_dir: Path, *, model=MODEL, table=TABLE, config=None, make=None, options=EVERY_TWO, provenance=None, **kwargs
):
    return train_model(
        model,
        table,
        config or train_config(),
        make or batches(MODEL),
        run_dir=run_dir,
        provenance=provenance or {"data": "random"},
        options=options,
        **kwargs,
    )


def equal_trees(a, b) -> bool:
    return all(np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))


def dying_batches(after: int):
    """The usual stream, whose source breaks once `after` batches were taken."""
    usual = batches(MODEL)

    def make(start: int):
        for number, batch in enumerate(usual(start), start + 1):
            if number > after:
                raise OSError("the disk went away")
            yield batch

    return make


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory: pytest.TempPathFactory):
    """(directory, result) of a run that nothing happened to, saved at its end."""
    run_dir = tmp_path_factory.mktemp("unbroken")
    return run_dir, train(run_dir, options=LoopOptions(log_every=1))


@pytest.mark.exact
@pytest.mark.slow  # test_kill has the harder end
def test_a_run_that_broke_and_resumed_is_byte_equal_to_one_that_did_not(tmp_path: Path, unbroken):
    run_dir, whole = unbroken
    with pytest.raises(OSError):
        train(tmp_path / "broken", make=dying_batches(after=5))
    resumed = train(tmp_path / "broken")
    assert resumed.resumed_from in (2, 4)
    assert resumed.losses == whole.losses
    assert equal_trees(resumed.state, whole.state)
    metrics = [(d / "metrics.jsonl").read_bytes() for d in (run_dir, tmp_path / "broken")]
    assert metrics[0] == metrics[1]


def test_a_finished_run_is_not_run_again(unbroken):
    run_dir, first = unbroken

    def no_batches(start: int):
        raise AssertionError("a finished run asked for data")

    again = train(run_dir, make=no_batches)
    assert again.losses == first.losses
    assert equal_trees(again.state, first.state)


def test_a_run_that_has_more_steps_than_are_asked_for_is_not_taken_for_one_of_fewer(unbroken):
    run_dir, _ = unbroken
    with pytest.raises(CheckpointError, match="train.steps: 6 -> 4"):
        train(run_dir, config=train_config(steps=4))


@pytest.mark.slow
def test_a_constant_rate_run_may_be_lengthened_and_another_not(tmp_path: Path):
    train(tmp_path)
    longer = train(tmp_path, config=train_config(steps=8))
    assert len(longer.losses) == 8 and longer.resumed_from == 6
    straight = train(tmp_path / "straight", config=train_config(steps=8))
    assert straight.losses == longer.losses

    cosine = OptimizerConfig(learning_rate=1e-3, warmup_steps=2, schedule="cosine")
    train(tmp_path / "cosine", config=train_config(optimizer=cosine))
    with pytest.raises(CheckpointError, match="train.steps: 6 -> 8"):
        train(tmp_path / "cosine", config=train_config(steps=8, optimizer=cosine))


def test_a_checkpoint_of_another_configuration_is_refused_by_name(unbroken):
    run_dir, _ = unbroken
    with pytest.raises(CheckpointError, match="train.seed: 0 -> 1"):
        train(run_dir, config=train_config(seed=1))
    with pytest.raises(CheckpointError, match="provenance.data: 'random' -> 'other'"):
        train(run_dir, provenance={"data": "other"})


@pytest.mark.slow  # resuming exactly is tested after errors and kills, what a signal does in test_faults
@pytest.mark.exact
def test_a_stop_request_saves_first_and_resumes_exactly(tmp_path: Path, unbroken):
    def stop_at_three(step: int, steps: int, metrics: dict) -> None:
        if step == 3:
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Interrupted, match="of 6"):
        train(tmp_path / "stopped", progress=stop_at_three, options=LoopOptions(log_every=1))
    resumed = train(tmp_path / "stopped")
    assert resumed.resumed_from >= 3
    assert equal_trees(resumed.state, unbroken[1].state)


def test_divergence_stops_the_run_and_spares_the_last_checkpoint(tmp_path: Path):
    usual = batches(MODEL)

    def poisoned(start: int):
        for number, batch in enumerate(usual(start), start + 1):
            if number == 4:
                batch["actions"][:] = np.nan
            yield batch

    with pytest.raises(
        DivergedError, match="loss is nan at step 4; lower the learning rate .* in a new output directory"
    ):
        train(tmp_path, make=poisoned)
    assert load_run(tmp_path).step == 2
    with pytest.raises(CheckpointError, match="learning_rate: 0.001 -> 0.0001"):  # as the advice says
        train(tmp_path, config=train_config(optimizer=OptimizerConfig(learning_rate=1e-4, warmup_steps=2)))


def test_log_lines_beyond_the_checkpoint_are_dropped_and_a_torn_one_too(tmp_path: Path, unbroken):
    _, whole = unbroken
    with pytest.raises(OSError):
        train(tmp_path / "torn", make=dying_batches(after=4))
    log = tmp_path / "torn" / "metrics.jsonl"
    log.write_text(log.read_text() + '{"step": 5, "loss": 1.0}\n{"step": 6, "lo')
    assert train(tmp_path / "torn").losses == whole.losses
    assert [json.loads(line)["step"] for line in log.read_text().splitlines()] == [1, 2, 3, 4, 5, 6]


@pytest.mark.slow  # on a mesh they are compared every time: tests/multidevice/test_sharding.py
@pytest.mark.exact
def test_micro_batches_change_nothing_but_rounding(tmp_path: Path):
    whole = train(tmp_path / "whole")
    split = train(tmp_path / "split", execution=ExecutionConfig(accumulate=4))
    np.testing.assert_allclose(split.losses, whole.losses, rtol=1e-5)


def test_training_lowers_the_loss_on_a_repeated_batch(tmp_path: Path):
    one = next(batches(MODEL)(0))

    def same(start: int):
        while True:
            yield one

    config = train_config(steps=60, optimizer=OptimizerConfig(learning_rate=1e-2, warmup_steps=5, clip_norm=10.0))
    losses = train(tmp_path, config=config, make=same, options=LoopOptions()).losses
    assert losses[-1] < 0.8 * losses[0]


def test_a_run_reads_back_with_everything_it_needs(unbroken):
    run_dir, result = unbroken
    run = load_run(run_dir)
    assert run.model == MODEL and run.train == train_config() and run.table == TABLE
    assert run.step == 6 and run.provenance == {"data": "random"}
    assert equal_trees(run.params, result.state.params)


def test_reading_a_directory_without_a_run_says_what_to_do(tmp_path: Path):
    with pytest.raises(CheckpointError, match="give the directory of a training run"):
        load_run(tmp_path / "nothing")


def test_an_unwritable_run_directory_is_one_clear_message(tmp_path: Path):
    blocker = tmp_path / "file"
    blocker.write_text("")
    with pytest.raises(ConfigError, match="choose another output directory"):
        train(blocker / "run")


def test_every_step_counts_robots_that_were_present(tmp_path: Path):
    usual = batches(MODEL)

    def only_pusher(start: int):
        for batch in usual(start):
            yield batch | {"embodiment": np.zeros_like(batch["embodiment"])}

    state = train(tmp_path, make=only_pusher, options=LoopOptions()).state
    assert state.opt_state.count_E["always"].tolist() == [6, 0, 0]


def test_parameters_to_start_from_stay_the_caller_s(tmp_path: Path):
    given = declare_model(MODEL, TABLE).init(7)
    before = [np.array(x) for x in jax.tree.leaves(given)]
    result = train(tmp_path, initial=given, options=LoopOptions())
    assert not any(x.is_deleted() for x in jax.tree.leaves(given))
    assert equal_trees(given, before) and not equal_trees(given, result.state.params)


def test_training_goes_on_in_float32_from_parameters_that_were_cast_for_inference():
    """As `load_model` gives them in bfloat16: the second step was refused, for it had a state of another type."""
    declared = declare_model(MODEL, TABLE)
    given = inference_params(declared, declared.init(7), "bfloat16")
    made = init_state(declared, TABLE, 0, params=given)
    assert any(x.dtype == jnp.bfloat16 for x in jax.tree.leaves(given))
    assert all(x.dtype == jnp.float32 for x in jax.tree.leaves(made.params)) and equal_trees(given, made.params)


@pytest.mark.parametrize("other", ["seeds", "statistics of actions"])
def test_runs_that_differ_only_in_this_are_one_program(other: str, monkeypatch):
    """So that a sweep over seeds, or over how many trajectories there are, compiles once."""
    texts = set()

    def compile_only(step, shapes, init, make, *, put_batch, **kwargs):
        texts.add(step.lower(shapes, put_batch(next(make(0)))).as_text())

    monkeypatch.setattr("hma_jax.training.train.fit", compile_only)
    if other == "seeds":
        for seed in (0, 1):
            train(Path("never written"), config=dataclasses.replace(train_config(), seed=seed))
    else:
        for table in (TABLE, other_statistics(TABLE)):
            train(Path("never written"), model=dataclasses.replace(MODEL, action_heads=False), table=table)
    assert len(texts) == 1


def other_statistics(table: EmbodimentTable) -> EmbodimentTable:
    """The same robots, of other episodes; every second one on the scale of quantiles."""

    def moved(number: int, robot: Embodiment) -> Embodiment:
        mean, std = (
            [scale * x + shift for x in xs] for xs, scale, shift in ((robot.mean, 3, 0.7), (robot.std, 1.7, 0))
        )
        bounds = {"low": [m - 1 for m in mean], "high": [m + 3 for m in mean]} if number % 2 else {}
        return dataclasses.replace(robot, mean=mean, std=std, **bounds)

    return EmbodimentTable(tuple(moved(*pair) for pair in enumerate(table.entries)))


def test_actions_are_normalised_before_a_step_as_in_it():
    """To the last bit: no number of a run depends on where it is done."""
    rng = np.random.default_rng(0)
    for table in (TABLE, other_statistics(TABLE)):
        robots = np.arange(table.size)
        actions = rng.normal(0, 100, (table.size, 5, table.action_width)).astype(np.float32)
        given = _normalised({"actions": actions, "embodiment": robots, "tokens": 1}, table.scale())
        want = jax.jit(table.scale().normalise)(actions, robots)
        np.testing.assert_array_equal(given["actions"], want)
        np.testing.assert_array_equal(jax.jit(table.standardised().scale().normalise)(given["actions"], robots), want)
        np.testing.assert_array_equal(table.standardised().alive(), table.alive())
        assert given["tokens"] == 1


@pytest.mark.slow  # the draws of a run with its seed in the batch are on record: tests/golden/test_first_steps.py
def test_a_seed_in_the_batch_is_that_of_the_configuration():
    declared, (batch,) = declare_model(MODEL, TABLE), [next(batches(MODEL)(0))]
    state = init_state(declared, TABLE, 0)
    norms = {}
    for seed in (0, 1):
        step = jax.jit(make_train_step(declared, TABLE, MODEL, dataclasses.replace(train_config(), seed=seed)))
        given = batch | {"seed": jax.random.key_data(jax.random.key(seed))}
        norms[seed] = float(step(state, given)[1]["grad_norm"])
        assert norms[seed] == pytest.approx(float(step(state, batch)[1]["grad_norm"]), rel=1e-4)
    assert abs(norms[0] / norms[1] - 1) > 1e-3


@pytest.mark.parametrize(
    ("masking", "diffusion"),
    [
        (MaskingConfig(setting="full"), None),
        (MaskingConfig(teacher_forcing=True, displaced_past=0.5), None),
        (MaskingConfig(), DIFFUSION),
    ],
    ids=["actions", "displaced", "latents"],
)
def test_a_step_mixes_no_types_of_numbers_where_jax_forbids_it(masking, diffusion):
    config, training = dataclasses.replace(MODEL, diffusion=diffusion), train_config(masking=masking)
    declared = declare_model(config, TABLE)
    step = make_train_step(declared, TABLE, config, training)
    state = jax.eval_shape(lambda: init_state(declared, TABLE, 0))
    with jax.numpy_dtype_promotion("strict"):
        jax.eval_shape(step, state, random_batch(0, config))
