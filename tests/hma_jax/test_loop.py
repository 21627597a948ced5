"""What the training loop does around any step: saving, refusing, timing, locking."""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import math
import os
import signal
from dataclasses import replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from hma_jax.config import ConfigError
from hma_jax.runtime.exits import Exit, Terminated, raise_pending_stop, sigterm_as_interrupt
from hma_jax.training.divergence import DivergedError
from hma_jax.training.loop import Interrupted, LoopOptions, ValidationHook
from hma_jax.training.reading import list_steps
from hma_jax.training.run_lock import RunBusy, locked_run
from tests.holding import start_holder
from tests.toy import fit_toy, toy_batches, toy_step

EVERY_STEP = LoopOptions(checkpoint_every=1, log_every=1)
LOGGED = LoopOptions(log_every=1)
"""One save, at the end: a save takes longer than all steps of these runs."""


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


# --- Nothing that is not finite is saved -----------------------------------------------------


def spoilt(what: str, at: int, value: float):
    """A step that is wrong in one respect at step `at`; its loss is finite unless `what` is the loss."""

    def step(state, batch):
        after, metrics = toy_step(state, batch)
        wrong = jnp.where(state.step + 1 == at, value, 0.0)
        if what == "loss":
            return after, metrics | {"loss": metrics["loss"] + wrong}
        if what == "gradient":
            metrics["finite/gradient"] = jnp.isfinite(wrong)
        params = {"w": after.params["w"].at[7].add(wrong)}
        metrics["finite/update"] = jnp.isfinite(params["w"]).all()
        return after._replace(params=params), metrics

    return step


@pytest.mark.parametrize("at", [2, 3], ids=["in the middle", "at the very last step"])
@pytest.mark.parametrize(
    ("what", "value", "message"),
    [
        ("loss", math.nan, "the loss is nan at step {}"),
        ("gradient", math.nan, "the gradient and the update are not finite at step {}"),
        ("update", math.inf, "the update is not finite at step {}"),
    ],
)
def test_what_is_not_finite_is_never_saved(what, value, message, at, tmp_path: Path):
    with pytest.raises(DivergedError, match=message.format(at)):
        fit_toy(tmp_path, 3, step=spoilt(what, at, value), options=EVERY_STEP)
    assert list_steps(tmp_path / "checkpoints")[-1] == at - 1
    assert [line["step"] for line in lines(tmp_path / "metrics.jsonl")] == list(range(1, at))
    resumed = fit_toy(tmp_path, 3, options=LOGGED)
    assert resumed.resumed_from == at - 1 and len(resumed.losses) == 3


def test_the_records_of_the_batch_that_was_not_finite_are_named(tmp_path: Path):
    def make(start: int):
        for index, batch in enumerate(toy_batches(start), start):
            yield np.full_like(batch, math.nan) if index == 1 else batch

    def records(index: int) -> list[str]:
        return [f"record {10 * index + row}" for row in range(6)]

    with pytest.raises(DivergedError, match="loss is nan at step 2; its batch was record 10; record 11; .* and 2 more"):
        fit_toy(tmp_path, make=make, records=records, options=EVERY_STEP)
    said = json.loads((tmp_path / "diverged.json").read_text())
    assert said == {
        "step": 2,
        "what": "the loss is nan at step 2",
        "records": [f"record {10 + row}" for row in range(6)],
    }


def test_checks_are_not_logged(tmp_path: Path):
    fit_toy(tmp_path)
    assert lines(tmp_path / "metrics.jsonl")[0].keys() == {"step", "loss"}


# --- When a run is saved ---------------------------------------------------------------------


class Clock:
    """Time passes where a test says so."""

    def __init__(self):
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds

    def after(self, seconds: float, make=toy_batches):
        """Batches that take `seconds` each."""

        def slow(start: int):
            for batch in make(start):
                self.seconds += seconds
                yield batch

        return slow


@pytest.mark.parametrize(
    ("every", "minutes", "saved"),
    [
        (0, 0.0, [10]),
        (0, 1.5, [3, 6, 9, 10]),  # each step takes 40 s, and the last saves anyway
        (4, 0.0, [4, 8, 10]),
        (4, 2.5, [4, 8, 10]),  # time counts from the last save, whatever asked for it
        (7, 2.5, [4, 7, 10]),
    ],
)
def test_a_run_is_saved_by_steps_and_by_minutes(every, minutes, saved, tmp_path: Path):
    clock = Clock()
    options = LoopOptions(
        checkpoint_every=every, checkpoint_minutes=minutes, keep_checkpoints=20, clock=clock, log_every=1
    )
    fit_toy(tmp_path, 10, make=clock.after(40.0), options=options)
    assert list_steps(tmp_path / "checkpoints") == saved


def test_as_many_checkpoints_are_kept_as_asked_for(tmp_path: Path):
    fit_toy(tmp_path, 4, options=LoopOptions(checkpoint_every=1, keep_checkpoints=3))
    assert list_steps(tmp_path / "checkpoints") == [2, 3, 4]


def test_checkpoints_of_every_so_many_steps_stay(tmp_path: Path):
    fit_toy(tmp_path, 4, options=LoopOptions(checkpoint_every=1, keep_every=2))
    assert list_steps(tmp_path / "checkpoints") == [2, 3, 4]


# --- Timing ----------------------------------------------------------------------------------


class SlowToCompile:
    """A step function whose compilation takes 1000 s of `clock`."""

    def __init__(self, clock: Clock):
        self.clock = clock

    def lower(self, *_):
        return self

    def compile(self):
        self.clock.seconds += 1000
        return lambda state, batch: toy_step(state, batch)


def test_batches_that_end_too_soon_and_options_that_cannot_work_are_told_in_words(tmp_path: Path):
    with pytest.raises(ConfigError, match="there are batches for only 3 of 6 steps; give one for every step"):
        fit_toy(tmp_path, 6, make=lambda start: itertools.islice(toy_batches(start), 3))
    for name in ("log_every", "keep_checkpoints"):
        with pytest.raises(ConfigError, match=rf"LoopOptions\.{name} must be at least 1, got 0"):
            LoopOptions(**{name: 0})


def test_batches_may_be_a_list_but_come_from_a_function(tmp_path: Path):
    few = list(itertools.islice(toy_batches(0), 6))
    assert len(fit_toy(tmp_path / "a", 6, make=lambda start: few[start:]).losses) == 6
    with pytest.raises(ConfigError, match="make_batches must be a function: .*; got a list_iterator"):
        fit_toy(tmp_path / "b", 6, make=iter(few))
    assert not (tmp_path / "b").exists()


def test_timing_and_utilisation_are_of_steps_alone(tmp_path: Path):
    clock = Clock()

    def measure(state):
        clock.seconds += 500
        return {"loss": 1.0}

    options = LoopOptions(log_every=1, clock=clock, flops_per_step=6.0, peak_flops=4.0)
    result = fit_toy(
        tmp_path,
        5,
        step=SlowToCompile(clock),
        make=clock.after(2.0),
        options=options,
        validation=ValidationHook(2, measure),
    )
    assert result.compile_seconds == 1000 and result.seconds == 4 * 2.0
    timing = lines(tmp_path / "timing.jsonl")
    assert sum(line["seconds_per_step"] for line in timing) == pytest.approx(4 * 2.0)
    assert sum(line["seconds_waiting"] for line in timing) == 4 * 2.0, "all of it for batches"
    for line in timing:
        assert line["flops_per_second"] == pytest.approx(6 / line["seconds_per_step"])
        assert line["mfu"] == pytest.approx(line["flops_per_second"] / 4)


# --- What is recorded ------------------------------------------------------------------------


def test_every_start_of_a_run_is_recorded(tmp_path: Path):
    fit_toy(tmp_path, 2)
    fit_toy(tmp_path, 4)
    first, second = lines(tmp_path / "execution.jsonl")
    assert (first["resumed_from"], second["resumed_from"]) == (0, 2)
    assert first["device"] == "cpu" and first["devices"] == 1 and first["cores"] >= 1 and first["jax"] and first["date"]


def test_what_a_run_is_watched_on_survives_a_resume_and_is_shown(tmp_path: Path):
    seen = []
    validation = ValidationHook(2, lambda state: {"loss": float(state.params["w"][0])})

    def show(step, steps, values):
        seen.append(values.get("validation/loss"))

    fit_toy(tmp_path / "whole", 7, validation=validation, progress=show)
    whole = (tmp_path / "whole" / "validation.jsonl").read_bytes()
    assert [json.loads(line)["step"] for line in whole.splitlines()] == [2, 4, 6, 7]
    assert seen[1] is None and seen[2] == seen[3] is not None

    def dying(start: int):
        for number, batch in enumerate(toy_batches(start), start + 1):
            if number > 5:
                raise OSError("the disk went away")
            yield batch

    with pytest.raises(OSError, match="went away"):
        fit_toy(tmp_path / "broken", 7, make=dying, validation=validation, options=LoopOptions(checkpoint_every=3))
    fit_toy(tmp_path / "broken", 7, validation=validation, options=LoopOptions(checkpoint_every=3))
    assert (tmp_path / "broken" / "validation.jsonl").read_bytes() == whole


def test_a_log_that_is_cut_is_on_the_disk_before_the_old_one_is_gone(tmp_path: Path, monkeypatch):
    """Otherwise a loss of power leaves it empty."""
    fit_toy(tmp_path, 3, options=LOGGED)
    log = tmp_path / "metrics.jsonl"
    whole, place = log.read_bytes(), log.stat().st_ino
    fit_toy(tmp_path, 3)
    assert log.stat().st_ino == place, "nothing is cut, and the file stays as it is"

    log.write_bytes(whole + b'{"step": 4, "loss": 1.0}\n')
    sync, rename, synced, renamed = os.fsync, os.replace, [], []
    monkeypatch.setattr(os, "fsync", lambda fd: (sync(fd), synced.append(os.fstat(fd).st_ino)))
    monkeypatch.setattr(os, "replace", lambda old, new: (renamed.append((os.stat(old).st_ino, new)), rename(old, new)))
    fit_toy(tmp_path, 3)
    assert log.read_bytes() == whole
    assert [inode for inode, new in renamed if new == log] and {inode for inode, _ in renamed} <= set(synced)


def test_a_run_whose_log_is_lost_or_damaged_goes_on_from_its_checkpoint(tmp_path: Path, caplog):
    fit_toy(tmp_path, 6, options=LOGGED)
    log = tmp_path / "metrics.jsonl"
    content = log.read_bytes()
    log.write_bytes(content[:30] + bytes(60) + content[90:])  # a page of zeros
    kept = sum(b"\0" not in line for line in log.read_bytes().splitlines())
    with pytest.raises(ConfigError, match=f"has only {kept} of the 6 steps .*bring the file back, or remove"):
        fit_toy(tmp_path, 8, options=replace(LOGGED, whole_log=True))
    assert fit_toy(tmp_path, 8, options=LOGGED).resumed_from == 6
    assert f"metrics.jsonl has only {kept} of the 6 steps" in caplog.text
    assert [line["step"] for line in lines(log)][-2:] == [7, 8] and len(lines(log)) == kept + 2
    assert lines(tmp_path / "execution.jsonl")[-1]["steps_missing_in_log"] == 6 - kept

    log.unlink()
    assert len(fit_toy(tmp_path, 9, options=LOGGED).losses) == 1


# --- One process at a time -------------------------------------------------------------------


def test_a_run_that_another_process_trains_is_refused_by_its_name(tmp_path: Path):
    holder = start_holder(locked_run, tmp_path)
    with pytest.raises(RunBusy, match=f"process {holder.pid} on .*; wait for it or stop it"):
        fit_toy(tmp_path)
    assert not (tmp_path / "metrics.jsonl").exists()
    holder.kill()  # the lock dies with its process
    holder.join()
    assert fit_toy(tmp_path).resumed_from == 0


def test_states_of_a_run_and_a_resumed_run_are_equal_bit_for_bit(tmp_path: Path):
    whole = fit_toy(tmp_path / "whole", 8)
    fit_toy(tmp_path / "parts", 3)
    resumed = fit_toy(tmp_path / "parts", 8)
    assert resumed.resumed_from == 3 and resumed.losses == whole.losses
    for name in ("params", "opt_state"):
        a, b = (getattr(r.state, name) for r in (whole, resumed))
        assert all(np.asarray(a[k]).tobytes() == np.asarray(b[k]).tobytes() for k in a)


# --- Being asked to stop ---------------------------------------------------------------------


def test_a_request_that_was_lost_before_training_stops_it_after_a_step(tmp_path: Path):
    with sigterm_as_interrupt():
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
        with pytest.raises(Interrupted) as stopped:
            fit_toy(tmp_path, steps=1000)
    assert stopped.value.exit == Exit.STOPPED and list_steps(tmp_path / "checkpoints") == [1]


@pytest.mark.usefixtures("hangup_heard")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_saves_before_it_stops_training_and_one_of_another_kind_changes_nothing(number, tmp_path: Path):
    def stop(step: int, steps: int, metrics: dict) -> None:
        if step == 1:
            again = [number] * (number != signal.SIGINT)  # closed terminals, schedulers and wrappers send it twice
            for sent in (number, *again, signal.SIGTERM if number == signal.SIGINT else signal.SIGINT):
                assert signal.getsignal(sent) is not signal.SIG_DFL
                signal.raise_signal(sent)

    with sigterm_as_interrupt():
        with pytest.raises(Interrupted, match="the same command resumes"):
            fit_toy(tmp_path, steps=1000, progress=stop)
        if number == signal.SIGHUP:  # of a shell that is slow to end
            signal.raise_signal(number)
    assert list_steps(tmp_path / "checkpoints")


def test_what_is_trained_is_saved_where_nobody_reads_the_progress_any_more(tmp_path: Path):
    """`hma train | tee log` lost up to ten minutes where tee was killed."""

    def closed(step: int, steps: int, metrics: dict) -> None:
        if step == 3:
            raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    with pytest.raises(BrokenPipeError):
        fit_toy(tmp_path, steps=1000, progress=closed)
    assert list_steps(tmp_path / "checkpoints") == [4]
    with pytest.raises(BrokenPipeError):
        fit_toy(tmp_path, steps=6, progress=lambda step, steps, _: closed(step - 3, steps, _))
    assert fit_toy(tmp_path, steps=6).resumed_from == 6, "a run that is finished, of which that was the last step"


def test_a_signal_that_ends_the_reader_of_the_progress_too_is_what_stopped_the_training(tmp_path: Path):
    """Ctrl-C of `hma train | tee log`, and a terminal that is closed."""

    def closed(step: int, steps: int, metrics: dict) -> None:
        if step == 3:
            signal.raise_signal(signal.SIGHUP)
            raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    with pytest.raises(Interrupted) as stopped:
        fit_toy(tmp_path, steps=1000, progress=closed)
    assert stopped.value.exit == Exit.STOPPED and list_steps(tmp_path / "checkpoints") == [4]


def test_under_nohup_training_ignores_sighup(tmp_path: Path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        fit_toy(tmp_path, steps=2, progress=lambda step, *_: signal.raise_signal(signal.SIGHUP))
    finally:
        signal.signal(signal.SIGHUP, before)


def test_a_request_in_the_last_step_stops_what_comes_after_training(tmp_path: Path):
    """A trial's evaluation, say, which may take longer than its training."""

    def stop(step: int, steps: int, metrics: dict) -> None:
        if step == steps:
            signal.raise_signal(signal.SIGTERM)

    with sigterm_as_interrupt():
        fit_toy(tmp_path / "trial", progress=stop)
        assert list_steps(tmp_path / "trial" / "checkpoints") == [6]
        with pytest.raises(Terminated):
            raise_pending_stop()
    fit_toy(tmp_path / "by itself", progress=stop)
    fit_toy(tmp_path / "the next", steps=3)  # is not stopped by what nobody asked for
