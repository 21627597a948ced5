"""`hma data view` from the command line: one page that needs nothing else, and what to run next."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
from PIL import Image

from data_pipelines.registry import table as registry_table
from data_pipelines.registry.toml_file import to_toml
from experiments.cli.main import main
from experiments.report import data_page
from tests.data_pipelines.fakes import REAL_DATA, make_spec, png, write_rlds

SPEC = make_spec("toy", (3,), hz=4)


@pytest.fixture(autouse=True)
def _registry(monkeypatch):
    monkeypatch.setattr(registry_table, "_registered", {})


@pytest.fixture(autouse=True)
def _small_clips(monkeypatch, request):
    """Encoding clips of noise as tall as pages have them takes most of the time of a page."""
    if request.function is not test_page_is_one_file_with_clips_curves_and_statistics:
        monkeypatch.setattr(data_page, "TALL", 16)
        monkeypatch.setattr(data_page, "SMALL", 8)


def change(episode: int, features: dict) -> None:
    random = np.random.default_rng(episode)
    steps = len(features["steps/action"])
    pictures = random.integers(0, 255, (steps, 8, 8, 3)).astype(np.uint8)
    features["steps/observation/image"] = [png(picture) for picture in pictures]
    features["steps/action"][:] = random.normal(size=(steps, 3))
    features["steps/language_instruction"] = [b"<script>alert(1)</script>"] * steps


@pytest.fixture
def toy(tmp_path):
    directory = write_rlds(tmp_path, SPEC, [20, 24, 30, 31], change=change)
    (tmp_path / "my.toml").write_text(to_toml(SPEC))
    return directory, tmp_path / "my.toml"


class Page(HTMLParser):
    """What a page holds, and that its tags close."""

    VOID = {"meta", "img", "input", "text", "line", "rect", "polyline", "br"}

    def __init__(self, text: str):
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag


def test_actions_of_an_entry_may_be_fields_of_any_name(toy, tmp_path, capsys):
    directory, entries = toy
    entries.write_text(to_toml(replace(SPEC, action_keys=("action", "is_last"), action_dims=(3, 1))))
    arguments = ["data", "view", str(directory), "--registry", str(entries), "--out", str(tmp_path / "page.html")]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "does not fit" not in said and "next: hma tokenize" in said
    assert ">is_last<" in (tmp_path / "page.html").read_text()


def test_page_is_one_file_with_clips_curves_and_statistics(toy, tmp_path, capsys):
    directory, entries = toy
    out = tmp_path / "pages/page.html"
    arguments = ["data", "view", str(directory), "--registry", str(entries), "--frames", "4", "--out", str(out)]
    assert main(arguments) == 0
    said, text = capsys.readouterr().out, out.read_text()
    page = Page(text)
    assert not page.open and "script" not in page.tags and "<script>" not in text
    assert all(source.startswith(("data:image/webp", "#")) for source in page.sources)  # nothing is fetched
    clips = [source for source in page.sources if source.startswith("data:")]
    assert len(clips) == 4 * 2 and "clips stand still" in text  # each moves, or stands still
    with Image.open(io.BytesIO(base64.b64decode(clips[0].split(",")[1]))) as image:
        assert image.is_animated and image.n_frames > 10
    assert page.tags.count("polyline") == 4 * 3 and text.count("<svg") == text.count("role=img aria-label=")
    for heading in ("histogram", "mean", "deviation", "1%", "5%", "50%", "95%", "99%", "min", "max"):
        assert re.search(f"<th scope=col(?: class=text)?>{heading}</th>", text)
    assert 'name="viewport"' in text and "overflow-x: auto" in text
    assert "toy: no issues found" in said and f"wrote {out}" in said
    (command,) = re.findall(r"next: (hma tokenize .*)", said)
    assert "--set model.frames=4" in command and "--registry" in command and str(directory) in command


def test_the_camera_in_use_is_shown_as_the_entry_corrects_it(tmp_path, capsys):
    half = np.zeros((8, 8, 3), np.uint8)
    half[:4] = 255

    def draw(_, features):
        features["steps/observation/image"] = [png(half)] * len(features["steps/observation/image"])

    directory, brighter = write_rlds(tmp_path, SPEC, [20], change=draw), {}
    for corrections in ((), ("rotate_180",)):
        (tmp_path / "my.toml").write_text(to_toml(replace(SPEC, image_corrections=corrections)))
        out = tmp_path / "page.html"
        assert main(["data", "view", str(directory), "--registry", str(tmp_path / "my.toml"), "--out", str(out)]) == 0
        text = out.read_text()
        assert ("(turned by 180 degrees)" in text) == bool(corrections)
        clip, _still = (source for source in Page(text).sources if source.startswith("data:"))
        with Image.open(io.BytesIO(base64.b64decode(clip.split(",")[1]))) as image:
            rows = np.asarray(image.convert("L")).mean(1)
        brighter[corrections] = rows[0] > rows[-1]
    assert brighter == {(): True, ("rotate_180",): False}


def test_a_dataset_without_windows_gets_a_command_that_finds_some(toy, tmp_path, capsys):
    directory, entries = toy
    arguments = ["data", "view", str(directory), "--registry", str(entries), "--out", str(tmp_path / "page.html")]
    assert main([*arguments, "--stride", "16"]) == 0
    said = capsys.readouterr().out
    assert "toy: no window: the shortest window at stride 16 needs 32 steps; the longest of 4 episodes has 31" in said
    assert "hma tokenize" not in said
    assert re.search(
        r"next for toy: hma data view \S+ --stride 1 --registry \S+  # the shortest window at stride 16 needs 32 steps",
        said,
    )
    assert main([*arguments, "--stride", "1"]) == 0
    (command,) = re.findall(r"next: (hma tokenize .*)", capsys.readouterr().out)
    assert command.endswith("--set rate=4")  # of every frame


def test_a_rate_of_its_own_is_not_overruled(toy, tmp_path, capsys):
    directory, entries = toy
    entries.write_text(to_toml(replace(SPEC, rate=1.0)))
    arguments = ["data", "view", str(directory), "--registry", str(entries), "--out", str(tmp_path / "page.html")]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "next: hma tokenize" in said and "rate=" not in said
    assert main([*arguments, "--stride", "2"]) == 0
    assert "its entry sets rate = 1 Hz, so a study reads it at stride 4" in capsys.readouterr().out


def test_several_datasets_share_a_page_and_only_those_with_windows_go_on(toy, tmp_path, capsys):
    directory, entries = toy
    short = replace(SPEC, name="short")
    without = write_rlds(tmp_path, short, [3, 2, 3])
    entries.write_text(f"{to_toml(SPEC)}\n{to_toml(short)}")
    out = tmp_path / "page.html"
    arguments = ["data", "view", str(without), str(REAL_DATA), str(directory), "--registry", str(entries)]
    assert main([*arguments, "--frames", "8", "--out", str(out)]) == 0
    said, text = capsys.readouterr().out, out.read_text()
    assert "short: no window" in said and "next for short: hma data view" in said
    (command,) = re.findall(r"next: (hma tokenize .*)", said)
    assert str(directory) in command and str(REAL_DATA) in command and str(without) not in command
    assert text.count("<section") == 4 and "<td><b>0</b></td>" in text


def test_an_unknown_dataset_is_shown_and_its_entry_comes_next(toy, tmp_path, capsys):
    directory, _ = toy
    out = tmp_path / "page.html"
    assert main(["data", "view", str(directory), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "toy: rate unknown" in said
    assert re.search(r"next for toy: hma data inspect \S+ --hz HZ --entry my_robots.toml", said)
    assert main(["data", "view", str(directory), "--out", str(out), "--hz", "4"]) == 0
    assert "--hz 4 --entry" in capsys.readouterr().out and "Not in the registry" in out.read_text()
    others = tmp_path / "others.toml"  # commands take one file of entries, so that they belong together
    others.write_text(to_toml(replace(SPEC, name="other")))
    assert main(["data", "view", str(directory), "--out", str(out), "--hz", "4", "--registry", str(others)]) == 0
    assert f"--hz 4 --entry {others}" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (("--hz", "0"), 2, "--hz must be positive"),
        (("--hz", "inf"), 2, "--hz must be positive and finite, got inf"),
        (("--frames", "1"), 2, "--frames must be at least 2"),
        (("--shown", "9", "--episodes", "3"), 2, "--shown must lie between 1"),
        (("--split", "nonsense"), 2, "no split 'nonsense'"),
    ],
)
def test_a_mistake_is_one_message(toy, tmp_path, capsys, options, code, message):
    assert main(["data", "view", str(toy[0]), "--out", str(tmp_path / "x.html"), *options]) == code
    error = capsys.readouterr().err
    assert error.startswith("error: ") and message in error and not (tmp_path / "x.html").exists()


def test_the_same_page_twice_is_the_same_bytes(toy, tmp_path):
    directory, entries = toy
    out = tmp_path / "page.html"
    pages = []
    for _ in range(2):
        assert main(["data", "view", str(directory), "--registry", str(entries), "--out", str(out)]) == 0
        pages.append(out.read_bytes())
    assert pages[0] == pages[1]


def test_what_was_not_read_is_not_said_to_be_free_of_duplicates(toy, tmp_path, capsys):
    directory, entries = toy
    out, said = tmp_path / "page.html", {}
    for episodes in ("3", "4"):
        options = ("--registry", str(entries), "--out", str(out), "--episodes", episodes, "--shown", "3")
        assert main(["data", "view", str(directory), *options]) == 0
        said[episodes] = capsys.readouterr().out, out.read_text()
    terminal, page = said["3"]
    assert "toy: 3 of 4 episodes were read (--episodes); duplicate recordings are searched only among these" in terminal
    assert "Duplicate recordings are searched only among the episodes that were read." in page
    assert not any("searched only among" in text for text in said["4"])


def test_damage_is_not_laid_to_the_number_of_episodes_asked_for(tmp_path, capsys):
    """Of 2 episodes 1 was read "(--episodes)", where 64 may be and the other has no step."""
    directory = write_rlds(tmp_path, SPEC, [21, 0])
    assert main(["data", "view", str(directory), "--hz", "8", "--out", str(tmp_path / "page.html")]) == 0
    said = capsys.readouterr().out
    assert "toy: cannot be read: 1 of the episodes" in said and "--episodes" not in said


@pytest.mark.parametrize("same", [False, True])
def test_splits_that_are_read_together_are_two_splits_none_of_which_is_another(same, toy, tmp_path, capsys):
    """An entry with split = "train+val": its episodes are not those of train again, but one may lie in both."""
    directory, entries = toy
    other = directory if same else write_rlds(tmp_path / "b", SPEC, [21] * 4, change=lambda e, f: change(e + 9, f))
    shard = "toy-{}.tfrecord-00000-of-00001"
    shutil.copy(other / shard.format("train"), directory / shard.format("val"))
    info = json.loads((directory / "dataset_info.json").read_text())
    info["splits"].append(info["splits"][0] | {"name": "val"})
    (directory / "dataset_info.json").write_text(json.dumps(info))
    entries.write_text(to_toml(replace(SPEC, split="train+val", val_split="val")))
    arguments = ["data", "view", str(directory), "--registry", str(entries), "--out", str(tmp_path / "page.html")]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert ("same episodes in two splits" in said) == same and ("train 3 = val 3" in said) == same
    assert "likely duplicates" not in said
