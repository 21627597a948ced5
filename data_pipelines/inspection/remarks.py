"""What of a dataset a person should know before training on it, in one sentence each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from data_pipelines.errors import MAX_EXAMPLES
from data_pipelines.inspection.action_stats import WRAPPING
from data_pipelines.inspection.duplicates import Fingerprint
from data_pipelines.inspection.inspect import ActionFacts, Facts
from data_pipelines.inspection.suggest import NO_CAMERA, WindowFacts
from data_pipelines.registry import DatasetSpec
from data_pipelines.registry.angles import TURN
from data_pipelines.sources.rlds.schema import field_slice

MISFIT = "entry does not fit"


@dataclass(frozen=True)
class Remark:
    """`bad`: the data cannot be used so. `doubt`: it can; somebody should decide whether it should."""

    kind: Literal["bad", "doubt"]
    title: str
    text: str


def make_remarks(
    facts: Facts,
    entry: DatasetSpec | None,
    windows: WindowFacts | None,
    duplicates: Sequence[tuple[Fingerprint, ...]],
) -> list[Remark]:
    """Everything that stands out of the sampled episodes. `entry`: how the dataset would be read."""
    remarks = [*_damaged(facts), *_misfits(facts, entry), *_rate(facts, entry)]
    remarks += [*_windows(facts, windows), *_cameras(facts, entry)]
    for field in chosen_actions(facts, entry):
        remarks += _actions(field, entry)
    return [*remarks, *_duplicates(duplicates)]


def chosen_actions(facts: Facts, entry: DatasetSpec | None) -> list[ActionFacts]:
    """The action fields that the entry takes, with the values it takes of them; without an entry all there are."""
    if entry is None:
        return list(facts.actions)
    by_key = {field.key: field for field in facts.actions}
    chosen = []
    for key in entry.action_keys:
        field, part = field_slice(key)
        if field in by_key:
            chosen.append(ActionFacts(key, by_key[field].dimensions[part]))
    return chosen


def _damaged(facts: Facts) -> list[Remark]:
    damaged = list(facts.damaged.items())
    lost = [
        Remark("bad", "cannot be read", f"{count} of the episodes: {reason}")
        for reason, count in damaged[:MAX_EXAMPLES]
    ]
    if rest := sum(count for _, count in damaged[MAX_EXAMPLES:]):
        lost.append(
            Remark("bad", "cannot be read", f"{rest:,} more episodes, for {len(damaged) - MAX_EXAMPLES} more reasons")
        )
    short = sum(n < 2 for n in facts.steps)
    if short:
        lost.append(Remark("doubt", "single steps", f"{short} episodes of {facts.sampled} have one step: no motion"))
    return lost


def _misfits(facts: Facts, entry: DatasetSpec | None) -> list[Remark]:
    """What the entry names and the dataset lacks."""
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
    text = f"the registry's entry wants {', '.join(missing)}; there are {', '.join(available) or 'neither'}"
    return [Remark("bad", MISFIT, text)]


def _rate(facts: Facts, entry: DatasetSpec | None) -> list[Remark]:
    """Formats that say their rate say it of the recording; another one makes another stride of it."""
    if entry is None or facts.hz is None or facts.hz == entry.hz:
        return []
    return [Remark("doubt", "another rate", f"its files say {facts.hz:g} Hz; {entry.hz:g} Hz are taken")]


def _windows(facts: Facts, windows: WindowFacts | None) -> list[Remark]:
    if windows is None:
        return [Remark("doubt", "rate unknown", "no file says how many frames a second were recorded: give --hz")]
    short = facts.sampled - windows.long_enough
    if not short:
        return []
    needs = f"the shortest window at stride {windows.stride} takes {windows.needed} steps"
    if not windows.long_enough:
        return [
            Remark("bad", "no window", f"{needs}; the longest of {facts.sampled} episodes has {facts.lengths.longest}")
        ]
    kind = "doubt" if short > 0.1 * facts.sampled else None
    text = f"{needs}; {short} of {facts.sampled} episodes are shorter"
    return [Remark(kind, "short episodes", text)] if kind else []


def _cameras(facts: Facts, entry: DatasetSpec | None) -> list[Remark]:
    remarks = [] if facts.cameras else [Remark("bad", "no camera", NO_CAMERA)]
    for camera in facts.cameras:
        used = entry is not None and camera.key == entry.image_key
        whose = "the camera in use" if used else "not in use"
        if camera.undecodable:
            text = (
                f"{camera.key} ({whose}): frames of {camera.undecodable} of {facts.sampled} episodes cannot be decoded; "
                f"the first: {camera.reason.rstrip('.')}"
            )
            remarks.append(Remark("bad" if used else "doubt", "undecodable frames", text))
        if camera.is_blank:
            text = f"{camera.key} ({whose}): every frame looked at shows one colour"
            remarks.append(Remark("bad" if used else "doubt", "blank camera", text))
        elif camera.blank:
            text = f"{camera.key} ({whose}): {camera.blank} of {camera.frames} frames show one colour"
            remarks.append(Remark("doubt", "blank frames", text))
        if camera.still and not camera.is_blank:
            text = f"{camera.key} ({whose}): no episode's frames differ"
            remarks.append(Remark("bad" if used else "doubt", "still camera", text))
        if len(camera.sizes) > 1:
            sizes = ", ".join(f"{h}x{w}" for h, w in camera.sizes)
            remarks.append(Remark("doubt", "sizes differ", f"{camera.key}: frames of {sizes}"))
    return remarks


def _actions(field: ActionFacts, entry: DatasetSpec | None) -> list[Remark]:
    remarks = []
    constant = [i for i, d in enumerate(field.dimensions) if d.hint == "constant"]
    if constant:
        remarks.append(
            Remark(
                "bad" if len(constant) == len(field.dimensions) else "doubt",
                "constant action",
                f"{_values(field, constant)} never change{'s' if len(constant) == 1 else ''}",
            )
        )
    broken = [i for i, d in enumerate(field.dimensions) if d.not_finite]
    if broken:
        count = sum(field.dimensions[i].not_finite for i in broken)
        text = f"{_values(field, broken)}: {count} numbers are NaN or infinite; their episodes cannot be used"
        remarks.append(Remark("bad", "not finite", text))
    start = _first_value(field.key, entry)
    handled = set(entry.angles) if entry is not None and entry.angle_form != "as_recorded" else set()
    wraps = [i for i, d in enumerate(field.dimensions) if d.hint in WRAPPING.values() and start + i not in handled]
    if wraps:
        numbers = ", ".join(str(start + i) for i in wraps)
        text = (
            f"{_values(field, wraps)} jump{'s' if len(wraps) == 1 else ''} by a whole turn; an entry with "
            f'angles = [{numbers}] and angle_form = "sine_cosine" (or "unwrapped") mends it'
        )
        remarks.append(Remark("doubt", "wrapping angle", text))
    for unit, hint in WRAPPING.items():
        other = [i for i, d in enumerate(field.dimensions) if d.hint == hint and start + i in handled]
        if other and unit != entry.angle_unit:
            text = (
                f"{_values(field, other)} jump{'s' if len(other) == 1 else ''} by a whole turn of {TURN[unit]:.4g}; the "
                f"entry's angle_unit is {entry.angle_unit}, not {unit}"
            )
            remarks.append(Remark("bad", "unit of angles", text))
    return remarks


def _first_value(key: str, entry: DatasetSpec | None) -> int:
    """Where the values of a chosen field (see `chosen_actions`) begin in the entry's action."""
    return 0 if entry is None else sum(entry.action_dims[: entry.action_keys.index(key)])


def _duplicates(groups: Sequence[tuple[Fingerprint, ...]]) -> list[Remark]:
    if not groups:
        return []
    across = [g for g in groups if len({e.split for e in g}) > 1]
    remarks = []
    if across:
        text = (
            f"{len(across)} recordings are in more than one split: {_listed(across)}. Held-out episodes of "
            "one must not be trained on in the other"
        )
        remarks.append(Remark("bad", "same episodes in two splits", text))
    within = [g for g in groups if g not in across]
    if within:
        extra = sum(len(g) - 1 for g in within)
        text = f"{extra} episodes repeat another: {_listed(within)}"
        remarks.append(Remark("doubt", "likely duplicates", text))
    return remarks


def _listed(groups: Sequence[tuple[Fingerprint, ...]]) -> str:
    words = [" = ".join(e.name for e in group[:4]) for group in groups[:MAX_EXAMPLES]]
    return ", ".join(words) + (", ..." if len(groups) > MAX_EXAMPLES else "")


def _values(field: ActionFacts, which: Sequence[int]) -> str:
    return f"{field.key}: value{'' if len(which) == 1 else 's'} {', '.join(map(str, which))}"
