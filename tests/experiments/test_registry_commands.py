"""`hma data list` and `hma data inspect`, and entries that live outside the project."""

from __future__ import annotations

import errno
import json
import os
import shlex
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from data_pipelines.inspection.inspect import CameraFacts, ExampleEpisode
from data_pipelines.registry import get_spec, known_groups, toml_file
from data_pipelines.registry import table as registry_table
from data_pipelines.registry.toml_file import to_toml
from experiments import run_study
from experiments.cli.data import next_command
from experiments.cli.data import registry as registry_commands
from experiments.cli.data.contact_sheet import TILE, draw_sheet
from experiments.cli.data.registry import _write_entry
from experiments.cli.main import main
from experiments.running.launchers.registry import LauncherOptions
from experiments.running.workspace import Workspace, load_record
from experiments.study_setup import StudyArguments, StudySetup, find_directories, make_setup, use_entries
from experiments.sweeps.registry import plan_sweeps
from hma_jax.config import ConfigError
from tests.data_pipelines.fakes import REAL_DATA, make_spec, png, write_rlds
from tests.experiments.fakes import PROVENANCE, STUDY


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(registry_table, "_registered", {})
    monkeypatch.setattr("experiments.preparing.tokenizer.QUALITY_FRAMES", 8)


@pytest.fixture
def robot(tmp_path):
    """A dataset that the registry does not know, with a termination flag and pictures of noise."""
    rng = np.random.default_rng(0)

    def change(episode, features):
        features["steps/action"][-1, 3] = 1
        images = features["steps/observation/image"]
        images[:] = [png(rng.integers(0, 256, (8, 8, 3), np.uint8)) for _ in images]

    return write_rlds(tmp_path / "data", make_spec("my_robot", (4,)), [12, 13, 14, 15], change=change)


def test_list_is_filtered_by_words_and_mixture(capsys):
    assert main(["data", "list", "google", "robot"]) == 0
    said = capsys.readouterr().out
    assert "bc_z" in said and "fractal20220817_data" in said and "droid" not in said
    assert main(["data", "list", "--mixture", "dataset5"]) == 0
    assert "5 entries" in capsys.readouterr().out
    assert main(["data", "list", "open-x", "wrist"]) == 0
    assert "berkeley_mvp" in capsys.readouterr().out
    assert main(["data", "list", "no_such_word"]) == 2


@pytest.mark.parametrize("width", [60, 80, 110, 160])
def test_names_in_a_list_are_whole_at_any_width(width, monkeypatch, capsys):
    """They are names of directories. At 80 columns "fractal20220817_da" and "ta" stood in two lines."""
    monkeypatch.setattr(registry_commands.console, "width", width)
    assert main(["data", "list", "open-x"]) == 0
    said = capsys.readouterr().out
    assert not [line for line in said.splitlines() if len(line.rstrip()) > max(width, 70)]
    words = set(said.split())
    assert not [spec.name for spec in known_groups()["Open-X (Open X-Embodiment)"] if spec.name not in words]


def test_an_entry_that_a_file_has_already_is_left_with_its_comments(robot, tmp_path, capsys):
    file = tmp_path / "my.toml"
    asked = ["data", "inspect", str(robot), "--hz", "4", "--entry", str(file), "--out", str(tmp_path)]
    assert main(asked) == 0
    assert f"wrote {file}" in capsys.readouterr().out
    file.write_text(text := file.read_text().replace("hz = 4", "# as the driver says\nhz = 4"))
    assert main(asked) == 0
    said = capsys.readouterr().out
    assert f"unchanged: {file} has this entry of my_robot" in said and f"wrote {file}" not in said
    assert file.read_text() == text
    file.write_text(text + 'image_corrections = ["rotate_180"]\n')
    assert main(asked) == 0
    assert "this replaced the file's entry of my_robot (old -> new): image_corrections" in capsys.readouterr().out


def test_unknown_dataset_goes_from_inspection_to_training_data(robot, tmp_path, capsys):
    """Inspect, one entry, tokenise: nothing else is needed for a dataset nobody knew."""
    entries, sheets = str(tmp_path / "entries" / "my.toml"), str(tmp_path / "sheets")
    assert main(["data", "inspect", str(robot), "--hz", "4", "--entry", entries, "--out", sheets]) == 0
    said = capsys.readouterr().out
    assert "not in the registry" in said and 'action_keys = ["action[:3]"]\n' in said
    assert Image.open(tmp_path / "sheets" / "contact_sheet.png").height > 4 * TILE
    out = str(tmp_path / "out")
    common = ["--preset", "smoke", "--out", out, "--data", str(robot), "--set", "model.frames=4"]
    assert main(["tokenize", *common]) == 2
    assert main(["study", *common, "--registry", entries, "--dry-run"]) == 0
    plan = " ".join(capsys.readouterr().out.split())
    assert "to prepare (the tokenizer" in plan and "not counted" not in plan
    assert main(["tokenize", *common, "--registry", entries]) == 0
    manifest = json.loads((tmp_path / "out" / "tokens" / "my_robot" / "manifest.json").read_text())
    assert manifest["spec"]["action_keys"] == ["action[:3]"] and len(manifest["action_mean"]) == 3
    assert f"--registry {entries}" in capsys.readouterr().out


def test_the_rate_that_the_files_say_is_written_and_another_one_told(robot, tmp_path, capsys):
    """As of what was generated at 5 / 3 Hz; the command printed --hz 1.66667 before."""
    (robot / "metadata.json").write_text(json.dumps({"generated": True, "hz": 5 / 3}))
    file = tmp_path / "my.toml"
    asked = ["data", "inspect", str(robot), "--entry", str(file), "--out", str(tmp_path)]
    for more, hz, told in ((), 5 / 3, False), (("--hz", "1.66667"), 1.66667, False), (("--hz", "4"), 4, True):
        assert main([*asked, *more]) == 0
        said = capsys.readouterr().out
        assert toml_file.load_entries(file)[0].hz == hz
        assert ("note: --hz 4 is used, although the dataset's own files say 1.66667 Hz" in said) == told
        assert ("although its files say" in said) == told


def test_inspection_ends_with_the_whole_command_that_reads_the_dataset(robot, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ["--hz", "4", "--entry", "my entries.toml", "--frames", "3", "--out", "sheets"]
    assert main(["data", "inspect", "data/my_robot", *arguments]) == 0
    said = capsys.readouterr().out
    directory = tmp_path / "data" / "my_robot" / "1.0.0"
    *_, here, there = said.splitlines()
    for line, when, preset in ((here, "next", "cpu"), (there, "or, on a GPU or TPU", "accelerator")):
        assert line == (
            f"{when}: hma tokenize --preset {preset} --out runs/{preset} --data {directory} --registry 'my entries.toml' "
            "--set model.frames=3 --set eval.prompt_frames=1"
        )
    tokenise = shlex.split(here.removeprefix("next: hma "))
    small = ["--set", "tokenizer_train.steps=1", "--set", "store.min_val=2"]
    assert main([*tokenise, *small]) == 0
    write_rlds(tmp_path / "data", make_spec("another_robot"), [12] * 4)
    for name, out in (("my_robot", "runs/cpu"), ("another_robot", "runs/cpu_another_robot")):  # runs/cpu is taken
        assert main(["data", "inspect", f"data/{name}", *arguments]) == 0
        assert f"next: hma tokenize --preset cpu --out {out} --data " in capsys.readouterr().out


@pytest.mark.parametrize("damage", ["ragged", "not finite"])
@pytest.mark.parametrize("damaged, limit", [(1, ""), (17, " --set store.max_skipped=17")])
def test_inspection_of_damaged_data_ends_with_a_command_that_leaves_the_damage_out(
    damaged, limit, damage, tmp_path, capsys
):
    def change(episode, features):
        if episode < damaged and damage == "ragged":
            features["steps/action"] = features["steps/action"][:-1]
        elif episode < damaged:
            features["steps/action"][7] = np.nan

    data = write_rlds(tmp_path, make_spec("my_robot"), [12] * (damaged + 3), change=change)
    words = ["--hz", "4", "--entry", f"{tmp_path}/my.toml", "--out", f"{tmp_path}/sheet"]
    assert main(["data", "inspect", str(data), *words]) == 0
    for line in capsys.readouterr().out.splitlines()[-2:]:
        assert "hma tokenize" in line and line.endswith(f" --set store.corrupt=skip{limit}")


def test_what_was_not_read_may_be_damaged_as_often_as_what_was(tmp_path, capsys):
    """Twice as often, since this is a sample. The command named the number of those that were read."""

    def change(episode, features):
        if episode % 4 == 0:
            features["steps/action"][7] = np.nan

    data = write_rlds(tmp_path, make_spec("my_robot"), [12] * 80, change=change)
    words = ["--hz", "4", "--entry", f"{tmp_path}/my.toml", "--out", f"{tmp_path}/sheet"]
    assert main(["data", "inspect", str(data), *words]) == 0
    share = float(capsys.readouterr().out.splitlines()[-1].rpartition(" --set store.max_skipped=")[2])
    assert 20 / 80 < share < 1


def test_episodes_without_frames_of_the_camera_in_use_are_left_out_by_the_command():
    key, fine = get_spec("bridge").image_key, CameraFacts("observation/other", ((8, 8),), 4, 0, still=False)
    for broken, expected in ((replace(fine, key=key, undecodable=2), 2), (replace(fine, undecodable=2), 0)):
        facts = SimpleNamespace(name="bridge", damaged={}, actions=(), cameras=(fine, broken))
        assert next_command._unusable(facts) == expected


def test_inspection_of_episodes_without_a_window_leads_to_every_frame(robot, tmp_path, capsys):
    arguments = ["--hz", "40", "--entry", str(tmp_path / "my.toml"), "--frames", "9", "--out", str(tmp_path)]
    assert main(["data", "inspect", str(robot), *arguments]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "about 0 windows" in said and "hma tokenize" not in said
    assert f"next: hma data view {robot} --stride 1 --registry {tmp_path}/my.toml" in said
    assert "the shortest window at stride 20 needs 40 steps, the longest episode that was read has" in said


def test_inspection_says_that_nothing_is_a_camera_and_not_that_the_rate_is_missing(robot, tmp_path, capsys):
    features = robot / "features.json"
    changed = features.read_text().replace('"dtype": "uint8"', '"dtype": "uint16"')
    assert changed != features.read_text()
    features.write_text(changed)
    arguments = ["--hz", "4", "--out", str(tmp_path)]
    assert main(["data", "inspect", str(robot), *arguments, "--entry", str(tmp_path / "my.toml")]) == 2
    said = capsys.readouterr()
    assert "no entry to write: none of its fields is an image of 8 bits" in said.err and "--hz" not in said.err
    assert "observation/image" in said.out and not (tmp_path / "my.toml").exists()
    assert main(["data", "view", str(robot), "--hz", "4", "--out", str(tmp_path / "view.html")]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "no camera: none of its fields" in said and "note for my_robot: leave it out" in said


def test_a_single_episode_does_not_lead_to_a_command_that_refuses_it(tmp_path, capsys):
    """Nothing of it can be held out: `hma tokenize` of it alone is refused, with a tokenizer too."""
    one = write_rlds(tmp_path / "data", make_spec("lonely", (4,)), [40])
    entries = str(tmp_path / "my.toml")
    assert main(["data", "inspect", str(one), "--hz", "4", "--entry", entries, "--out", str(tmp_path)]) == 0
    inspected = capsys.readouterr().out
    viewed = ["data", "view", str(one), "--registry", entries, "--out", str(tmp_path / "view.html")]
    assert main(viewed) == 0
    for said in (inspected, capsys.readouterr().out):
        assert said.splitlines()[-1].startswith("note: add another dataset")


def test_inspection_of_short_episodes_suggests_a_prompt_that_leaves_a_frame_to_judge(robot, tmp_path, capsys):
    """About fifteen steps at 10 Hz are three frames at 2 Hz, of which the cpu preset's prompt would take four."""
    arguments = ["--hz", "10", "--entry", str(tmp_path / "my.toml"), "--out", str(tmp_path)]
    assert main(["data", "inspect", str(robot), *arguments]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "a full window of 12 frames needs 60 steps, the shortest window 10" in said
    assert "next: hma tokenize" in said and said.endswith("--set eval.prompt_frames=2")


def test_inspection_of_a_known_dataset_takes_the_registry_s_rate(tmp_path, capsys):
    json_file = tmp_path / "facts.json"
    arguments = [str(REAL_DATA), "--out", str(tmp_path), "--json", str(json_file)]
    assert main(["data", "inspect", *arguments]) == 0
    said = capsys.readouterr().out
    assert "rate 5 Hz (registry): stride 3" in said and "this agrees with its contents" in said
    facts = json.loads(json_file.read_text())
    assert facts["episodes"] == 3 and len(facts["actions"][0]["dimensions"]) == 7


def test_inspection_counts_at_the_rate_that_a_study_takes(tmp_path, capsys):
    """An entry's own rate of frames counts; another native rate than the entry's is none that a study would take."""
    entry = replace(get_spec("bridge_dataset"), rate=2.5)
    (tmp_path / "my.toml").write_text(to_toml(entry))
    assert (
        main(["data", "inspect", str(REAL_DATA), "--out", str(tmp_path), "--registry", str(tmp_path / "my.toml")]) == 0
    )
    assert "rate 5 Hz (registry): stride 2, 2.50 Hz" in capsys.readouterr().out
    mine = ["--out", str(tmp_path), "--registry", str(tmp_path / "my.toml")]
    assert main(["data", "inspect", str(REAL_DATA), "--hz", "10", *mine]) == 0
    assert f"--hz 10 --entry {tmp_path / 'my.toml'}" in capsys.readouterr().out
    registry_table._registered.clear()
    for looked in (["inspect", str(REAL_DATA)], ["view", str(REAL_DATA), "--episodes", "2", "--shown", "1"]):
        out = tmp_path / looked[0]
        assert main(["data", *looked, "--hz", "10", "--out", str(out)]) == 0
        said = capsys.readouterr().out
        assert (
            f"hma data inspect {REAL_DATA}/1.0.0 --hz 10 --entry my_robots.toml" in said and "hma tokenize" not in said
        )


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["{robot}", "--entry", "x.toml"], 2, "add --hz"),
        (["{robot}", "--hz", "-3"], 2, "--hz must be positive"),
        (["{robot}", "--hz", "nan"], 2, "--hz must be positive and finite, got nan"),
        (["{robot}/features.json"], 2, "features.json: it is a file, not a directory"),
        (["{robot}", "--frames", "0"], 2, "--frames must be at least 2, got 0"),
        (["{robot}", "--episodes", "0"], 2, "--episodes must be at least 1, got 0"),
        (["{robot}", "--split", "test"], 2, "it has train. Choose one with --split"),
        (["{robot}/none"], 2, "no such directory"),
        (["{robot}/none.hdf5"], 2, "no such directory"),
        (["{robot}/none/unmounted"], 1, "no such directory"),
        (["{robot}", "--registry", "none.toml"], 2, "none.toml: the registry file cannot be read"),
    ],
)
def test_mistakes_are_one_message(arguments, code, message, robot, capsys):
    assert main(["data", "inspect", *(a.format(robot=robot) for a in arguments)]) == code
    said = capsys.readouterr().err
    assert said.startswith("error: ") and message in said


def test_a_rate_that_no_recording_has_is_refused_before_anything_is_read(robot, capsys):
    assert main(["data", "inspect", str(robot), "--hz", "1e300"]) == 2
    told = capsys.readouterr()
    assert "error: a frame of the model would span 5e+299 native frames, at 1e+300 Hz and a rate of 2 Hz" in told.err
    assert not told.out


@pytest.mark.parametrize("command", ["inspect", "view"])
def test_a_rate_that_no_recording_has_is_said_to_be_that_of_the_files_where_it_is(command, robot, tmp_path, capsys):
    """Nobody gave one: `correct hz` was said, and not where."""
    (robot / "metadata.json").write_text(json.dumps({"hz": 1e9}))
    where = tmp_path / "sheets" if command == "inspect" else tmp_path / "page.html"
    asked = ["data", command, str(robot), "--out", str(where)]
    assert main(asked) == 2
    said = capsys.readouterr().err
    assert f"error: {robot}" in said and "say 1e+09 native frames" in said and "hz in metadata.json" in said
    assert main([*asked, "--hz", "4"]) == 0


def test_entry_replaces_one_of_the_same_name_in_its_file(robot, tmp_path, capsys):
    file = tmp_path / "my.toml"
    file.write_text("# what the lab has\n")
    for hz in ("4", "5"):
        arguments = ["--hz", hz, "--entry", str(file), "--out", str(tmp_path)]
        assert main(["data", "inspect", str(robot), *arguments]) == 0
    text = file.read_text()
    assert text.count('["my_robot"]') == 1 and "hz = 5.0" in text and "hz = 4" not in text
    assert text.startswith("# what the lab has\n")
    assert "this replaced the file's entry of my_robot (old -> new): hz: 4.0 -> 5.0\n" in capsys.readouterr().out


def test_a_guess_that_takes_the_place_of_the_project_s_entry_is_told(tmp_path, capsys):
    """The suggestion knows less than the entry: of which arm the angles are, or that the gripper is absolute."""
    own = get_spec("droid_sample")
    data, file = write_rlds(tmp_path, own, [30] * 3), tmp_path / "my.toml"
    words = ["data", "inspect", str(data), "--hz", "5", "--out", str(tmp_path / "sheet")]
    assert main([*words, "--entry", str(file)]) == 0
    (note,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert note.startswith(
        f"note: this takes the place of the project's entry of droid_sample, in commands with --registry {file} (there "
        "-> here): "
    )
    assert "angles: [3, 5] -> []" in note and "episodes" not in note and "note: " not in note[6:]
    assert note.endswith(f"; to keep that, remove it from {file}")
    file.write_text(to_toml(own))
    assert main([*words, "--registry", str(file), "--entry", str(file)]) == 0
    said = capsys.readouterr().out
    assert "this replaced the file's entry of droid_sample" in said and "project's entry" in said
    assert main([*words]) == 0
    assert "note: " not in capsys.readouterr().out


def test_entries_written_at_the_same_moment_are_both_kept(tmp_path, monkeypatch):
    """Each was put into the text as it was before the other."""
    put, names = toml_file.put_entry, ("one", "other")

    def slowly(*arguments) -> str:
        text = put(*arguments)
        time.sleep(0.2)
        return text

    monkeypatch.setattr(toml_file, "put_entry", slowly)
    file = tmp_path / "my.toml"
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda name: _write_entry(file, SimpleNamespace(spec=lambda: make_spec(name))), names))
    assert {entry.name for entry in toml_file.load_entries(file)} == set(names)
    assert [path.name for path in tmp_path.iterdir()] == ["my.toml"]


def test_a_misspelt_heading_of_a_known_dataset_is_told(tmp_path, capsys):
    """A file with an entry too many may be meant: of several datasets, say. That the project's own is used is said."""
    file = tmp_path / "my.toml"
    arguments = [str(REAL_DATA), "--hz", "10", "--out", str(tmp_path)]
    assert main(["data", "inspect", *arguments, "--entry", str(file)]) == 0
    right = file.read_text()
    told = (
        "note: {} has no entry called bridge_dataset: the project's own is used. Its entries that nothing here uses: "
    )
    for entries, noted in (
        (right, False),
        (right + right.replace("bridge_dataset", "another"), False),
        (right.replace("bridge_dataset", "bridge_datset"), True),
    ):
        registry_table._registered.clear()
        file.write_text(entries)
        capsys.readouterr()
        assert main(["data", "inspect", *arguments, "--registry", str(file)]) == 0
        assert (told.format(file) + "bridge_datset" in capsys.readouterr().out) == noted
        make_setup(StudyArguments("smoke", tmp_path, (str(REAL_DATA),), file))
        said = capsys.readouterr().out
        assert (told.format(file) + "bridge_datset" in said) == noted
        assert ('add joins = ["bridge_dataset"] to its entry' in said) == noted


def test_mixture_names_the_datasets_of_a_study(tmp_path, capsys):
    assert make_setup(StudyArguments("paper", tmp_path, mixture="dataset10")).study.dataset_counts == (5, 10)
    assert main(["study", "--preset", "smoke", "--mixture", "dataset5", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "bridge_data_v2, fractal20220817_data, language_table and others: not simulated" in said


def test_mixture_is_looked_for_in_the_given_directories(tmp_path):
    for root, name in (("a", "x"), ("b", "x"), ("b", "y")):
        (tmp_path / root / name).mkdir(parents=True)
    roots = [str(tmp_path / "a"), str(tmp_path / "b")]
    assert find_directories(["x", "y"], roots) == (f"{roots[0]}/x", f"{roots[1]}/y")
    with pytest.raises(ConfigError, match="no directory for z in"):
        find_directories(["x", "z"], roots)


def test_a_full_disk_is_said_of_the_contact_sheet(robot, tmp_path, capsys, monkeypatch):
    def fsync(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def draw(*arguments):
        monkeypatch.setattr(os, "fsync", fsync)  # from here on
        return draw_sheet(*arguments)

    monkeypatch.setattr("experiments.cli.data.contact_sheet.draw_sheet", draw)
    assert main(["data", "inspect", str(robot), "--hz", "4", "--out", str(tmp_path / "sheets")]) != 0
    assert f"error: {tmp_path / 'sheets' / 'contact_sheet.png'}: No space left" in capsys.readouterr().err
    assert not list((tmp_path / "sheets").iterdir())


def test_contact_sheet_shows_every_frame_where_it_says():
    colours = [(255, 0, 0), (0, 255, 0), (0, 0, 255)]
    frames = [np.full((56, 40, 3), c, np.uint8) for c in colours]
    cameras = {"observation/a": frames, "observation/b": frames}
    example = ExampleEpisode(7, 30, True, "push the red thing", (0, 14, 29), cameras, {})
    pixels = np.asarray(draw_sheet("title", [example, example]))
    for colour in colours:  # a tile is 112 x 80: doubled, pixels kept; two cameras, two episodes
        assert (pixels == colour).all(axis=2).sum() == pytest.approx(4 * 112 * 80, rel=0.05)
    columns = [np.flatnonzero((pixels == c).all(axis=2).any(axis=0)).mean() for c in colours]
    assert columns == sorted(columns)


def test_a_study_keeps_the_entries_that_its_axes_are_planned_with(tmp_path, monkeypatch):
    """`hma report` and `hma fit` of such a study ended with: unknown dataset."""
    entries = tmp_path / "my.toml"
    specs = [replace(make_spec(name, (4,)), episodes=count) for name, count in (("mine", 9), ("yours", 30))]
    entries.write_text("\n".join(map(to_toml, specs)))
    for name in ("prepare", "require_judged"):
        module = "pipeline" if name == "prepare" else "windows"
        monkeypatch.setattr(f"experiments.preparing.{module}.{name}", lambda *_, **__: PROVENANCE)
    for name in ("run_jobs", "draw", "require_results"):
        monkeypatch.setattr(run_study, name, lambda *_, **__: {})
    study = replace(
        STUDY, datasets=("mine", "yours"), dataset_counts=(1, 2), trajectory_counts=(40,),
        designs=replace(STUDY.designs, caps=(4, 16)),
    )  # fmt: skip
    arguments = StudyArguments("smoke", tmp_path / "study", registry=entries, data=(tmp_path,))
    use_entries(entries)
    workspace = Workspace(tmp_path / "study")
    workspace.root.mkdir()

    def run(arguments, study, axis, step=None):
        run_study.run_study(
            StudySetup(arguments, study, ("somewhere",), workspace, study.trajectory_counts), (axis,), again="",
            launcher_options=LauncherOptions(), retry_failed=False, accept_code=False, replace=step,
        )  # fmt: skip

    run(arguments, study, "episodes")
    entries.unlink()
    registry_table._registered.clear()
    record = load_record(workspace)
    (sweep,) = plan_sweeps(record.study, record.axes, workspace.root)
    assert {p.x for p in sweep.points} == {8, 23, 35}  # of 9 and 30 trajectories 2 are held out each
    run(replace(arguments, registry=None), replace(study, datasets=("pusher_sand", "rover_road")), "width", "study")
    assert load_record(workspace).axes == ("width",) and not workspace.registry.exists(), "of the study before"


def test_a_run_of_a_study_needs_the_study_s_own_entries_no_second_time(tmp_path):
    """`hma generate RUN --actions DIR` and others knew only the entries of their own --registry."""
    workspace, given = Workspace(tmp_path / "study"), tmp_path / "given.toml"
    workspace.root.mkdir()
    for path, hz in ((workspace.registry, 5.0), (given, 7.0)):
        path.write_text(to_toml(replace(make_spec("mine", (4,)), hz=hz)))
    use_entries(None, workspace.root / "a run")
    assert get_spec("mine").hz == 5
    use_entries(given, workspace.root / "a run")
    assert get_spec("mine").hz == 7, "what is given counts"
    use_entries(None, tmp_path / "elsewhere" / "a run")  # of no study
