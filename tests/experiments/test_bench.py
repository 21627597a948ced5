import csv
from dataclasses import replace
from pathlib import Path
from typing import get_args

import jax
import numpy as np
import pytest

from experiments.bench import against_release
from experiments.bench import generate as bench_generate
from experiments.bench import rollout as bench_rollout
from experiments.bench.evaluate import time_evaluation
from experiments.bench.models import Subject, make_subject
from experiments.bench.quality import decodings, judge
from experiments.bench.record import Stage, make_record, read_record, write_record
from experiments.bench.report import markdown
from experiments.bench.rollout import agreement, time_rollouts
from experiments.bench.timing import Compiled, Timing, summarise, time_by_turns
from experiments.bench.train import time_training
from experiments.cli.main import main
from hma_jax.config import ConfigError, DecodeConfig, EvalConfig, ExecutionConfig, SamplerConfig
from hma_jax.config.evaluation import SamplerKind
from hma_jax.model.flops import denoiser_flops, pass_flops
from tests.data_pipelines.fakes import REAL_DATA
from tests.hma_jax.evaluation.fakes import GreyTokenizer, make_batches
from tests.tiny import SMALLER, TABLE, lively_params, model_config


@pytest.fixture(scope="module")
def subject():
    return make_subject("cpu", robots=2, layers=1)


def test_stages_take_turns_and_are_warmed_up():
    calls = []
    timings = time_by_turns({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 3)
    assert calls == ["a", "b"] * 5
    assert timings["a"].repeats == 3


def test_a_summary_gives_median_and_p90():
    timing = summarise([float(x) for x in range(1, 12)])
    assert (timing.median, timing.p90, timing.best) == (6.0, 10.0, 1.0)


@pytest.mark.slow
def test_rollouts_are_timed_beside_recomputation_and_agree_with_it(subject):
    stages = time_rollouts(subject, 2, 14, 4, DecodeConfig(2), repeats=1, naive=True)
    assert [(s.name, s.frames) for s in stages] == [("rollout", 20), ("recompute", 20)]
    assert stages[0].flops < stages[1].flops
    assert agreement(subject, 2, 14, 4, DecodeConfig(2)) == 1


def test_continuous_frames_count_the_denoiser_at_every_sampler_step(monkeypatch):
    """Counted once a frame, GFLOP/s came out an order of magnitude too low. Nothing is compiled or run here."""
    for module in (bench_generate, bench_rollout):
        monkeypatch.setattr(module, "compile_call", lambda *_, **__: Compiled(lambda *_: None, 0.0, None))
        monkeypatch.setattr(module, "time_by_turns", lambda calls, _: dict.fromkeys(calls, Timing(1.0, 1.0, 1.0, 1)))
    subject = make_subject("cpu-continuous", layers=1)
    few, many = (DecodeConfig(2, sampler=SamplerConfig(steps=n)) for n in (10, 100))
    per_step = denoiser_flops(subject.config, subject.config.tokens, own_steps=False)
    at = [{s.name: s.flops for s in bench_generate.time_frames(subject, 2, decode, 1)} for decode in (few, many)]
    more = {name: at[1][name] - at[0][name] for name in at[0]}
    ways = dict.fromkeys(("recompute", "slide", "fill", "stream"), pytest.approx(2 * 90 * per_step))
    assert more == {"whole": 0, "plain": 0} | ways
    at = [[s.flops for s in time_rollouts(subject, 2, 14, 4, decode, 1, naive=True)] for decode in (few, many)]
    assert np.subtract(*at[::-1]) == pytest.approx(2 * 10 * 90 * per_step)


@pytest.mark.slow
def test_training_is_timed_beside_a_forward_pass(subject):
    stages = {s.name: s.flops for s in time_training(subject, 2, repeats=1)}
    assert stages == {"forward": stages["plain"], "plain": stages["plain"], "step": 3 * stages["plain"]}


@pytest.mark.slow
def test_the_fast_evaluation_has_the_numbers_of_the_literal_one(subject):
    protocol, literal = time_evaluation(subject, 2, EvalConfig(random_actions=1), repeats=1)
    assert (protocol.name, literal.name) == ("protocol", "literal")


def test_an_unknown_model_is_refused_by_name():
    with pytest.raises(ConfigError, match="unknown model 'huge'; known: base, xl"):
        make_subject("huge")


def test_inference_weights_are_read_in_the_type_they_are_used_in():
    subject = make_subject("cpu", ExecutionConfig("bfloat16"), layers=1)
    used = subject.inference_params
    products = (used["trunk"]["blocks"]["mlp_in"], used["frame_head"]["linear"])
    assert {x["kernel"].dtype.name for x in products} == {"bfloat16"}
    assert used["embed"]["tables"].dtype == "float32"  # summed in it, then cast
    assert {x.dtype.name for x in jax.tree.leaves(subject.params)} == {"float32"}


def test_a_record_says_what_it_was_made_on_and_survives_the_disk(tmp_path: Path):
    stage = Stage("fill", 1, Timing(0.5, 0.6, 0.4, 3), 1.5, 10, frames=1, flops=1e9)
    record = make_record(
        "generate", "cpu", "hma bench generate", dtype="float32", seed=0, settings={"robots": 1},
        stages=(stage,), ratios={"recompute / fill, batch 1": 8.0}, matmul_flops_per_second=1e10,
    )  # fmt: skip
    path = write_record(record, tmp_path)
    assert path.name == "generate-cpu-float32-cpu.json"
    again = read_record(path)
    assert again == replace(record, machine=again.machine)
    assert {"commit", "packages", "processor", "devices"} <= set(again.machine)
    text = markdown([again])
    assert "| fill | 1 | 500.0 ms | 600.0 ms | 2.00 | 20.0% |" in text
    assert "recompute / fill, batch 1: 8.00" in text


def test_a_file_that_is_no_record_is_refused(tmp_path: Path):
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(ConfigError, match="x.json: not a benchmark record"):
        read_record(tmp_path / "x.json")


@pytest.mark.slow
def test_the_command_times_frames_every_way_and_the_report_reads_its_record(tmp_path: Path, capsys):
    options = ["--model", "cpu", "--layers", "1", "--batch", "2", "--repeats", "1", "--out", str(tmp_path)]
    assert main(["bench", "generate", *options]) == 0
    assert "hma bench report" in capsys.readouterr().out
    (file,) = tmp_path.glob("*.json")
    record = read_record(file)
    stages = {s.name: s for s in record.stages}
    assert set(stages) == {"whole", "plain", "recompute", "slide", "fill", "stream"}
    assert stages["recompute"].flops == 2 * stages["whole"].flops
    shape = make_subject("cpu", layers=1)
    read, unread = (2 * pass_flops(shape.config, shape.table, 1, 1, predicted) for predicted in (1, 0))
    # Of the passes over one frame, each a twelfth, two are read out: the new frame's.
    assert stages["fill"].flops == pytest.approx(3 / 12 * stages["whole"].flops - (read - unread), rel=0.05)
    assert stages["slide"].flops == pytest.approx(13 / 12 * stages["whole"].flops - 11 * (read - unread), rel=0.05)
    assert all(s.timing.median > 0 and s.compile_seconds > 0 for s in stages.values())
    assert set(record.ratios) == {
        "recompute / fill, batch 2", "recompute / stream, batch 2", "slide / whole window pass, batch 2",
        "plain / whole window pass, batch 2",
    }  # fmt: skip
    figure = tmp_path / "bench.png"
    assert main(["bench", "report", str(tmp_path), "--figure", str(figure)]) == 0
    assert "**generate cpu-layers-1**" in capsys.readouterr().out
    assert figure.stat().st_size > 1000


@pytest.mark.slow
def test_a_tokenizer_is_timed_both_ways(tmp_path: Path, capsys):
    assert main(["tokenizer", "pixels", "--out", str(tmp_path / "tok"), "--image-size", "16", "--patch", "4"]) == 0
    options = ["--tokenizer", str(tmp_path / "tok"), "--repeats", "1", "--out", str(tmp_path)]
    assert main(["bench", "tokenize", *options]) == 0
    (file,) = tmp_path.glob("tokenize-*.json")
    assert [s.name for s in read_record(file).stages] == ["encode", "decode", "both"]
    assert main(["bench", "tokenize", "--tokenizer", "nothing"]) == 2
    assert "give magvit2, svd-vae or a tokenizer's directory" in " ".join(capsys.readouterr().err.split())


def test_two_programs_take_turns_and_the_faster_one_is_said_by_how_much(tmp_path: Path, monkeypatch):
    (tmp_path / "hma" / "model").mkdir(parents=True)
    answers = {against_release.RELEASE_PREFIX: "3", against_release.OUR_PREFIX: "2"}

    class Told(against_release.Worker):
        def __init__(self, command, **environment):
            whose = against_release.RELEASE_PREFIX if "PYTHONPATH" in environment else against_release.OUR_PREFIX
            assert command[-2:] == ["3", "bfloat16"]
            assert bool(environment["GLIBC_TUNABLES"]) == (
                whose == against_release.OUR_PREFIX
            )  # the release as its users start it
            echo = f"while read stage; do echo $stage >> {tmp_path}/{whose[:4]}; echo {answers[whose]}; done"
            super().__init__(["sh", "-c", echo])

    monkeypatch.setattr(against_release, "Worker", Told)
    stages, ratios = against_release.time_against_release(
        tmp_path, Path("python"), ("fill", "slide"), 2, lambda *_: None, rows=3, dtype="bfloat16"
    )
    assert ratios == {"fill, times faster": 1.5, "slide, times faster": 1.5}
    assert [(s.name, s.batch) for s in stages] == [("release: frame", 3), ("ours: fill", 3), ("ours: slide", 3)]
    assert (tmp_path / "ours").read_text().split() == ["fill", "slide"] * 3
    assert (tmp_path / "rele").read_text().split() == ["frame"] * 3


def test_a_program_that_dies_is_said_and_no_checkout_is_refused(tmp_path: Path):
    with (
        against_release.Worker(["sh", "-c", "exit 3"]) as worker,
        pytest.raises(ConfigError, match="'fill' ended with code 3"),
    ):
        worker.run("fill")
    with pytest.raises(ConfigError, match="is no checkout of the official release"):
        against_release.time_against_release(tmp_path, Path("python"), ("fill",), 1, lambda *_: None)
    with pytest.raises(ConfigError, match="no stage swim"):
        against_release.time_against_release(tmp_path, Path("python"), ("swim",), 1, lambda *_: None)


def test_decodings_vary_what_the_model_leaves_open():
    ids, latents = (make_subject(name, layers=1).config for name in ("cpu", "cpu-continuous"))
    assert list(decodings(ids, EvalConfig(), 12)) == ["M = 8", "M = 4", "M = 2", "M = 1"]
    assert list(decodings(ids, EvalConfig(), 24)) == ["exact", "streaming"]
    samplers = decodings(latents, EvalConfig(), 12)
    assert list(samplers)[:2] == ["ddpm 100", "ddpm 50"] and {"ddim 4", "dpm++ 8"} < set(samplers)
    assert {name.split()[0] for name in samplers} == set(get_args(SamplerKind))
    assert samplers["dpm++ 8"].decode.sampler.kind == "dpm++"


@pytest.mark.slow
def test_a_model_that_was_trained_without_actions_is_judged_without():
    config = model_config(**SMALLER)
    declared, params = lively_params(config)
    subject = Subject(config, ExecutionConfig(), TABLE, declared, params, 0)
    settings = {"M = 1": EvalConfig(prompt_frames=1, random_actions=2, other_actions=0, decode=DecodeConfig(1))}
    args = subject, GreyTokenizer(), lambda: make_batches(config), settings, config.frames, 1
    judged = {setting: judge(*args, setting, lambda *_: None)[0][0] for setting in ("passive", "forward")}
    assert judged["passive"].delta_psnr == judged["passive"].delta_psnr_sem == 0 < judged["forward"].delta_psnr_sem


@pytest.mark.slow
def test_a_trained_model_is_judged_under_every_decoding(tmp_path: Path):
    where = ["--preset", "smoke", "--out", str(tmp_path)]
    assert main(["train", *where]) == 0
    options = ["--frames", "6", "--windows", "2", "--repeats", "1"]
    assert main(["bench", "quality", str(tmp_path / "model"), *where, *options]) == 0
    out = tmp_path / "model" / "quality"
    assert (out / "quality-6.png").stat().st_size > 1000
    exact, streaming = list(csv.DictReader((out / "quality-6.csv").open()))
    assert (exact["decoding"], exact["cost"], streaming["decoding"]) == ("exact", "1.0", "streaming")
    (file,) = out.glob("*.json")
    assert "PSNR of streaming over exact, dB" in read_record(file).ratios
    assert main(["bench", "quality", str(tmp_path / "model"), *where, "--frames", "3"]) == 2


@pytest.mark.slow
def test_loading_is_timed_with_its_memory(tmp_path: Path):
    options = ["--data", str(REAL_DATA), "--windows", "640", "--frames", "4", "--out", str(tmp_path)]
    assert main(["bench", "load", *options]) == 0
    (file,) = tmp_path.glob("load-*.json")
    assert {f.suffix for f in tmp_path.glob("load-store-memory.*")} == {".csv", ".png"}
    record = read_record(file)
    names = ["windows, 1 thread", "windows, 2 threads", "RLDS frames, 1 thread", "RLDS frames, 2 threads"]
    assert [s.name for s in record.stages] == names
    windows, _, frames, _ = record.stages
    assert (windows.frames, windows.timing.repeats, frames.frames) == (32 * 4, 20, 128)
    assert all("kB per thousand" in note for note in record.notes)
