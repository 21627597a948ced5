"""`hma tokenize` in several processes, and on data in a remote store."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import pytest

from data_pipelines.publishing.output_lock import lock_output
from data_pipelines.registry.toml_file import to_toml
from data_pipelines.sources.joined import Parts
from data_pipelines.sources.rlds.dataset import RldsDataset
from data_pipelines.tokens import part_maker
from experiments.cli import tokenize as cli_tokenize
from experiments.cli.main import main
from experiments.cli.tokenize import MAX_LISTED, show_store
from experiments.preparing import asked, pipeline, sources
from experiments.preparing.asked import write_asked
from experiments.preparing.sources import say_other_versions, say_unreached_rates
from experiments.preparing.store import say_other_rates
from experiments.running.workspace import Workspace
from experiments.study_setup import StudyArguments, make_setup
from experiments.terminal.progress import Eta
from tests.data_pipelines.fakes import FakeTokenizer, write_rlds
from tests.data_pipelines.tokenizing import tokenize_dataset
from tests.experiments.fakes import STUDY
from tests.experiments.idle import ARM, BASE, LENGTHS, SMOKE, idle_training  # noqa: F401
from tests.files import contents


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("rlds")
    return ["--data", *(str(write_rlds(root, spec, LENGTHS)) for spec in (ARM, BASE))]


@pytest.fixture(scope="module")
def tokenizer(data, tmp_path_factory):
    out = tmp_path_factory.mktemp("tokenizer")
    assert main(["tokenizer", "train", *SMOKE, "--out", str(out), *data]) == 0
    return ["--tokenizer", str(out / "tokenizer")]


@pytest.fixture(scope="module")
def whole(data, tokenizer, tmp_path_factory):
    """What one process makes."""
    out = tmp_path_factory.mktemp("whole")
    assert main(["tokenize", *SMOKE, "--out", str(out), *data, *tokenizer, "--batch", "3", "--threads", "1"]) == 0
    return made(out)


@pytest.fixture(autouse=True)
def soon():
    """Most tests hold the directory as another command does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(asked, "WRITTEN_WITHIN", 0.2)
        yield


def made(out: Path) -> dict[str, bytes]:
    files = ("eval_manifest.json", "data.json")
    return contents(out / "tokens") | {name: (out / name).read_bytes() for name in files}


@pytest.mark.slow
def test_two_processes_at_the_same_time_make_one_store_and_its_windows(data, tokenizer, whole, tmp_path):
    command = [sys.executable, "-m", "experiments.cli", "tokenize", *SMOKE, "--out", str(tmp_path), *data, *tokenizer]
    started = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(2)]
    said = [process.communicate(timeout=300)[0] for process in started]
    assert [process.returncode for process in started] == [0, 0], said
    assert made(tmp_path) == whole
    assert all("eval_manifest.json" in text and "held out" in text for text in said)


def test_who_joins_waits_for_the_parts_of_others_and_freezes_if_nobody_else_does(
    data, tokenizer, whole, tmp_path, monkeypatch, capsys
):
    """The last part of one dataset is another process's, which dies; so does the one that held the directory."""
    arguments = ["tokenize", *SMOKE, "--out", str(tmp_path), *data, *tokenizer]
    monkeypatch.setattr(part_maker, "write_part", lambda *_: stop())
    with pytest.raises(Stopped):
        main(arguments)  # it had come to its first part
    monkeypatch.undo()
    (work,) = (tmp_path / "tokens").glob(f".{ARM.name}.????????????")
    part, holder = ExitStack(), ExitStack()
    part.enter_context(lock_output(work.with_name(f"{work.name}.claims") / "00000"))
    holder.enter_context(Workspace(tmp_path).locked())
    with ThreadPoolExecutor(1) as pool:
        joined = pool.submit(main, arguments)
        until = time.monotonic() + 60
        while not (tmp_path / "tokens" / BASE.name).exists():  # it goes on with what is free
            assert time.monotonic() < until and not joined.done()
            time.sleep(0.01)
        time.sleep(0.5)
        assert not joined.done() and not (tmp_path / "tokens" / ARM.name).exists()
        part.close()
        while not (tmp_path / "tokens" / ARM.name).exists():  # now it makes that part
            assert time.monotonic() < until and not joined.done()
            time.sleep(0.01)
        time.sleep(0.5)
        assert not joined.done() and not (tmp_path / "eval_manifest.json").exists()  # the holder may do it
        holder.close()
        assert joined.result(60) == 0
    assert made(tmp_path) == whole
    assert "sharing the work with process" in capsys.readouterr().out


def test_who_joins_leaves_the_windows_to_a_living_holder_that_has_frozen_them(data, tokenizer, tmp_path, capsys):
    arguments = ["tokenize", *SMOKE, "--out", str(tmp_path), *data, *tokenizer, "--set", "rate=50"]
    assert main(arguments) == 0
    assert "note: a rate above that of the recording is not reached" in capsys.readouterr().out
    before = (tmp_path / "eval_manifest.json").stat().st_mtime_ns
    with Workspace(tmp_path).locked():
        assert main(arguments) == 0
    assert (tmp_path / "eval_manifest.json").stat().st_mtime_ns == before


def test_who_joins_needs_a_tokenizer_and_replaces_nothing(data, tokenizer, tmp_path, capsys):
    arguments = ["tokenize", *SMOKE, "--out", str(tmp_path), *data]
    with Workspace(tmp_path).locked():
        assert main(arguments) == 2
        message = capsys.readouterr().err
        assert "no tokenizer yet, and another command is using" in message
        assert f"hma tokenizer train --preset smoke --out {tmp_path} --data {data[1]} {data[2]}" in message
        assert main([*arguments, *tokenizer, "--replace", "tokens"]) == 2
        assert "with --replace no other command may use the directory" in capsys.readouterr().err
    assert not (tmp_path / "tokens").exists()


def test_who_would_make_something_else_does_not_join(data, tokenizer, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(cli_tokenize, "_freeze", lambda *_: stop())  # which would wait for the holder
    arguments = ["tokenize", *SMOKE, "--out", str(tmp_path)]
    shutil.copytree(tokenizer[1], tmp_path / "tokenizer")  # trained on both datasets
    setup = make_setup(StudyArguments("smoke", tmp_path, tuple(data[1:])))
    found = sources.find_sources(setup.study, setup.data)
    with Workspace(tmp_path).locked():
        assert main([*arguments, *data[:2]]) == 2
        told = capsys.readouterr()
        assert f"datasets: 2 -> 1, without {BASE.name}" in told.err.replace("\n", " ")
        assert told.out.count("waiting until ") == 1, "once for a holder that is at another command"
        write_asked(setup.study, setup.workspace, found, None)
        assert main([*arguments, *data, *tokenizer, "--set", "store.min_val=1", "--set", "model.frames=3"]) == 2
        message = capsys.readouterr().err
        assert "cannot be shared" in message and "--tokenizer: 'not given' -> '" in message
        assert "store.min_val: 2 -> 1" in message and "model.frames: " in message
    assert not (tmp_path / "tokens").exists()


def test_who_has_other_recordings_or_entries_of_the_same_names_does_not_join(
    data, tokenizer, tmp_path, capsys, monkeypatch
):
    """Not even while the holder opens its datasets, which takes hours without an index."""
    opening, opened, check = threading.Event(), threading.Event(), asked.check_sources

    def check_slowly(*arguments):
        if not opening.is_set():  # the holder
            opening.set()
            assert opened.wait(60)
        return check(*arguments)

    monkeypatch.setattr(asked, "check_sources", check_slowly)
    monkeypatch.setattr(asked, "WRITTEN_WITHIN", 60.0)
    ended = threading.Event()
    monkeypatch.setattr(pipeline, "adopt_tokenizer", lambda *_: ended.wait(60) and stop())
    monkeypatch.setattr(cli_tokenize, "_freeze", lambda *_: stop())
    other = str(write_rlds(tmp_path / "other", ARM, LENGTHS[::-1]))
    (tmp_path / "my.toml").write_text(to_toml(replace(BASE, hz=BASE.hz + 1)))
    arguments = ["tokenize", *SMOKE, "--out", str(tmp_path), *tokenizer]
    with ThreadPoolExecutor(1) as pool:
        holder = pool.submit(main, [*arguments, *data])
        try:
            assert opening.wait(60)
            assert main([*arguments, *data, "--set", "store.min_val=1"]) == 2
            message = capsys.readouterr().err
            assert "cannot be shared" in message and "store.min_val: 2 -> 1" in message
            threading.Timer(0.5, opened.set).start()
            assert main([*arguments, "--data", other, data[2]]) == 2
            assert f"recordings.{ARM.name}: " in capsys.readouterr().err
            assert main([*arguments, *data, "--registry", str(tmp_path / "my.toml")]) == 2
            assert f"entries.{BASE.name}.hz: {BASE.hz} -> {BASE.hz + 1}" in capsys.readouterr().err
        finally:
            opened.set()
            ended.set()
        assert isinstance(holder.exception(60), Stopped)
    assert not (tmp_path / "tokens").exists()


class Stopped(Exception):
    pass


def stop():
    raise Stopped


def test_remote_data_is_neither_mangled_nor_copied(data, tmp_path, capsys):
    UPath = pytest.importorskip("upath").UPath
    root = UPath("memory://bucket") / ARM.name
    try:
        for path in Path(data[1]).iterdir():
            copy = root / "1.0.0" / path.name
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_bytes(path.read_bytes())
        setup = make_setup(StudyArguments("smoke", tmp_path, (str(root),)))
        assert setup.data == (f"memory://bucket/{ARM.name}",)
        ((spec, directory),) = sources.find_sources(setup.study, setup.data)
        assert spec == ARM and directory == root
        assert main(["tokenize", *SMOKE, "--out", str(tmp_path / "out"), "--data", str(root)]) == 0
        assert f"--data memory://bucket/{ARM.name}" in capsys.readouterr().out.replace("\n", " ")
        assert json.loads((tmp_path / "out/data.json").read_text())[ARM.name]["episodes"] == 5
    finally:
        root.fs.rm("/bucket", recursive=True)


def test_store_of_an_older_format_is_made_again_when_asked_for(data, tmp_path, capsys):
    arguments = ["tokenize", *SMOKE, "--out", str(tmp_path), *data[:2]]
    assert main(arguments) == 0
    before = contents(tmp_path / "tokens")
    manifest = tmp_path / "tokens" / ARM.name / "manifest.json"
    manifest.write_text(json.dumps(json.loads(manifest.read_text()) | {"format": 1}))
    capsys.readouterr()
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "manifest format 1, but only 3 can be read" in said and "--replace tokens" in said
    assert main([*arguments, "--replace", "tokens"]) == 0
    assert contents(tmp_path / "tokens") == before


@pytest.mark.parametrize(("rate", "stride"), [(2.0, "5"), (5.0, "2"), (None, "1")])
def test_the_stride_that_is_told_is_the_studys(rate, stride, tmp_path, capsys):
    spec = replace(ARM, hz=10.0, rate=None)
    tokenize_dataset(spec, write_rlds(tmp_path, spec, LENGTHS), FakeTokenizer(), tmp_path / "tokens", rate=rate)
    show_store(Workspace(tmp_path), rate)
    (line,) = [line for line in capsys.readouterr().out.splitlines() if spec.name in line]
    assert line.split()[-2:] == ["10", stride]


def test_a_rate_above_the_recording_s_is_told(capsys):
    """Every frame is taken then, without a word, and the note names those of which it is true."""
    slow, own, fast = (replace(ARM, name=n, hz=hz) for n, hz in (("slow", 10.0), ("own", 20 / 3), ("fast", 50.0)))
    sources = [(slow, Path("none")), (replace(own, rate=6.66667), Path("none")), (fast, Path("none"))]
    say_unreached_rates(replace(STUDY, rate=50.0), sources)
    assert capsys.readouterr().out == (
        "note: a rate above that of the recording is not reached, every frame is taken: slow (10 Hz, not 50)\n"
    )
    say_unreached_rates(replace(STUDY, rate=None), sources)
    assert not capsys.readouterr().out


def test_a_rate_that_the_files_of_rlds_say_otherwise_than_the_entry_is_told(tmp_path, capsys, monkeypatch):
    """Without looking for the records of all datasets first, which may take hours."""
    rlds = write_rlds(tmp_path, ARM, LENGTHS)
    monkeypatch.setattr(RldsDataset, "__init__", lambda *_, **__: pytest.fail("its records were looked for"))
    for hz in (ARM.hz, ARM.hz / 2):
        (rlds / "metadata.json").write_text(json.dumps({"hz": hz}))
        for place in rlds, Parts(ARM.name, (rlds,)):
            say_other_rates(STUDY, [(ARM, place)])
            said = f"{ARM.name}: its files say {hz:g} Hz, but its registry entry {ARM.hz:g} Hz, which is used"
            assert (said in capsys.readouterr().out) == (hz != ARM.hz)


def test_files_of_another_version_than_the_entry_was_written_for_are_told(tmp_path, capsys):
    """The newest of several is read, and where its fields are the same nothing else tells that it is another."""
    newest = write_rlds(tmp_path, ARM, LENGTHS)
    older = shutil.copytree(newest, newest.parent / "0.1.0")
    info = json.loads((older / "dataset_info.json").read_text())
    (older / "dataset_info.json").write_text(json.dumps(info | {"version": "0.1.0"}))
    entry = replace(ARM, version="0.1.0")
    for place in newest.parent, Parts(ARM.name, (newest,)):
        say_other_versions([(entry, place)])
        assert f"{ARM.name} (files 1.0.0, entry 0.1.0)" in capsys.readouterr().out
    say_other_versions([(entry, older), (replace(ARM, version=""), newest), (replace(ARM, version="1.0.0"), newest)])
    assert not capsys.readouterr().out


def test_of_many_losses_some_are_named(tmp_path, capsys):
    """Every shard that is missing is one, where a dataset of hundreds was fetched in part."""
    rlds = write_rlds(tmp_path, ARM, [12] * 60, shards=20)
    for shard in sorted(rlds.glob("*tfrecord*"))[8:]:
        shard.unlink()
    tokenize_dataset(ARM, rlds, FakeTokenizer(), tmp_path / "tokens", corrupt="skip", max_skipped=0.9)
    show_store(Workspace(tmp_path), 2.0)
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith(f"lost {ARM.name}: ")]
    assert len(told) == MAX_LISTED + 1 and told[-1].startswith(f"lost {ARM.name}: 18 more, see ")
    assert main(["data", "inspect", str(rlds), "--hz", "5", "--out", str(tmp_path / "sheet")]) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if line.startswith("damaged ")]
    assert len(told) == 7 and told[-1] == "damaged 18 more episode(s): --json FILE lists all"


def test_time_left_does_not_count_what_was_there_before():
    now = [0.0]
    eta = Eta(lambda: now[0])
    assert eta(90, 100) == ""
    now[0] = 10.0
    assert eta(91, 100) == ", 1 min 30 s left"
    assert eta(100, 100) == ""
