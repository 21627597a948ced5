"""A printed command asks for exactly what the user asked for: parsed again, it gives an equal StudySetup."""

import dataclasses
import itertools
import os
import re
import shlex
from pathlib import Path

import pytest

from data_pipelines.registry import get_mixture, get_spec
from experiments import run_study, study_setup
from experiments.cli import evaluate, tokenize, tokenizer, train
from experiments.cli.main import main
from experiments.running.workspace import Record, save_record
from experiments.study_setup import StudyArguments, StudySetup, make_setup
from experiments.terminal.command_line import Commands
from tests.data_pipelines.fakes import make_spec, write_rlds
from tests.experiments.fakes import PROVENANCE
from tests.experiments.idle import idle_training  # noqa: F401

ARM = get_spec("berkeley_gnm_cory_hall")
ENTRIES = """["my_robot"]
image_key = "observation/image"
action_keys = ["action"]
action_dims = [3]
hz = 4.0
"""


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    """A working directory with data, entries and a tokenizer, some under names that a shell takes apart."""
    root = tmp_path_factory.mktemp("a place; with $pace")
    write_rlds(root / "it's data", make_spec("my_robot", (3,)), [10] * 4)
    write_rlds(root / "bridge", ARM, [10] * 4)
    for name in get_mixture("dataset5"):
        (root / "openx" / name).mkdir(parents=True)
    (root / "my entries.toml").write_text(ENTRIES)
    assert main(["tokenizer", "pixels", "--out", str(root / "-tok"), "--image-size", "16", "--patch", "4"]) == 0
    return root


# Values besides the default, for every field; a field without any fails the test below.
SAMPLES = {
    "preset": ["smoke-continuous"],
    "out": [Path("runs/of mine"), Path("/tmp/x y/*"), Path("-out")],
    "data": [("bridge/berkeley_gnm_cory_hall",), ("it's data/my_robot", "bridge/berkeley_gnm_cory_hall/1.0.0")],
    "registry": [Path("my entries.toml")],
    "mixture": ["dataset5"],
    "tokenizer": [Path("-tok")],
    "set": [
        ("train.steps=7",),
        ("widths=[8, 16]", "datasets=", 'model.diffusion={"channels": 8, "patch": 1}', "store.corrupt=skip"),
        ("execution.dtype=bfloat16", "eval.decode.sampler.temperature=-0.0", "tau=1e1"),
    ],
    "mesh": [(-1, 1, 1), (2, -1, 4)],
}


def test_every_field_has_a_sample():
    assert set(SAMPLES) == {field.name for field in dataclasses.fields(StudyArguments)}


def combinations() -> list[StudyArguments]:
    """Every value alone, every pair of values of two fields, and all fields at once."""
    found = {}
    for names in itertools.chain(((n,) for n in SAMPLES), itertools.combinations(SAMPLES, 2), [tuple(SAMPLES)]):
        for values in itertools.product(*(SAMPLES[n] for n in names)):
            found[repr((names, values))] = StudyArguments(**{"preset": "smoke"} | dict(zip(names, values, strict=True)))
    return list(found.values())


def asked_by(command: str, monkeypatch) -> StudySetup:
    """The StudySetup that a command works on, from its text, through a shell's words and the real parser."""
    seen = []
    for module, name in ((run_study, "run_study"), (tokenize, "prepare_together"), (train, "train_model"),
                         (evaluate, "evaluate_model"), (tokenizer, "train_tokenizer")):  # fmt: skip
        where = 0
        monkeypatch.setattr(module, name, lambda *args, where=where, **_: seen.append(args[where]))
    program, *words = shlex.split(command)
    assert program == "hma" and main(words) == 0, command
    (setup,) = seen
    return setup


@pytest.fixture
def anything_goes(monkeypatch):
    """Some combinations make no study (a mixture of data that is not there); what is tested is what is asked."""

    def study_of(where: StudyArguments) -> StudySetup:
        arguments = where.anywhere()
        study = study_setup.get_preset(arguments.preset)
        return StudySetup(arguments, study, (), study_setup.Workspace(arguments.out), study.trajectory_counts)

    for module in ("study", "tokenize", "train", "evaluate", "tokenizer"):
        monkeypatch.setattr(f"experiments.cli.{module}.make_setup", study_of)
    return study_of


def test_a_printed_command_asks_for_the_same_again(world, monkeypatch, anything_goes):
    monkeypatch.chdir(world)
    alone = Commands()  # parsers of all commands take longer than all else here
    alone.command(name="tokenize")(tokenize.tokenize)
    monkeypatch.setattr("experiments.cli.main.app", alone)
    cases = combinations()
    assert len(cases) > 100
    for where in cases:
        setup = anything_goes(where)
        assert asked_by(setup.command("tokenize"), monkeypatch) == setup, where


@pytest.mark.parametrize(
    "where",
    [
        StudyArguments("smoke"),
        StudyArguments(
            "smoke", Path("out"), (f"bridge/{ARM.name}",), set=("train.steps=7", "widths=[8, 16]"), mesh=(-1, 1, 1)
        ),
        StudyArguments(
            "smoke-continuous", None, ("it's data/my_robot",), Path("my entries.toml"), tokenizer=Path("-tok")
        ),
        StudyArguments("paper", Path("/tmp/x y"), ("openx",), mixture="dataset5", set=("seeds=0,1",)),
    ],
)
def test_the_study_is_the_same_too(where, world, monkeypatch):
    monkeypatch.chdir(world)
    monkeypatch.setattr("data_pipelines.registry.table._registered", {})
    setup = make_setup(where)
    for name in ("tokenize", "train", "study", "sweep width", "tokenizer train"):
        assert asked_by(setup.command(name), monkeypatch) == setup
    assert asked_by(setup.command("evaluate", Path("-run").absolute()), monkeypatch) == setup


def test_a_study_goes_on_with_points_that_earlier_versions_planned(world, monkeypatch, tmp_path):
    """It was refused as another study, since caps that no dataset reaches in training came to count as equal."""
    monkeypatch.chdir(world)
    for module in ("study", "study_setup"):
        monkeypatch.setattr(f"experiments.{module}.most_trajectories", lambda *_: 100)
    where = StudyArguments("accelerator", tmp_path, (f"bridge/{ARM.name}",))
    setup = make_setup(where)
    caps = setup.study.trajectory_counts
    for earlier, counts in (((10, 30, 100, 1000), (10, 30, 100, 1000)), ((10, 20, 30, 1000), caps), ((10, 30), caps)):
        study = dataclasses.replace(setup.study, trajectory_counts=earlier)
        save_record(setup.workspace, Record(study, provenance=PROVENANCE))
        assert make_setup(where).study.trajectory_counts == counts
    setup.workspace.record.write_text("damaged")
    assert make_setup(where).study.trajectory_counts == caps == (10, 30, 1000)


def test_a_file_in_place_of_the_directory_is_named_with_data_too(world, monkeypatch, capsys, tmp_path):
    """Its study.json was looked for, and that it is no directory read as a failure of the disk."""
    monkeypatch.chdir(world)
    (tmp_path / "taken").touch()
    command = ["--preset", "smoke", "--data", f"bridge/{ARM.name}", "--out", str(tmp_path / "taken")]
    assert main(["tokenize", *command]) == 2 and "is a file" in " ".join(capsys.readouterr().err.split())


def test_a_command_means_the_same_in_another_directory(world, monkeypatch, tmp_path):
    monkeypatch.chdir(world)
    setup = make_setup(StudyArguments("smoke", Path("out"), (f"bridge/{ARM.name}",), tokenizer=None))
    monkeypatch.chdir(tmp_path)
    assert asked_by(setup.command("train"), monkeypatch) == setup
    assert str(world) in setup.command("train")


def test_every_step_prints_a_next_one_that_drops_nothing(world, monkeypatch, capsys):
    """From the first command to the last only by what is printed; every one of them dropped --set."""
    monkeypatch.chdir(world)
    where = ["--preset", "smoke", "--out", "by hand", "--set", "dataset_counts=1", "--set", "train.steps=2"]
    words, ran = ["data", "suite", *where], []
    while words[0] != "evaluate":
        ran.append(words)
        assert main(words) == 0
        (command,) = re.findall(r"^next: (.*)$", capsys.readouterr().out, re.MULTILINE)
        words = shlex.split(command)[1:]
        assert words[-len(where) :] == where
    assert [w[: -len(where)] for w in ran] == [["data", "suite"], ["tokenizer", "train"], ["tokenize"], ["train"]]
    assert words[: -len(where)] == ["evaluate", os.path.join("by hand", "model")]
    assert len((world / "by hand" / "model" / "metrics.jsonl").read_text().splitlines()) == 2
