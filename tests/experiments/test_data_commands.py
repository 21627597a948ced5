"""`hma data convert`, `export` and `import-tokens` from the command line."""

from __future__ import annotations

import json

import pytest

from data_pipelines.registry import DatasetSpec
from data_pipelines.registry import table as registry_table
from data_pipelines.registry.toml_file import to_toml
from data_pipelines.tokens.store import TokenStore
from experiments.cli.main import main
from tests.data_pipelines.convert.sources import hand, write_epic, write_lerobot, write_robomimic
from tests.data_pipelines.fakes import make_spec, write_rlds
from tests.data_pipelines.tokens.test_import_tokens import write_folder


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    monkeypatch.setattr(registry_table, "_registered", {})


FORMATS = ("robomimic", "lerobot", "epic-kitchens", "ego4d", "egoexo4d")


@pytest.mark.parametrize("command", ["convert", *(f"convert {f}" for f in FORMATS), "export", "import-tokens"])
def test_help_of_every_command(command, capsys):
    with pytest.raises(SystemExit) as end:
        main(["data", *command.split(), "--help"])
    assert end.value.code == 0 and "usage: hma data" in capsys.readouterr().out


def said(capsys) -> str:
    return capsys.readouterr().out


def test_a_conversion_says_what_it_wrote_the_entry_and_what_is_next(tmp_path, capsys):
    path = write_robomimic(tmp_path / "image.hdf5")
    command = [
        "data",
        "convert",
        "robomimic",
        str(path),
        "--out",
        str(tmp_path / "rlds"),
        "--camera",
        "agentview",
    ]
    assert main(command) == 0
    out = said(capsys)
    assert "3 episodes at 20 Hz in 1 shards" in out
    assert (
        '["robomimic_lift"]\nimage_key = "observation/agentview"\naction_keys = ["action"]\naction_dims = [7]\nhz = 20.0'
    ) in out
    assert "`--entry FILE.toml`" in out and "--registry" in out
    assert f"wrote {tmp_path}/rlds/robomimic_lift/1.0.0" in out
    assert f"next: hma data inspect {tmp_path}/rlds/robomimic_lift/1.0.0\n" in out
    assert main(command) == 0 and "3 episodes" in said(capsys)  # found done


def test_an_export_says_what_it_wrote_and_what_is_lacking(tmp_path, capsys):
    place = write_rlds(tmp_path, make_spec("toy"), [3, 4])
    command = ["data", "export", str(place), "--out", str(tmp_path / "new")]
    assert main(command) == 2 and "its files do not say how many frames a second it has" in capsys.readouterr().err
    assert main([*command, "--hz", "4"]) == 0
    out = said(capsys)
    assert "2 episodes, 7 frames at 4 Hz" in out and "action: 3 values of action" in out
    assert "note: there is no observation.state" in out and f"next: hma data inspect {tmp_path}/new\n" in out
    assert main(["data", "inspect", str(tmp_path / "new"), "--out", str(tmp_path / "seen")]) == 0
    assert main([*command, "--hz", "5"]) == 2 and "with other settings" in capsys.readouterr().err
    assert main([*command, "--hz", "0"]) == 2 and "--hz must be positive and finite" in capsys.readouterr().err


def test_an_export_is_at_the_rate_of_the_registry_entry(tmp_path, capsys):
    """By which the dataset is viewed and tokenised too; the rate of its files was taken without a word."""
    place, entry = write_robomimic(tmp_path / "image.hdf5"), tmp_path / "mine.toml"
    entry.write_text(to_toml(DatasetSpec("robomimic_lift", "observation/agentview", ("action",), (7,), 15)))
    command = ["data", "export", str(place), "--registry", str(entry), "--out", str(tmp_path / "new")]
    assert main(command) == 0
    out = said(capsys)
    assert (
        "note: its files say 20 Hz, but its registry entry 15 Hz, which is used" in out and "16 frames at 15 Hz" in out
    )
    assert json.loads((tmp_path / "new" / "meta" / "info.json").read_text())["fps"] == 15


def test_an_export_leaves_out_as_many_damaged_episodes_as_there_are(tmp_path, capsys):
    def change(e: int, features: dict) -> None:
        features["steps/observation/image"] = [b"no image"] * 2 if e else features["steps/observation/image"]

    place = write_rlds(tmp_path, make_spec("toy"), [2] * 20, change=change)
    assert main(["data", "export", str(place), "--out", str(tmp_path / "new"), "--hz", "4", "--skip-damaged"]) == 0
    assert "1 episode, 2 frames at 4 Hz\nleft out 19 damaged episodes" in said(capsys)


def test_the_entry_can_be_pasted_and_reads_the_dataset(tmp_path, capsys):
    from data_pipelines.registry.toml_file import load_entries
    from data_pipelines.sources.rlds.dataset import RldsDataset

    root = write_lerobot(tmp_path / "My Robot", "v3.0")
    assert main(["data", "convert", "lerobot", str(root), "--out", str(tmp_path)]) == 0
    table = said(capsys).partition("with --registry:\n")[2].partition("\n\n")[0]
    (tmp_path / "my.toml").write_text(table)
    (spec,) = load_entries(tmp_path / "my.toml")
    assert (spec.name, spec.hz) == ("my_robot", 10)
    RldsDataset(tmp_path / "my_robot").check_keys(spec.image_key, spec.action_keys, spec.action_dims)


def test_a_conversion_from_the_cache_of_hugging_face_is_called_by_the_repository(tmp_path, capsys):
    """As the same folder is called where it is read in place; it was called by its revision."""
    root = write_lerobot(tmp_path / "datasets--lab--pour-cup" / "snapshots" / "0a1b2c3d", "v3.0")
    assert main(["data", "convert", "lerobot", str(root), "--out", str(tmp_path)]) == 0
    assert f"wrote {tmp_path}/pour_cup/1.0.0" in said(capsys)


def test_episodes_that_the_meta_folder_has_lost_are_left_out_on_request(tmp_path, capsys):
    root = write_lerobot(tmp_path / "arm", "v2.1", lengths=(12, 9, 7))
    path = root / "meta" / "episodes.jsonl"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[::2]))
    command = ["data", "convert", "lerobot", str(root), "--out", str(tmp_path)]
    assert main(command) == 1
    error = capsys.readouterr().err
    assert "store.corrupt=skip (`hma data convert`: --skip-damaged)" in error and "what is held out" in error
    assert main([*command, "--skip-damaged"]) == 0
    out = said(capsys)
    assert "2 episodes at 10 Hz" in out and "left out 1 x: " in out and "total_episodes in info.json is 3." in out
    assert "--skip-damaged" not in out
    (metadata,) = tmp_path.glob("*/1.0.0/metadata.json")
    assert list(json.loads(metadata.read_text())["left_out"].values()) == [1]


def test_what_is_left_out_is_told(tmp_path, capsys):
    hands = [hand(0, 0.2, 0.5), hand(1, 0.7, 0.5)]
    frames, detections = write_epic(tmp_path, "P01_01", [hands] * 31 + [[]] * 12 + [hands] * 12)
    command = ["data", "convert", "epic-kitchens", str(frames), "--detections", str(detections)]
    assert main([*command, "--out", str(tmp_path), "--min-frames", "4"]) == 0
    out = said(capsys)
    assert "1 episodes at 10 Hz" in out and "left out 1 x: fewer than 4 frames in a row" in out


def test_pictures_that_are_no_cameras_are_told(tmp_path, capsys):
    root = write_lerobot(tmp_path / "arm", "v2.1", camera="image")
    info = json.loads((root / "meta/info.json").read_text())
    info["features"]["observation.images.ir"] = {"dtype": "image", "shape": [8, 8, 1]}
    (root / "meta/info.json").write_text(json.dumps(info))
    assert main(["data", "convert", "lerobot", str(root), "--out", str(tmp_path)]) == 0
    assert "not used as cameras: observation/ir; docs/own_data.md says what is a camera" in said(capsys)


def test_who_meets_a_damaged_file_is_told_what_this_command_has(tmp_path, capsys):
    root = write_lerobot(tmp_path / "arm", "v2.1")
    video = next(root.rglob("episode_000001.mp4"))
    video.write_bytes(b"no video")
    command = ["data", "convert", "lerobot", str(root), "--out", str(tmp_path)]
    assert main(command) == 1
    error = capsys.readouterr().err
    assert f"error: {video}: not a readable video" in error and "--set" not in error and "corrupt=" not in error
    assert error.endswith(". Download the file again, or add --skip-damaged to leave it out.\n")
    assert main([*command, "--skip-damaged"]) == 0
    out = said(capsys)
    assert f"left out 1 x: {video}: not a readable video" in out and "--skip-damaged" not in out
    next(root.rglob("episode_000000.mp4")).write_bytes(b"no video")
    assert main([*command, "--skip-damaged", "--name", "none"]) == 1
    error = capsys.readouterr().err
    assert "error: LeRobot dataset arm (v2.1), 10 Hz: no episode can be made from it: 1 x " in error
    assert error.endswith(").\n") and ".;" not in error and ".:" not in error


@pytest.mark.parametrize(
    "arguments, code, message",
    [
        (["convert", "robomimic", "{there}/no.hdf5", "--out", "{there}"], 1, "not a readable HDF5 file"),
        (["convert", "lerobot", "{there}", "--out", "{there}"], 1, "give the root of a LeRobot dataset"),
        (
            ["convert", "ego4d", "{there}/a.json", "--videos", "{there}", "--out", "{there}"],
            1,
            "cannot be read",
        ),
        (
            ["convert", "egoexo4d", "{there}", "--out", "{there}", "--min-frames", "1"],
            2,
            "min_frames must be at least 2",
        ),
        (["convert", "lerobot", "{there}/image.hdf5", "--out", "{there}"], 1, "info.json"),
        (
            ["convert", "robomimic", "{there}/image.hdf5", "--out", "{there}", "--camera", "x"],
            2,
            "no camera 'x'",
        ),
        (
            ["convert", "robomimic", "{there}/image.hdf5", "--out", "{there}", "--name", "A-b"],
            2,
            "'A-b' cannot be",
        ),
        (["import-tokens", "{there}/x_train", "--store", "{there}/s"], 2, "no such folder"),
    ],
)
def test_a_mistake_is_one_message_and_an_exit_code(tmp_path, capsys, arguments, code, message):
    write_robomimic(tmp_path / "image.hdf5")
    assert main(["data", *(a.format(there=tmp_path) for a in arguments)]) == code
    error = capsys.readouterr().err
    assert error.startswith("error: ") and "Traceback" not in error and message in error


def test_token_folders_are_imported_in_pairs(tmp_path, capsys):
    for split in ("train", "val"):
        write_folder(tmp_path / f"arm_magvit_max1000000_{split}")
        write_folder(tmp_path / f"leg_vae_max1000000_{split}", latents=True, name="toy_leg")
    folders = [str(tmp_path / f"{name}_max1000000_train") for name in ("arm_magvit", "leg_vae")]
    assert main(["data", "import-tokens", *folders, "--store", str(tmp_path / "store"), "--hz", "4"]) == 0
    out = said(capsys)
    assert "toy_arm: 3 + 3 episodes, 16 tokens per frame, ids of 262,144, by magvit magvit2.ckpt" in out
    assert "toy_leg: 3 + 3 episodes, 4 tokens per frame, latents of 16 values" in out
    assert "note: without --tokenizer" in out and f"next: train on {tmp_path}/store with the program of docs/" in out
    assert TokenStore(tmp_path / "store").names == ("toy_arm", "toy_leg")
    assert main(["data", "import-tokens", *folders, "--store", str(tmp_path), "--name", "x", "--hz", "4"]) == 2
    assert "--name can be given for one dataset, not for 2" in capsys.readouterr().err
