"""What a person should know about a dataset before training on it: errors and warnings, in one sentence each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from data_pipelines.errors import MAX_LISTED
from data_pipelines.inspection.action_stats import WRAPPING
from data_pipelines.inspection.duplicates import Fingerprint
from data_pipelines.inspection.inspect import ActionFacts, Facts
from data_pipelines.inspection.suggest import NO_CAMERA, WindowFacts
from data_pipelines.registry import DatasetSpec
from data_pipelines.registry.angles import TURN, angle_lines
from data_pipelines.sources.rlds.schema import field_slice
from data_pipelines.sources.source import same_rate

MISFIT = "entry does not fit"


@dataclass(frozen=True)
class Issue:
    """`error`: the data cannot be used as they are. `warning`: they can be, but somebody should decide whether they
    should."""

    severity: Literal["error", "warning"]
    title: str
    text: str


def find_issues(
    facts: Facts,
    entry: DatasetSpec | None,
    windows: WindowFacts | None,
    duplicates: Sequence[tuple[Fingerprint, ...]],
) -> list[Issue]:
    """All issues of the sampled episodes, errors first. `entry`: how the dataset would be read."""
    issues = [*_damaged(facts), *_misfits(facts, entry), *_rate(facts, entry)]
    issues += [*_windows(facts, windows), *_cameras(facts, entry)]
    for field in chosen_actions(facts, entry):
        issues += _actions(field, entry)
    return sorted([*issues, *_duplicates(duplicates)], key=lambda issue: issue.severity != "error")


def chosen_actions(facts: Facts, entry: DatasetSpec | None) -> list[ActionFacts]:
    """The action fields that the entry uses, with the values that it uses; without an entry all fields."""
    if entry is None:
        return list(facts.actions)
    by_key = {field.key: field for field in facts.actions}
    chosen = []
    for key in entry.action_keys:
        field, part = field_slice(key)
        if field in by_key:
            chosen.append(ActionFacts(key, by_key[field].dimensions[part]))
    return chosen


def _damaged(facts: Facts) -> list[Issue]:
    damaged = list(facts.damaged.items())
    texts = [f"{count} of the episodes: {reason}" for reason, count in damaged[:MAX_LISTED]]
    if rest := sum(count for _, count in damaged[MAX_LISTED:]):
        texts.append(f"{rest:,} more episodes, for {len(damaged) - MAX_LISTED} more reasons")
    issues = [Issue("error", "cannot be read", text) for text in texts]
    if short := sum(n < 2 for n in facts.steps):
        text = f"{short} of {facts.sampled} episodes have only one step, so they show no motion"
        issues.append(Issue("warning", "single steps", text))
    return issues


def _misfits(facts: Facts, entry: DatasetSpec | None) -> list[Issue]:
    """What the entry names but the dataset lacks."""
    if entry is None:
        return []
    sizes = {field.key: len(field.dimensions) for field in facts.actions}
    missing = [] if entry.image_key in {c.key for c in facts.cameras} else [entry.image_key]
    for key, dim in zip(entry.action_keys, entry.action_dims, strict=True):
        field, part = field_slice(key)
        if len(range(sizes.get(field, 0))[part]) != dim:
            missing.append(f"{key} with {dim} values")
    if not missing:
        return []
    available = [c.key for c in facts.cameras] + [f"{key} ({n})" for key, n in sizes.items()]
    text = f"the registry's entry needs {', '.join(missing)}; the dataset has {', '.join(available) or 'neither'}"
    return [Issue("error", MISFIT, text)]


def _rate(facts: Facts, entry: DatasetSpec | None) -> list[Issue]:
    """Files that state a rate mean the rate of the recording; with another rate the stride would be another."""
    if entry is None or facts.hz is None or same_rate(facts.hz, entry.hz):
        return []
    return [Issue("warning", "another rate", f"its files say {facts.hz:g} Hz, but {entry.hz:g} Hz are used")]


def _windows(facts: Facts, windows: WindowFacts | None) -> list[Issue]:
    if windows is None:
        text = "no file contains the rate of the recording in frames per second: give --hz"
        return [Issue("warning", "rate unknown", text)]
    short = facts.sampled - windows.long_enough
    if not short:
        return []
    needs = f"the shortest window at stride {windows.stride} needs {windows.needed} steps"
    if not windows.long_enough:
        text = f"{needs}; the longest of {facts.sampled} episodes has {facts.lengths.longest}"
        return [Issue("error", "no window", text)]
    text = f"{needs}; {short} of {facts.sampled} episodes are shorter"
    return [Issue("warning", "short episodes", text)] if short > 0.1 * facts.sampled else []


def _cameras(facts: Facts, entry: DatasetSpec | None) -> list[Issue]:
    issues = [] if facts.cameras else [Issue("error", "no camera", NO_CAMERA)]
    for camera in facts.cameras:
        used = entry is not None and camera.key == entry.image_key
        whose = "the camera in use" if used else "not in use"
        if camera.undecodable:
            text = (
                f"{camera.key} ({whose}): frames of {camera.undecodable} of {facts.sampled} episodes are missing or cannot "
                f"be decoded; the first: {camera.reason.rstrip('.')}"
            )
            issues.append(Issue("error" if used else "warning", "undecodable frames", text))
        if camera.is_blank:
            text = f"{camera.key} ({whose}): every frame that was read has one colour only"
            issues.append(Issue("error" if used else "warning", "blank camera", text))
        elif camera.blank:
            text = f"{camera.key} ({whose}): {camera.blank} of {camera.frames} frames have one colour only"
            issues.append(Issue("warning", "blank frames", text))
        if camera.still and not camera.is_blank:
            text = f"{camera.key} ({whose}): in every episode all frames are the same"
            issues.append(Issue("error" if used else "warning", "still camera", text))
        if len(camera.sizes) > 1:
            sizes = ", ".join(f"{h}x{w}" for h, w in camera.sizes)
            issues.append(Issue("warning", "sizes differ", f"{camera.key}: frames of {sizes}"))
    return issues


def _actions(field: ActionFacts, entry: DatasetSpec | None) -> list[Issue]:
    issues = []
    constant = [i for i, d in enumerate(field.dimensions) if d.hint == "constant"]
    if constant:
        severity = "error" if len(constant) == len(field.dimensions) else "warning"
        text = f"{_values(field, constant)} never change{'s' if len(constant) == 1 else ''}"
        issues.append(Issue(severity, "constant action", text))
    broken = [i for i, d in enumerate(field.dimensions) if d.not_finite]
    if broken:
        count = sum(field.dimensions[i].not_finite for i in broken)
        text = (
            f"{_values(field, broken)}: {count} numbers are NaN or infinite; episodes with such numbers cannot be used"
        )
        issues.append(Issue("error", "not finite", text))
    start = _first_value(field.key, entry)
    handled = set(entry.angles) if entry is not None and entry.angle_form != "as_recorded" else set()
    for unit, hint in WRAPPING.items():
        wraps = [i for i, d in enumerate(field.dimensions) if d.hint == hint and start + i not in handled]
        if wraps:
            text = (
                f"{_values(field, wraps)} jump{'s' if len(wraps) == 1 else ''} by a whole turn; to correct this, add "
                f"{angle_lines([start + i for i in wraps], unit)} to the entry"
            )
            issues.append(Issue("warning", "wrapping angle", text))
        other = [i for i, d in enumerate(field.dimensions) if d.hint == hint and start + i in handled]
        if other and unit != entry.angle_unit:
            text = (
                f"{_values(field, other)} jump{'s' if len(other) == 1 else ''} by a whole turn of {TURN[unit]:.4g}; the "
                f"entry's angle_unit is {entry.angle_unit}, not {unit}"
            )
            issues.append(Issue("error", "unit of angles", text))
    return issues


def _first_value(key: str, entry: DatasetSpec | None) -> int:
    """Position in the entry's action at which the values of a chosen field (see `chosen_actions`) begin."""
    return 0 if entry is None else sum(entry.action_dims[: entry.action_keys.index(key)])


def _duplicates(groups: Sequence[tuple[Fingerprint, ...]]) -> list[Issue]:
    if not groups:
        return []
    across = [g for g in groups if len({e.split for e in g}) > 1]
    issues = []
    if across:
        text = (
            f"{len(across)} recordings are in more than one split: {_listed(across)}. So held-out episodes may also "
            "be training episodes"
        )
        issues.append(Issue("error", "same episodes in two splits", text))
    within = [g for g in groups if g not in across]
    if within:
        extra = sum(len(g) - 1 for g in within)
        text = f"{extra} episodes are copies of another one: {_listed(within)}"
        issues.append(Issue("warning", "likely duplicates", text))
    return issues


def _listed(groups: Sequence[tuple[Fingerprint, ...]]) -> str:
    words = [" = ".join(e.name for e in group[:4]) for group in groups[:MAX_LISTED]]
    return ", ".join(words) + (", ..." if len(groups) > MAX_LISTED else "")


def _values(field: ActionFacts, which: Sequence[int]) -> str:
    return f"{field.key}: value{'' if len(which) == 1 else 's'} {', '.join(map(str, which))}"
