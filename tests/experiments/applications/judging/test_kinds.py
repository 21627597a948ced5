"""A kind of policy in the table of kinds is one that `hma judge` trains, asks for, explains and draws."""

from __future__ import annotations

import inspect
import re
from dataclasses import fields
from types import SimpleNamespace

import pytest

from experiments.applications.judging import judge as judging
from experiments.applications.judging.ladder import LadderConfig, kind_of, names
from experiments.applications.judging.page import _policies
from experiments.applications.judging.scatter import COLOURS
from experiments.applications.judging.summary import MODEL
from experiments.applications.judging.user_policies import TAKEN
from experiments.applications.policies.kinds import KINDS
from experiments.cli import judge as command
from experiments.cli.main import main
from experiments.terminal.command_line import joined


def none_but(kind: str, count: int) -> LadderConfig:
    return LadderConfig(**(dict.fromkeys(KINDS, 0) | {kind: count}))


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_asked_for_by_an_option_that_says_its_default(kind):
    assert kind in {f.name for f in fields(LadderConfig)}, f"{kind} has no field in LadderConfig, declared with `later`"
    function = command.judge
    assert kind in inspect.signature(function).parameters, f"`hma judge` has no option --{kind}"
    usual = LadderConfig().counts[kind] or "none"
    (line,) = re.findall(rf"^ +{kind}: (.*)$", joined(function.__doc__), re.MULTILINE)
    assert f"(default: {usual}" in line


@pytest.mark.parametrize("kind", KINDS)
def test_the_options_of_a_kind_reach_its_judgement_and_the_command_that_repeats_it(kind, tmp_path, monkeypatch):
    asked, again = [], []
    monkeypatch.setattr(
        judging, "judge_run", lambda run, out, config, own: SimpleNamespace(config=asked.append(config) or config)
    )
    monkeypatch.setattr(command, "_write_results", lambda judged, counts, out, words: again.append(words))
    assert main(["judge", "nowhere", "--robot", "pusher_sand", "--out", str(tmp_path), f"--{kind}", "5"]) == 0
    assert asked[0].ladder.counts == LadderConfig().counts | {kind: 5} and f" --{kind} 5 " in again[0]


@pytest.mark.parametrize("kind", KINDS)
def test_policies_of_a_kind_are_named_explained_and_drawn_as_it_says(kind):
    random, *policies = names(none_but(kind, 3))
    assert random == "random" and {kind_of(name) for name in policies} == {kind} and len(policies) == 3
    assert all(TAKEN.fullmatch(name) for name in policies)
    said = _policies({"own": [], "policies": dict.fromkeys(policies, {MODEL: {}})})
    assert f"<em>{kind}-N</em>: {KINDS[kind].explained}, after N training steps" in said
    others = [colour for other, (_, colour) in COLOURS.items() if other != kind]
    assert COLOURS[kind] == (KINDS[kind].legend, KINDS[kind].colour) and KINDS[kind].colour not in others
