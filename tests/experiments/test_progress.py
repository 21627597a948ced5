"""Tables that say everything at any width."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from experiments.running.attempts import State
from experiments.running.monitor import SweepMonitor
from experiments.running.runner import Job
from experiments.terminal import progress
from experiments.terminal.progress import say, short, tidy_table

METRICS = ("perplexity", "accuracy", "psnr", "ssim", "delta_psnr", "action_nats", "retrieval")


def shown(table, width: int) -> str:
    console = Console(file=io.StringIO(), width=width, highlight=False)
    console.print(table)
    return console.file.getvalue()


@pytest.mark.parametrize("width", [40, 80, 110, 200])
def test_no_cell_is_cut_short_at_any_width(width):
    table = tidy_table("a run", "dataset", *METRICS)
    for name in ("my_robot", "overall"):
        table.add_row(name, *(f"{i}7.1234 ± 5.4321" for i, _ in enumerate(METRICS)))
    table.caption = "a caption"
    said = shown(table, width)
    assert "…" not in said and max(map(len, said.splitlines())) <= width
    words = said.split()
    assert all(words.count(metric) == 1 for metric in METRICS)
    assert all(words.count(f"{i}7.1234") == 2 for i in range(len(METRICS)))
    tables = words.count("dataset")
    assert words.count("my_robot") == tables and (tables == 1) == (width == 200)
    assert said.count("a run") == said.count("a caption") == 1


def test_paths_are_shown_in_a_directory_that_was_removed(tmp_path, monkeypatch):
    """What had been written was called a failure."""
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    assert short(here / "table.csv") == "table.csv"
    here.rmdir()
    assert short(tmp_path / "table.csv") == str(tmp_path / "table.csv")


def test_a_name_wider_than_the_terminal_is_folded():
    table = tidy_table("", "field", "kind")
    table.add_row("observation/" * 5, "image")
    said = shown(table, 40)
    assert "…" not in said and "image" in said and "".join(said.split()).count("observation/") >= 4


@pytest.mark.parametrize("width", [60, 80, 110, 200])
def test_a_column_of_prose_takes_what_the_others_leave(width):
    table = tidy_table("", "name", "Hz", "steps")
    table.columns[0].no_wrap, table.columns[0].overflow = False, "fold"
    table.add_column("what it is", min_width=30)
    prose = [f"word{i}" for i in range(40)]
    table.add_row("a_name_of_a_dataset_that_is_longer_than_most", "10", "1234", " ".join(prose))
    said = shown(table, width)
    assert all(len(line) <= width for line in said.splitlines())
    assert [word for word in said.split() if word.startswith("word")] == prose


def test_brackets_in_the_title_of_a_trial_are_words(monkeypatch):
    console = Console(file=io.StringIO(), width=110, highlight=False)
    monkeypatch.setattr(progress, "console", console)
    for title in ("pace [fps] 3", "pace [/s] 3"):
        with SweepMonitor(1) as monitor:
            job = Job("a", title, {})
            monitor.launched(job, resumed=False)
            monitor.ended(job, State("failed", "[/x] y"), 1.0, again=False)
        assert f"{title} (1.0 s): [/x] y" in console.file.getvalue()


def test_a_message_is_printed_as_it_is(capsys):
    message = "note: /data/:key:/[bold]arms[/] " + 30 * "and further ones "
    say(message)
    assert capsys.readouterr().out == f"{message}\n"
