"""Stamps of prepared data: what they were made from, and whether they may be replaced.

Three kinds of facts are written beside what is made, none of them a path or a time. *Inputs* are settings and data,
by content. A thing that exists and was made from other inputs is refused, and never replaced unless the user asks for
that. What is *recorded*, the hash of the sources that made it, changes with many edits that alter nothing: a difference
is reported, and the existing thing stays in use. To have it made by the new sources, remove it. The *machine* is for
people.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from experiments.terminal.progress import say
from experiments.terminal.words import few
from hma_jax.config import ConfigError, require
from hma_jax.config.json import diff, from_dict, stable_hash, to_dict
from hma_jax.runtime.files import write_file

Step = Literal["suite", "tokenizer", "tokens", "windows", "study"]
"""In the order in which one is made of the other."""

IN_WORDS: dict[Step, str] = {
    "suite": "the simulated datasets",
    "tokenizer": "the tokenizer",
    "tokens": "the tokens",
    "windows": "the evaluation windows",
    "study": "the study's record and report",
}

STAMP = "made_from.json"
ORIGIN = "origin"
"""The input that decides which others there are."""


@dataclass(frozen=True)
class MadeFrom:
    """JSON values by name."""

    inputs: dict[str, Any]
    recorded: dict[str, Any] = field(default_factory=dict)
    machine: dict[str, Any] = field(default_factory=dict)

    def identity(self) -> dict[str, Any]:
        """A value, as JSON, that is equal for things made in the same way by the same sources."""
        return {"inputs": self.inputs, "recorded": self.recorded}

    @property
    def id(self) -> str:
        return stable_hash(self.identity())

    def save(self, directory: Path, name: str = STAMP) -> None:
        write_file(directory / name, json.dumps(to_dict(self), indent=1))


def read_stamp(directory: Path, name: str = STAMP) -> MadeFrom | None:
    """What the thing in `directory` was made from; None if that is not recorded there, or is damaged."""
    try:
        existing = from_dict(MadeFrom, json.loads((directory / name).read_text()))
        require(all(isinstance(part, dict) for part in vars(existing).values()), "not JSON values by name")
        return existing
    except (OSError, ValueError):  # ConfigError is a ValueError
        return None


def differences(existing: Mapping[str, Any], wanted: Mapping[str, Any]) -> list[str]:
    """Lines 'setting: old -> new' for inputs that differ. Facts about a dataset that an earlier version did not record
    are not compared."""
    if existing.get(ORIGIN) != wanted.get(ORIGIN):
        return [f"{ORIGIN}: {existing.get(ORIGIN)} -> {wanted.get(ORIGIN)}"]
    old, new = dict(existing), dict(wanted)
    names = old.pop("datasets", []), new.pop("datasets", [])
    lines = dataset_differences(*names)
    data = old.pop("data", {}), new.pop("data", {})
    for name in [n for n in data[0] if n in data[1]]:
        known = {fact: value for fact, value in data[1][name].items() if fact in data[0][name]}
        lines += diff(_with_corrections(data[0][name]), _with_corrections(known), f"data of {name}")
    return diff(old, new) + lines


def _with_corrections(facts: Mapping[str, Any]) -> dict[str, Any]:
    """A dataset's facts with `image_corrections` under their own name; `image_key` holds them in the same text
    (`camera_key`)."""
    from data_pipelines.registry.spec import split_camera_key

    if not isinstance(facts.get("image_key"), str):
        return dict(facts)
    key, corrections = split_camera_key(facts["image_key"])
    return {**facts, "image_key": key, "image_corrections": list(corrections)}


def dataset_differences(existing: Sequence[str], wanted: Sequence[str]) -> list[str]:
    """At most one line, which names the added and the removed datasets."""
    if list(existing) == list(wanted):
        return []
    gone = [n for n in existing if n not in wanted]
    new = [n for n in wanted if n not in existing]
    parts = [f"without {few(gone)}"] * bool(gone) + [f"with {few(new)}"] * bool(new)
    return [f"datasets: {len(existing)} -> {len(wanted)}, {' and '.join(parts) or 'in another order'}"]


def may_replace(step: Step, replace: Step | None) -> bool:
    """Whether the user asked to replace `step`, or something from which it is made."""
    order = get_args(Step)
    return replace is not None and order.index(replace) <= order.index(step)


@dataclass(frozen=True)
class Change:
    """How the product of a step in a `place` differs from what is asked for."""

    step: Step
    place: Path
    lines: Sequence[str]  # 'setting: there -> asked for'; (): no difference
    otherwise: str = ""  # one more way to continue


def require_same(step: Step, place: Path, lines: Sequence[str], replace: Step | None, otherwise: str = "") -> None:
    """`require_unchanged` of one step."""
    require_unchanged([Change(step, place, lines, otherwise)], replace)


def require_unchanged(changes: Sequence[Change], replace: Step | None) -> None:
    """Raises ConfigError for changes that the user did not ask for, for all steps at once: it names the --replace that
    allows them all."""
    refused = [change for change in changes if change.lines and not may_replace(change.step, replace)]
    if not refused:
        return
    first, *others = sorted(refused, key=lambda change: get_args(Step).index(change.step))
    step, more = first.step, [(o, line) for o in others for line in o.lines if line not in first.lines]
    after = [IN_WORDS[s] for s in get_args(Step) if may_replace(s, step) and s != step]
    follows = f", and {', '.join(after)} where they depend on it" if after else ". Finished trials stay"
    otherwise = first.otherwise + (f" and --replace {others[0].step}" if first.otherwise and others else "")
    raise ConfigError(
        f"{first.place} holds {IN_WORDS[step]}, made from other inputs (there -> asked for):\n  "
        + "\n  ".join([*first.lines, *(f"{line} ({IN_WORDS[change.step]})" for change, line in more)])
        + "\nNothing was changed. Choose another --out, or use the settings that it was made with"
        + (f", or {otherwise}" if otherwise else "")
        + f"; or add --replace {step}, which makes {IN_WORDS[step]} again, overwriting the existing ones{follows}."
    )


def say_recorded(what: str, place: Path, existing: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Prints that something stays in use although other sources would make it now; compares only what both record."""
    lines = [line for name in existing.keys() & now.keys() for line in diff(existing[name], now[name], name)]
    if lines:
        say(
            f"note: {what} in {place} was made with other {'; '.join(lines)}. It is still used; remove it to make it "
            "again"
        )
