"""What was made with other settings or data is refused and stays, byte for byte, until it is asked for."""

import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from data_pipelines.loading import frames
from data_pipelines.registry import get_spec, register
from data_pipelines.suite import generate as suite_generator
from data_pipelines.tokens import tokenize_job
from data_pipelines.windows.evalset import ChoiceSettings, DatasetWindows, EvalManifest
from experiments.cli.main import main
from experiments.data_size import sizes_by_tokens
from experiments.preparing import given_tokenizer
from experiments.preparing import tokenizer as tokenizer_step
from experiments.preparing.made_from import (
    STAMP,
    dataset_differences,
    differences,
    may_replace,
    read_stamp,
)
from experiments.preparing.sources import find_sources
from experiments.preparing.windows import _differences
from experiments.running.attempts import RESULT
from experiments.running.closure import trace
from experiments.running.workspace import Record, save_record
from experiments.study_setup import StudyArguments, make_setup
from hma_jax.evaluation.statistics import Stat
from tests import files
from tests.data_pipelines.fakes import write_rlds
from tests.experiments import fakes
from tests.experiments.idle import ARM, BASE, SMOKE, idle_training  # noqa: F401

STEPS = ("suite", "tokenizer", "tokens", "windows", "study")


LENGTHS = [12, 12, 13, 13, 14, 14, 15, 15]  # of eight episodes two are held out, with a whole window each


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, list[str]]:
    """A directory in which `hma tokenize` ran with settings of its own."""
    root = tmp_path_factory.mktemp("made")
    robots = (ARM, get_spec("dlr_edan_shared_control_converted_externally_to_rlds"))
    data = ["--data", *(str(write_rlds(root / "rlds", spec, LENGTHS)) for spec in robots)]
    assert main(["tokenize", *SMOKE, "--out", str(root / "out"), *data, "--set", "tokenizer_train.steps=5"]) == 0
    return root / "out", data


@pytest.fixture
def out(made, tmp_path) -> Path:
    return shutil.copytree(made[0], tmp_path / "out")


contents = partial(files.contents, leaving_out=(".lock", ".asked.json", "data.json"))  # only a report reads these


@pytest.fixture
def hma(out, made, capsys):
    """Runs a command on the directory; returns (exit code, what it said)."""

    def run(command: str, *arguments: str, steps: int = 5, data: list[str] | None = None) -> tuple[int, str]:
        capsys.readouterr()
        where = ["--out", str(out), *(made[1] if data is None else data), "--set", f"tokenizer_train.steps={steps}"]
        code = main([*command.split(), *SMOKE, *where, *arguments])
        said = capsys.readouterr()
        return code, said.err if code else said.out

    return run


def test_the_quality_of_a_tokenizer_counts_held_out_episodes(out):
    """Two are held out of each of two robots."""
    quality = json.loads((out / "tokenizer" / tokenizer_step.QUALITY).read_text())
    assert quality["n"] == 8 and 1 < quality["episodes"] <= 4


# --- Nothing to ask ----------------------------------------------------------------------------


def test_the_same_again_changes_nothing(hma, out):
    before = contents(out)
    assert hma("tokenize")[0] == 0 and hma("tokenizer train")[0] == 0
    assert contents(out) == before


@pytest.mark.parametrize(
    "setting",
    ["train.steps=1", "train.batch=2", "model.mlp_ratio=2", "eval.decode.unmask_steps=3", "execution.dtype=bfloat16",
     "seeds=5", "widths=16,32", "flops_per_second=1", "transfer.rates=5", "suite.scale=2", "store.max_skipped=3"],
)  # fmt: skip
def test_settings_that_nothing_prepared_depends_on_ask_for_nothing(setting, hma, out):
    before = contents(out)
    assert hma("tokenize", "--set", setting)[0] == 0
    assert contents(out) == before


def test_interrupted_work_of_the_same_inputs_goes_on(hma, out, monkeypatch):
    shutil.rmtree(out / "tokenizer")
    publish = tokenizer_step.publish
    monkeypatch.setattr(tokenizer_step, "publish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    assert hma("tokenize")[0] == 130
    (aside,) = out.glob("tokenizer.*")
    monkeypatch.setattr(tokenizer_step, "publish", publish)
    trained = (aside / "metrics.jsonl").stat().st_mtime_ns
    assert hma("tokenize")[0] == 0
    assert not aside.exists() and (out / "tokenizer" / "metrics.jsonl").stat().st_mtime_ns >= trained


# --- Refused -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "step", "line"),
    [
        (["--set", "tokenizer_train.steps=3"], "tokenizer", "tokenizer_train.steps: 5 -> 3"),
        (["--set", "tau=2"], "tokenizer", "tau: 3.0 -> 2.0"),
        (["--set", "tokenizer.channels=8"], "tokenizer", "tokenizer.channels: 16 -> 8"),
        (["--set", "store.min_val=1"], "tokenizer", "store.min_val: 2 -> 1"),
        (["--set", "store.max_train=4"], "tokenizer", "store.max_train: None -> 4"),
        (["--set", "store.frame_step=1"], "tokens", "store.frame_step: 3 -> 1 (berkeley_gnm_cory_hall, "),
        (["--set", "eval.windows_per_dataset=1"], "windows", "eval.windows_per_dataset: 2 -> 1"),
        (["--set", "eval.seed=7"], "windows", "eval.seed: 0 -> 7"),
        (["--set", "model.frames=3"], "windows", "model.frames: 4 -> 3"),
        (["--set", "rate=1"], "tokens", "rate: 2.0 -> 1.0 (the evaluation windows)"),
    ],
)
@pytest.mark.parametrize("command", ["tokenize", "train"])
def test_what_other_settings_made_is_refused_by_name_and_stays(command, arguments, step, line, hma, out):
    before = contents(out)
    code, said = hma(command, *arguments)
    assert code == 2 and f"\n  {line}" in said and f"--replace {step}" in said and "another --out" in said
    assert contents(out) == before
    for later in STEPS[STEPS.index(step) + 1 :]:
        assert hma(command, *arguments, "--replace", later)[0] == 2
    assert contents(out) == before


def test_the_command_of_the_issue(hma, out):
    """After a tokenizer of its own, the printed command without --set made another in its place, with exit code 0."""
    before = contents(out)
    code, said = hma("train", steps=3)
    assert code == 2 and "tokenizer_train.steps: 5 -> 3" in said
    assert contents(out) == before


def test_other_data_is_refused(hma, out, made, tmp_path):
    before, (_, arm, pusher) = contents(out), made[1]
    code, said = hma("tokenize", data=["--data", arm])
    assert (
        code == 2
        and "datasets: 2 -> 1, without dlr_edan_shared_control_converted_externally_to_rlds" in said
        and "--replace windows" in said
    )
    other = str(write_rlds(tmp_path, ARM, [20] * 6))
    code, said = hma("tokenize", data=["--data", other, pusher])
    assert code == 2 and f"data of {ARM.name}.shards: " in said and "--replace tokenizer" in said
    assert contents(out) == before


def test_replacing_replaces_that_and_what_follows_and_nothing_before(hma, out):
    before = contents(out)
    assert hma("tokenize", "--set", "store.frame_step=1", "--replace", "tokens")[0] == 0
    after = contents(out)
    changed = {name.split("/")[0] for name in before if before[name] != after.get(name)}
    assert changed == {"tokens", "eval_manifest.json"}
    assert hma("tokenize", "--set", "store.frame_step=1")[0] == 0  # as it is there now
    assert hma("tokenize")[0] == 2
    assert hma("tokenize", "--replace", "tokens")[0] == 0
    assert contents(out) == before


def test_a_tokenizer_that_is_given_does_not_replace_one_that_was_trained(hma, out, tmp_path):
    settings = ["--set", "dataset_counts=1", "--set", "tokenizer_train.seed=1"]
    assert main(["tokenizer", "train", *SMOKE, "--out", str(tmp_path / "b"), *settings]) == 0
    before, given = contents(out), ["--tokenizer", str(tmp_path / "b" / "tokenizer")]
    code, said = hma("tokenize", *given)
    assert code == 2 and "(trained here) -> " in said and "--replace tokenizer" in said
    assert contents(out) == before
    assert hma("tokenize", *given, "--replace", "tokenizer")[0] == 0
    code, said = hma("tokenize")
    assert code == 2 and "origin: given with --tokenizer, identity " in said and " -> trained here" in said


@pytest.mark.parametrize(
    ("min_val", "fact", "before", "told"),
    [
        (1, None, None, None),
        (2, None, None, None),
        (3, None, None, " with fewer episodes held out (store.min_val: 2 -> 3): it may have been trained on frames"),
        (2, "shards", "fewer", "the tokenizer was trained on other recordings of "),
        (2, "split", "all", " with other episodes held out (split: 'all' -> 'train'): it may have been trained on"),
        (2, "val_split", "val", " with other episodes held out (val_split: 'val' -> ''): it may have been trained on"),
    ],
)
def test_a_given_tokenizer_that_may_have_seen_what_is_held_out_is_told(
    min_val, fact, before, told, made, tmp_path, capsys
):
    there, data = made
    tokenizer = shutil.copytree(there / "tokenizer", tmp_path / "tokenizer")
    if fact:  # was another when it was trained
        stamp = json.loads((tokenizer / STAMP).read_text())
        for facts in stamp["inputs"]["data"].values():
            facts[fact] = before
        (tokenizer / STAMP).write_text(json.dumps(stamp))
    given = ["--tokenizer", str(tokenizer), "--set", f"store.min_val={min_val}"]
    assert main(["tokenize", *SMOKE, "--out", str(tmp_path / "new"), *data, *given]) == 0
    said = capsys.readouterr().out
    assert said.count("frames that are held out here") == bool(told) and (told or "") in said


def test_a_given_tokenizer_that_was_trained_on_unseen_robots_is_told(made, tmp_path, capsys):
    there, data = made
    study = ["--set", f"unseen={ARM.name}", "--set", "datasets=dlr_edan_shared_control_converted_externally_to_rlds"]
    given = ["--tokenizer", str(there / "tokenizer"), *study]
    assert main(["tokenize", *SMOKE, "--out", str(tmp_path), *data, *given]) == 0
    assert f"was trained on frames of {ARM.name}, which `unseen` names" in capsys.readouterr().out


def test_the_copy_of_a_copy_of_a_tokenizer_still_says_what_it_was_trained_from(made, tmp_path, capsys):
    there, data = made
    trained, tokenizer = read_stamp(there / "tokenizer"), there / "tokenizer"
    for name in ("first", "second"):
        given = ["--tokenizer", str(tokenizer), "--set", "store.min_val=3"]
        assert main(["tokenize", *SMOKE, "--out", str(tmp_path / name), *data, *given]) == 0
        assert "frames that are held out here" in capsys.readouterr().out
        tokenizer = tmp_path / name / "tokenizer"
        copied = read_stamp(tokenizer)
        assert copied.inputs["origin"].startswith("given") and copied.inputs["trained_from"] == trained.inputs
        assert (copied.recorded, copied.machine) == (trained.recorded, trained.machine)


def test_a_copy_whose_stamp_has_the_origin_alone_stays_in_use(made, tmp_path):
    """As that of the committed study `ladder`."""
    there, data = made
    given = ["--tokenizer", str(there / "tokenizer")]
    assert main(["tokenize", *SMOKE, "--out", str(tmp_path), *data, *given]) == 0
    stamp = tmp_path / "tokenizer" / STAMP
    origin = json.loads(stamp.read_text())["inputs"]["origin"]
    stamp.write_text(json.dumps({"inputs": {"origin": origin}, "recorded": {}, "machine": {}}))
    before = contents(tmp_path)
    assert main(["tokenize", *SMOKE, "--out", str(tmp_path), *data, *given]) == 0
    assert contents(tmp_path) == before


def test_a_given_tokenizer_is_judged_once_by_frames_that_the_study_holds_out(made, tmp_path, monkeypatch, capsys):
    """Those by which it was judged where it was trained: a study of the same data and settings finds the same."""
    there, data = made
    command = ["tokenize", *SMOKE, "--out", str(tmp_path), *data, "--tokenizer", str(there / "tokenizer")]
    assert main(command) == 0 and "reconstruction of held-out frames: " in capsys.readouterr().out
    quality = tmp_path / "tokenizer" / tokenizer_step.QUALITY
    first = quality.read_text()
    assert first == (there / "tokenizer" / tokenizer_step.QUALITY).read_text()

    judged = []
    monkeypatch.setattr(given_tokenizer, "reconstruction_psnr", lambda *_: judged.append(1) or Stat(20.0, 0.1, 8, 2))
    setup = make_setup(StudyArguments("smoke", tmp_path, tuple(data[1:])))
    found = find_sources(setup.study, setup.data)
    given_tokenizer.judge_tokenizer(setup.study, setup.workspace, found)
    assert not judged
    for sources in (found[:1], found[:1], found):
        given_tokenizer.judge_tokenizer(setup.study, setup.workspace, sources)
    assert len(judged) == 2 and json.loads(quality.read_text())["mean"] == 20.0


def test_no_dataset_is_opened_for_a_given_tokenizer_that_knows_none_of_them(made, tmp_path, monkeypatch):
    """Each was read whole, for a note that could not come."""
    there, data = made
    tokenizer = shutil.copytree(there / "tokenizer", tmp_path / "tokenizer")
    (tokenizer / STAMP).unlink()
    setup = make_setup(StudyArguments("smoke", tmp_path / "new", tuple(data[1:])))
    found = find_sources(setup.study, setup.data)
    monkeypatch.setattr(given_tokenizer, "open_source", lambda *_: pytest.fail("opened"))
    given_tokenizer.adopt_tokenizer(tokenizer, setup.study, setup.workspace, found)
    assert setup.workspace.tokenizer.is_dir()


def test_threads_of_tokenising_train_the_tokenizer_too(made, tmp_path, monkeypatch):
    def look(*_, threads, **__):
        raise Stopped(threads)

    monkeypatch.setattr(frames, "make_frame_loader", look)
    with pytest.raises(Stopped, match="5"):
        main(["tokenize", *SMOKE, "--out", str(tmp_path / "out"), *made[1], "--threads", "5"])


class Stopped(Exception):
    pass


def test_the_tokenizer_that_is_there_can_be_given(hma, out):
    before = contents(out)
    assert hma("tokenize", "--tokenizer", str(out / "tokenizer"))[0] == 0
    assert contents(out) == before


# --- Sources --------------------------------------------------------------


def test_another_part_of_the_data_is_tokenised_by_the_tokenizer_that_is_there(hma, out):
    """As the page on own data says it."""
    limit = ["--set", "store.max_train=4", "--tokenizer", str(out / "tokenizer")]
    code, said = hma("tokenize", *limit)
    assert code == 2 and "store.max_train: None -> 4 (" in said and "--replace tokens" in said
    code, said = hma("tokenize", *limit, "--replace", "tokens")
    assert code == 0 and "may have been trained on" not in said
    assert f"{ARM.name}: store.max_train leaves out 2 episodes; 6 are used" in " ".join(said.split())
    size = sizes_by_tokens(out / "data.json")[ARM.name]
    assert (size.episodes, size.tokenised) == (8, 6)


def test_changed_sources_of_the_tokenizer_keep_it_and_say_so(hma, out, monkeypatch):
    before = contents(out)
    monkeypatch.setattr(tokenizer_step, "closure_hash", lambda _: "edited")
    code, said = hma("tokenize")
    assert code == 0 and "made with other code: " in said and "-> 'edited'" in said
    assert contents(out) == before
    assert hma("tokenize", "--replace", "suite")[0] == 0
    assert contents(out) == before  # nothing that was asked for differs
    shutil.rmtree(out / "tokenizer")
    assert hma("tokenize")[0] == 0 and "other code" not in hma("tokenize")[1]


def test_sources_of_the_tokenizer_are_its_own():
    names = trace(tokenizer_step.SOURCES)
    assert {
        "hma_jax.tokenizers.lfq",
        "data_pipelines.sources.rlds.images",
        "data_pipelines.sources.rlds.dataset",
        "data_pipelines.sources.lerobot_dataset",
        "hma_jax.training.loop",
    } <= names.keys()
    assert not [name for name in names if name.startswith(("experiments", "hma_jax.model.trunk"))]


@pytest.mark.parametrize("text", ["", "[]", '{"inputs": 3}', '{"inputs": {}, "recorded": "x"}'])
def test_a_damaged_stamp_says_nothing(tmp_path, text):
    (tmp_path / STAMP).write_text(text)
    assert read_stamp(tmp_path) is None


def test_a_corrected_image_key_does_not_keep_a_tokenizer_of_the_wrong_camera(hma, out, monkeypatch):
    before, wrong = contents(out), "steps/observation/wrist"
    stamp = json.loads((out / "tokenizer" / STAMP).read_text())
    stamp["inputs"]["data"][ARM.name]["image_key"] = wrong
    (out / "tokenizer" / STAMP).write_text(json.dumps(stamp))
    code, said = hma("tokenize")
    assert code == 2 and f"data of {ARM.name}.image_key: '{wrong}' -> '{ARM.image_key}'" in said
    assert "--replace tokenizer" in said and f"--tokenizer {out / 'tokenizer'}" in said
    assert contents(out).keys() == before.keys()


def test_corrected_images_do_not_keep_a_tokenizer_of_others(hma, out, monkeypatch):
    monkeypatch.setattr("data_pipelines.registry.table._registered", {})
    register([replace(ARM, image_corrections=("rotate_180",))])
    code, said = hma("tokenize")
    assert code == 2
    assert f"data of {ARM.name}.image_corrections: [] -> ['rotate_180']" in said and "image_key" not in said


@pytest.fixture
def with_record(out, made):
    """The study of the directory has run, with one trial."""
    arguments = StudyArguments("smoke", out, tuple(made[1][1:]), set=("tokenizer_train.steps=5",))
    setup = make_setup(arguments)
    save_record(setup.workspace, Record(setup.study, setup.data, ("width",), provenance=fakes.PROVENANCE))
    (out / "trials" / "a").mkdir(parents=True)
    (out / "trials" / "a" / RESULT).touch()


@pytest.mark.parametrize("command", ["sweep width", "train"])
def test_a_dry_run_after_an_entry_was_corrected_counts_what_is_made_again(command, with_record, hma, monkeypatch):
    """It said that all is done, of a command that was refused, or made everything again."""
    trials, line = command != "train", f"spec.hz: {ARM.hz:.1f} -> {ARM.hz / 2} ({ARM.name})"
    code, said = hma(command, "--dry-run")
    assert code == 0 and "would be refused" not in said and "Already done, and not counted: the tokenizer, tok" in said
    monkeypatch.setattr("data_pipelines.registry.table._registered", {})
    register([replace(ARM, hz=ARM.hz / 2)])
    for replacement in ((), ("--replace", "tokens")):
        code, said = hma(command, "--dry-run", *replacement)
        assert code == 0 and ("would be refused" in said) == (not replacement) == (line in said)
        text = " ".join(said.split())
        assert "Already done, and not counted: the tokenizer. " in text
        assert ("1 finished trial of other data here: not used." in text) == trials


def test_a_dataset_is_added_with_one_replacement_that_the_first_refusal_names(with_record, hma, out, made, tmp_path):
    new = write_rlds(tmp_path, get_spec("austin_buds_dataset_converted_externally_to_rlds"), LENGTHS)
    before, more = contents(out), [*made[1], str(new)]
    code, said = hma("sweep width", data=more)
    assert code == 2 and said.count("--replace") == 2 and "--replace tokenizer, which" in said
    assert said.count("datasets: 2 -> 3") == 1 and "(the study's record and report)" in said
    assert f"--tokenizer {out / 'tokenizer'} and --replace windows; or" in said and contents(out) == before
    for arguments in ([], ["--replace", "study"]):
        assert "would be refused" in hma("sweep width", "--dry-run", *arguments, data=more)[1]
    for arguments in (["--replace", "tokenizer"], ["--tokenizer", str(out / "tokenizer"), "--replace", "windows"]):
        assert "would be refused" not in hma("sweep width", "--dry-run", *arguments, data=more)[1]


def test_tokenizer_and_windows_copied_to_another_place_are_those_of_the_study(hma, out, made, tmp_path):
    """Small files of content alone: no path, no time."""
    here = tmp_path / "elsewhere"
    (here / "tokenizer").mkdir(parents=True)
    for name in (STAMP, "tokenizer.json", "weights.npz"):
        (here / "tokenizer" / name).write_bytes((out / "tokenizer" / name).read_bytes())
    (here / "eval_manifest.json").write_bytes((out / "eval_manifest.json").read_bytes())
    copied = contents(here)
    assert not [name for name, data in copied.items() if any(str(p).encode() in data for p in (out, made[0].parent))]
    assert sum(map(len, copied.values())) < 100_000
    command = ["tokenize", *SMOKE, "--out", str(here), *made[1], "--set", "tokenizer_train.steps=5"]
    assert main(command) == 0
    again = contents(here)
    assert {name: again[name] for name in copied} == copied
    tokens = {name: data for name, data in contents(out).items() if name.startswith("tokens/")}
    assert tokens and {name: data for name, data in again.items() if name.startswith("tokens/")} == tokens


def test_tokens_that_earlier_code_would_make_otherwise_are_refused_and_stay(hma, out, monkeypatch):
    before = contents(out)
    monkeypatch.setattr(tokenize_job, "RECIPE_VERSION", tokenize_job.RECIPE_VERSION + 1)
    code, said = hma("tokenize")
    assert (
        code == 2
        and f"recipe: {tokenize_job.RECIPE_VERSION - 1} -> {tokenize_job.RECIPE_VERSION} ({ARM.name}"
        in " ".join(said.split())
    )
    assert "--replace tokens" in said and contents(out) == before
    assert hma("tokenize", "--replace", "tokens")[0] == 0 and hma("tokenize")[0] == 0
    assert contents(out) != before


def test_a_tokenizer_that_does_not_say_what_it_was_made_from(hma, out):
    (out / "tokenizer" / STAMP).unlink()
    before = contents(out)
    code, said = hma("tokenize")
    assert code == 2 and "it is not recorded there" in said
    assert contents(out) == before
    use_it = ["--tokenizer", str(out / "tokenizer")]
    assert f"--tokenizer {out / 'tokenizer'}" in said and hma("tokenize", *use_it)[0] == 0
    after = contents(out)
    assert after.pop("tokenizer/judged_on.json")  # it is judged as any that is given
    assert after == before


def test_windows_that_were_edited_are_not_repaired_without_being_asked(hma, out):
    manifest = out / "eval_manifest.json"
    text = manifest.read_text()
    manifest.write_text(text.replace('"seed": 0', '"seed": 1'))
    code, said = hma("tokenize")
    assert code == 2 and "it was changed" in said and "--replace windows" in said
    assert hma("tokenize", "--replace", "windows")[0] == 0
    assert manifest.read_text() == text


# --- The suite ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def suite(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("suite")
    assert main(["data", "suite", *SMOKE, "--out", str(root), "--set", "datasets=pusher_sand"]) == 0
    return root


def test_the_suite_is_not_made_with_another_seed_or_size_in_its_place(suite, tmp_path, capsys):
    out = shutil.copytree(suite, tmp_path / "out")
    before, command = contents(out), ["data", "suite", *SMOKE, "--out", str(out), "--set", "datasets=pusher_sand"]
    assert main([*command, "--set", "suite.seed=3", "--set", "suite.scale=0.1", "--set", "suite.validation=5"]) == 2
    said = capsys.readouterr().err
    assert (
        "suite.seed: 0 -> 3" in said
        and "suite.scale or suite.fewest: 10 -> 50 episodes" in said
        and "--replace suite" in said
    )
    assert "suite.validation: 4 -> 5 episodes" in said
    assert contents(out) == before
    assert main([*command, "--set", "suite.seed=3", "--replace", "suite"]) == 0
    assert contents(out) != before
    assert main([*command, "--replace", "suite"]) == 0
    assert contents(out) == before


def test_a_suite_of_an_earlier_simulator_stays_in_use_and_says_so(suite, tmp_path, capsys, monkeypatch):
    out = shutil.copytree(suite, tmp_path / "out")
    before, command = contents(out), ["data", "suite", *SMOKE, "--out", str(out), "--set", "datasets=pusher_sand"]
    monkeypatch.setattr(suite_generator, "GENERATOR_VERSION", suite_generator.GENERATOR_VERSION + 1)
    assert main(command) == 0
    assert "made by an earlier version of the simulator" in " ".join(capsys.readouterr().out.split())
    assert contents(out) == before
    (out / "suite").joinpath("nothing").mkdir()  # a missing one is made
    assert main([*command[:-1], "datasets=pusher_sand,rover_road"]) == 0
    assert {k: v for k, v in contents(out).items() if k in before} == before


def test_a_dataset_that_lost_a_shard_is_made_again(suite, tmp_path):
    out = shutil.copytree(suite, tmp_path / "out")
    before = contents(out)
    next((out / "suite").rglob("*.tfrecord-*")).unlink()
    assert main(["data", "suite", *SMOKE, "--out", str(out), "--set", "datasets=pusher_sand"]) == 0
    assert contents(out) == before


# --- Words -------------------------------------------------------------------------------------


def test_differences_of_many_datasets_are_one_line():
    names = [f"robot_{i}" for i in range(50)]
    assert dataset_differences(names, names) == []
    assert dataset_differences(names, names[::-1]) == ["datasets: 50 -> 50, in another order"]
    (line,) = dataset_differences(names, [*names[5:], "new"])
    assert line == "datasets: 50 -> 46, without robot_0, robot_1, robot_2 and 2 more and with new"
    both = {"origin": "trained here", "datasets": names, "data": {n: {"shards": n} for n in names}, "x": {"y": 1}}
    other = both | {"datasets": names[1:], "data": {n: {"shards": "other"} for n in names[49:]}, "x": {"y": 2}}
    assert differences(both, other) == [
        "x.y: 1 -> 2", "datasets: 50 -> 49, without robot_0", "data of robot_49.shards: 'robot_49' -> 'other'",
    ]  # fmt: skip


def test_windows_are_told_apart_by_the_settings_that_were_asked_for():
    """A shorter prompt leaves more windows in short episodes; their number is no setting of the user."""

    def frozen(count: int, settings: ChoiceSettings | None) -> EvalManifest:
        return EvalManifest(
            6, 0, 6, "tokens", (DatasetWindows("arm", tuple((i, 0) for i in range(count))),), settings=settings
        )

    shorter = frozen(6, ChoiceSettings(8, 2))
    assert _differences(frozen(4, ChoiceSettings(8, 4)), shorter) == ["eval.prompt_frames: 4 -> 2"]
    assert _differences(frozen(4, ChoiceSettings(4, 2)), shorter) == ["eval.windows_per_dataset: 4 -> 8"]
    (line,) = _differences(frozen(4, ChoiceSettings(8, 2)), shorter)
    assert "as of another version" in line


def test_to_replace_a_step_is_to_replace_what_is_made_of_it():
    allowed = {asked: [step for step in STEPS if may_replace(step, asked)] for asked in STEPS}
    assert allowed == {step: list(STEPS[i:]) for i, step in enumerate(STEPS)}
    assert not any(may_replace(step, None) for step in STEPS)


def test_the_stamp_holds_the_inputs(made):
    stamp = json.loads((made[0] / "tokenizer" / STAMP).read_text())
    assert stamp["inputs"]["tokenizer_train"]["steps"] == 5
    assert stamp["inputs"]["datasets"] == [ARM.name, "dlr_edan_shared_control_converted_externally_to_rlds"]
    assert stamp["inputs"]["tau"] == 3.0 and set(stamp["recorded"]) == {"code"} and "commit" in stamp["machine"]
    assert stamp["inputs"]["data"][ARM.name]["image_key"] == ARM.image_key
    assert BASE.name not in stamp["inputs"]["data"]
