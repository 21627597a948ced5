"""`--set help`: which settings there are."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import pytest

from experiments.cli.main import main
from experiments.presets import get_preset
from experiments.user_input.settings_help import SettingHelp, describe_settings


@dataclass(frozen=True)
class Inner:
    """Not read."""

    a: int = 1  # of things; a second half. Left out.
    # Above, over
    # two lines (see figure 2.9). And more.
    b: tuple[int, ...] = ()
    c: Literal["x", "y"] = "x"


@dataclass(frozen=True)
class Outer:
    inner: Inner = Inner()
    d: str = "# no comment"


def test_a_setting_is_told_by_its_own_comment():
    assert list(describe_settings(Outer())) == [
        SettingHelp("inner.a", "1", "of things; a second half"),
        SettingHelp("inner.b", "[]", "Above, over two lines (see figure 2.9)"),
        SettingHelp("inner.c", "x", "(x, y)"),
        SettingHelp("d", "# no comment", ""),
    ]


@pytest.mark.parametrize("preset", ["smoke", "smoke-continuous"])
def test_every_setting_is_told(preset):
    found = list(describe_settings(get_preset(preset)))
    assert len(found) > 140
    untold = [one.path for one in found if re.fullmatch(r"(\(.*\))?", one.text)]
    assert not untold, f"no comment says what they are: {', '.join(untold)}"


def test_the_settings_of_a_group_are_shown_as_those_before_change_them(capsys):
    with pytest.raises(SystemExit) as end:
        main(["evaluate", "run", "--preset", "smoke", "--set", "store.min_val=3", "--set", "store.help"])
    said = capsys.readouterr().out
    assert end.value.code == 0 and "store.min_val" in said and "model." not in said
    (line,) = (line.split() for line in said.splitlines() if "store.min_val " in line)
    assert line[1] == "3"


def test_a_setting_that_every_value_is_refused_of_is_not_offered(capsys):
    with pytest.raises(SystemExit):
        main(["train", "--set", "help"])
    said = capsys.readouterr().out
    assert "eval.seed" in said and not re.search(r" train\.seed", said)


def test_a_group_that_there_is_not_is_an_error(capsys):
    assert main(["study", "--preset", "smoke", "--set", "modle.help"]) == 2
    assert "--set modle.help: no such setting; a study has name, model.*" in capsys.readouterr().err
    assert main(["study", "--preset", "smoke", "--set", "hlep"]) == 2
    assert "--set help lists all settings" in capsys.readouterr().err
