"""Whether results that lie in a directory are of the evaluation that is asked for."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from data_pipelines.windows.evalset import DatasetWindows
from experiments.cli.evaluate import MEANS, table_of, trained_on_other_tokens, write_results
from experiments.preparing.evaluation_stamp import STAMP, UNFINISHED, describe_evaluation, require_same_evaluation
from experiments.preparing.made_from import MadeFrom
from experiments.running.result_file import SAMPLES
from experiments.running.run_trial import write_evaluation
from hma_jax.config import ConfigError, DiffusionConfig, EvalConfig, ModelConfig, TrainConfig
from hma_jax.config.json import to_dict
from hma_jax.evaluation.evaluate import Evaluation
from hma_jax.evaluation.summary import summarise
from hma_jax.evaluation.windows import FILE, WindowTable
from tests.data_pipelines.windows.test_evalset import small_store
from tests.full_disk import full_disk

TRAINED = SimpleNamespace(model=ModelConfig(), train=TrainConfig(), provenance={"loader": {}}, weights="last", step=3)

PREPARED = SimpleNamespace(
    manifest=SimpleNamespace(datasets=(), frames=4, rate=2.0), tokenizer=SimpleNamespace(identity="t")
)


def require_same(place: Path, wanted: MadeFrom) -> None:
    require_same_evaluation(place, wanted)


def made_from(step: int = 3, windows: int = 2, name: str = "arm", **changed) -> MadeFrom:
    data = {name: {"tokens": "t", "windows": windows, "chosen": f"{windows}"}}
    inputs = {"model": "m", "weights": "last", "tokenizer": "a", "eval": to_dict(EvalConfig()), "datasets": [name]}
    return MadeFrom(inputs | {"data": data} | changed, {"step": step})


def test_the_same_evaluation_may_be_repeated_of_a_later_step_too(tmp_path):
    require_same(tmp_path, made_from())
    made_from().save(tmp_path, STAMP)
    require_same(tmp_path, made_from())
    require_same(tmp_path, made_from(step=9))


def test_a_model_is_shown_beside_a_copied_frame():
    one = np.zeros(1, np.int64)
    metrics = {"psnr_last": np.full(1, 8.0), "psnr": np.full(1, 9.0), "psnr_copy": np.full(1, 19.5)}
    table = table_of(summarise(WindowTable(np.array(["arm"]), one, one, one + 4, metrics), 1), "a run")
    assert [column.header for column in table.columns] == ["dataset", "psnr", "psnr_last", "psnr_copy"]
    assert [list(column.cells)[0] for column in table.columns] == ["arm", "9", "8", "19.5"]


def test_clips_of_an_evaluation_do_not_stay_beside_one_without(tmp_path):
    """As of a model that predicts no frames, judged by an earlier version."""
    (tmp_path / SAMPLES).write_bytes(b"of before")
    one = np.zeros(1, np.int64)
    windows = WindowTable(np.array(["arm"]), one, one, one + 4, {"action_error": np.ones(1)})
    write_evaluation(tmp_path, Evaluation(windows, summarise(windows, 1), {}), "run")
    assert [path.name for path in tmp_path.iterdir()] == [FILE]


def evaluation_of(value: float, pixels: int = 0) -> Evaluation:
    one = np.zeros(1, np.int64)
    windows = WindowTable(np.array(["arm"]), one, one, one + 4, {"psnr": np.full(1, value)})
    clip = np.random.default_rng(0).integers(0, 256, pixels, np.uint8)
    return Evaluation(windows, summarise(windows, 1), {"arm": {"true": clip}} if pixels else {})


def files_of(place: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in place.iterdir()}


def test_results_stay_until_all_of_those_that_replace_them_are_on_the_disk(tmp_path):
    """Clips need the most room: the table is written when the disk is full."""
    write_results(tmp_path, evaluation_of(9), made_from())
    before = files_of(tmp_path)
    assert set(before) == {FILE, MEANS, STAMP}
    later = evaluation_of(8, pixels=9000)
    with full_disk(8000), pytest.raises(OSError, match=f"{tmp_path}'$"):
        write_results(tmp_path, later, made_from(step=9))
    assert files_of(tmp_path) == before
    write_results(tmp_path, later, made_from(step=9))
    assert set(files_of(tmp_path)) == {FILE, MEANS, STAMP, SAMPLES}
    assert not [name for name in before if files_of(tmp_path)[name] == before[name]]
    with pytest.raises(OSError, match=f"{tmp_path / 'gone'}'$"):
        write_results(tmp_path / "gone", later, made_from())


@pytest.mark.parametrize("moves", range(3))
def test_means_stand_beside_no_numbers_of_others_where_a_process_is_killed(moves, tmp_path, monkeypatch):
    class Killed(BaseException):
        pass

    def killed(source, target, replace=os.replace):
        if Path(target).parent == tmp_path:
            if len(moved) == moves:
                raise Killed
            moved.append(target)
        replace(source, target)

    write_results(tmp_path, evaluation_of(9, pixels=9), made_from())
    moved = []
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(os, "replace", killed)
        write_results(tmp_path, evaluation_of(8), made_from())
    left = {path.name for path in tmp_path.iterdir()} - {UNFINISHED}
    assert left == {FILE, *[MEANS] * (moves > 1)}, "the stamp comes last"
    require_same(tmp_path, made_from())  # it may be repeated
    with pytest.raises(ConfigError, match="weights: 'last' -> 'ema'"):
        require_same(tmp_path, made_from(weights="ema"))
    write_results(tmp_path, evaluation_of(8), made_from())
    assert set(files_of(tmp_path)) == {FILE, MEANS, STAMP}


@pytest.mark.parametrize(
    ("wanted", "line"),
    [
        (made_from(name="drawer"), "datasets: 1 -> 1, without arm and with drawer"),
        (made_from(windows=5), "data of arm.windows: 2 -> 5"),
        (made_from(tokenizer="b"), "tokenizer: 'a' -> 'b'"),
        (made_from(weights="ema"), "weights: 'last' -> 'ema'"),
        (made_from(model="n"), "model: 'm' -> 'n'"),
        (made_from(eval=to_dict(EvalConfig(seed=1))), "eval.seed: 0 -> 1"),
    ],
)
def test_what_differs_is_named_and_the_way_on(wanted, line, tmp_path):
    made_from().save(tmp_path, STAMP)
    with pytest.raises(ConfigError) as refused:
        require_same(tmp_path, wanted)
    assert line in str(refused.value) and "--to DIR" in str(refused.value) and "--replace" in str(refused.value)


@pytest.mark.parametrize(
    "changed",
    [
        {"weights": "average"}, {"tokenizer": "other"}, {"frames": 5}, {"rate": 4.0}, {"tokens": "other"},
        {"windows": ((0, 0), (1, 8))},
    ],
    ids=lambda changed: next(iter(changed)),
)  # fmt: skip
def test_whatever_the_numbers_depend_on_makes_another_evaluation(changed):
    def inputs(weights="last", tokenizer="t", frames=4, rate=2.0, tokens="s", windows=((0, 0), (1, 4))):
        prepared = SimpleNamespace(
            manifest=SimpleNamespace(datasets=(DatasetWindows("arm", windows),), frames=frames, rate=rate),
            tokenizer=SimpleNamespace(identity=tokenizer),
            store=SimpleNamespace(hash=lambda _: tokens),
        )
        trained = SimpleNamespace(**vars(TRAINED) | {"weights": weights})
        return describe_evaluation(trained, ("arm",), prepared, EvalConfig()).inputs

    assert inputs(**changed) != inputs()


@pytest.mark.parametrize(
    ("provenance", "recorded"), [({"loader": {}}, {"step": 3, "steps": 9, "seed": 7}), ({"official": 1}, {"step": 3})]
)
def test_the_seed_and_the_steps_of_the_training_are_recorded_where_the_run_knows_them(provenance, recorded):
    of = vars(TRAINED) | {"train": TrainConfig(seed=7, steps=9), "provenance": provenance}
    assert describe_evaluation(SimpleNamespace(**of), (), PREPARED, EvalConfig()).recorded == recorded
    of["model"] = dataclasses.replace(TRAINED.model, diffusion=DiffusionConfig(steps=20))
    recorded = recorded | {"noising_steps": 20}
    assert describe_evaluation(SimpleNamespace(**of), (), PREPARED, EvalConfig()).recorded == recorded


def test_a_setting_of_the_protocol_that_came_later_is_no_difference(tmp_path):
    there = made_from()
    del there.inputs["eval"]["other_actions"]
    there.save(tmp_path, STAMP)
    require_same(tmp_path, made_from())
    with pytest.raises(ConfigError, match="other_actions"):
        require_same(tmp_path, made_from(eval=to_dict(dataclasses.replace(EvalConfig(), other_actions=1))))


def test_results_that_do_not_say_what_they_are_of_are_refused(tmp_path):
    write_results(tmp_path, evaluation_of(2), made_from())
    for damage in ((tmp_path / STAMP).unlink, lambda: (tmp_path / STAMP).write_text("{")):
        damage()
        with pytest.raises(ConfigError, match=rf"holds results \({FILE}\), but {STAMP}, .* --to DIR, .* --replace\.$"):
            require_same(tmp_path, made_from())
    write_results(tmp_path, evaluation_of(2), made_from())
    require_same(tmp_path, made_from())


def test_other_tokens_than_a_model_was_trained_on_are_told(tmp_path):
    """Where more is held out, some of it was trained on. What a model goes on from was trained, too."""
    few, more = (small_store(tmp_path / f"{n}", lengths=(20,) * 8, min_val=n) for n in (1, 2))
    seen = set(few.manifest("toy").train.episodes) & set(more.manifest("toy").val.episodes)
    assert len(seen) == 1
    provenance = {"loader": {"datasets": ["toy"]}, "store": few.hash(["toy"])}
    for run in (provenance, {"loader": {"datasets": []}, "store": few.hash([]), "origin": {"provenance": provenance}}):
        trained = SimpleNamespace(provenance=run)
        assert trained_on_other_tokens(trained, ["toy", "arm"], few) == []
        assert trained_on_other_tokens(trained, ["toy", "arm"], more) == ["toy"]
    assert trained_on_other_tokens(SimpleNamespace(provenance={"official": {}}), ["toy"], few) == []
