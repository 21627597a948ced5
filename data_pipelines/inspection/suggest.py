"""Suggests a registry entry from the facts of a dataset, and counts the windows that an entry gives."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from data_pipelines.inspection.action_stats import WRAPPING
from data_pipelines.inspection.inspect import NOT_READ, CameraFacts, Facts
from data_pipelines.registry import FRAME_RATE, DatasetSpec
from data_pipelines.registry.angles import AngleForm, AngleUnit
from data_pipelines.registry.spec import MAX_STRIDE
from data_pipelines.registry.toml_file import to_toml
from data_pipelines.sources.convertible import unsupported_images_text
from data_pipelines.sources.rlds.schema import METADATA, RATE_KEY, field_slice
from data_pipelines.sources.source import NO_ACTION, action_fields
from data_pipelines.windows.slicer import WindowSlicer
from data_pipelines.windows.windows import MIN_TRAIN_FRAMES
from hma_jax.config import ConfigError

ON_THE_ARM = re.compile(r"wrist|hand|grip|eye_in", re.IGNORECASE)
DEPTHS = re.compile(r"depth|dispar", re.IGNORECASE)
OUTSIDE = re.compile(r"ext|front|main|static|agent|third|high|top|head", re.IGNORECASE)

NO_RATE = 0.0
"""Placeholder for an unknown rate, which `DatasetSpec` refuses."""

NO_CAMERA = (
    "none of its fields is an image of 8 bits; write pictures that are stored as plain numbers as images "
    "(docs/own_data.md, Writing RLDS)"
)
"""Why a dataset without a camera is given no entry."""


@dataclass(frozen=True)
class Suggestion:
    """The fields of a suggested entry, and the reasons."""

    name: str
    image_key: str
    action_keys: tuple[str, ...]
    action_dims: tuple[int, ...]
    hz: float
    split: str
    version: str
    video_targets: bool
    reasons: tuple[str, ...]
    angles: tuple[int, ...] = ()
    angle_unit: AngleUnit = "radian"
    episodes: int = 0
    mean_steps: float = 0.0  # of the episodes that were read

    @property
    def angle_form(self) -> AngleForm:
        return "sine_cosine" if self.angles else "as_recorded"

    def spec(self) -> DatasetSpec:
        """The suggestion as an entry. Raises ConfigError while the rate is missing."""
        return DatasetSpec(
            self.name, self.image_key, self.action_keys, self.action_dims, self.hz,
            split=self.split, video_targets=self.video_targets, version=self.version,
            angles=self.angles, angle_form=self.angle_form, angle_unit=self.angle_unit,
            episodes=self.episodes, mean_steps=self.mean_steps,
        )  # fmt: skip

    def table(self) -> str:
        """The table of the entry in a file for --registry; where the rate is missing, it says so."""
        if self.hz:
            return to_toml(self.spec())
        table = to_toml(replace(self, hz=1.0).spec())
        return table.replace("\nhz = 1.0\n", "\nhz = 0  # FILL IN: frames per second of the recording\n")


@dataclass(frozen=True)
class WindowFacts:
    """The windows that an entry gives, for a number of frames per window."""

    frames: int
    stride: int
    native: int  # native frames that a whole window spans
    needed: int  # native frames that the shortest window spans
    whole: int  # sampled episodes with a whole window
    long_enough: int  # sampled episodes with any window
    per_episode: float  # windows, over the sampled episodes
    total: float  # windows of the split, estimated


def require_own_rate(facts: Facts) -> None:
    """Raises ConfigError if the rate that the dataset's own files say cannot be used."""
    if facts.hz is not None and facts.hz > MAX_STRIDE * FRAME_RATE:
        raise ConfigError(
            f"{facts.directory}: its own files say {facts.hz:g} native frames per second (those of RLDS as {RATE_KEY} "
            f"in {METADATA}), which is too many for a recording: correct that, or give --hz"
        )


def suggest_entry(facts: Facts, hz: float | None) -> Suggestion | None:
    """An entry for a dataset that the registry does not know; None if it has no camera at all."""
    camera, why = choose_camera(facts.cameras)
    if camera is None:
        return None
    keys, dims, about = _choose_actions(facts)
    reasons = [f"camera: {why}", f"action: {about}"]
    if others := [field.key for field in facts.fields if field.kind == NOT_READ]:
        reasons.append(unsupported_images_text(others))
    angles, unit = _choose_angles(facts, keys, dims)
    if angles:
        reasons.append(
            f"angles: {', '.join(map(str, angles))} of the action jump by a whole turn ({unit}s); their sine and "
            "cosine do not"
        )
    if not hz:
        reasons.append("hz: not in the files; give --hz, or fill it in")
    return Suggestion(
        facts.name, camera.key, keys, dims, hz or NO_RATE, facts.split, facts.version,
        not camera.is_blank, tuple(reasons), angles, unit,
        episodes=facts.episodes, mean_steps=round(facts.lengths.mean, 1),
    )  # fmt: skip


def choose_camera(cameras: Sequence[CameraFacts]) -> tuple[CameraFacts | None, str]:
    """The camera to use, and why: one that can be decoded, shows something and is not mounted on the arm."""
    if not cameras:
        return None, "there is none"
    decoded = [c for c in cameras if c.frames] or cameras
    seeing = [c for c in decoded if not c.is_blank]
    if not seeing:
        return decoded[0], "every camera is blank, so there is nothing to predict"

    def rank(camera: CameraFacts) -> tuple:
        name = camera.key.rsplit("/", 1)[-1]
        plain = name in ("image", "rgb", "image_0", "image_1")
        return bool(DEPTHS.search(name)), bool(ON_THE_ARM.search(name)), not plain, not OUTSIDE.search(name), camera.key

    best = min(seeing, key=rank)
    blank = [c.key for c in cameras if c.is_blank]
    why = f"of {len(cameras)}" + (f", {len(blank)} of them blank" if blank else "")
    why += f", {lacking} that cannot be decoded" if (lacking := len(cameras) - len(decoded)) else ""
    where = "by its name on the arm, like all others" if ON_THE_ARM.search(best.key) else "by its name not on the arm"
    return best, f"{best.key.removeprefix('observation/')} {why}; {where}"


def _choose_actions(facts: Facts) -> tuple[tuple[str, ...], tuple[int, ...], str]:
    by_key = {a.key: a for a in facts.actions}
    keys = action_fields(by_key)
    if not keys:
        return (), (), f"{_why_no_action(facts)}: used as video without actions"
    names, dims, dropped = [], [], []
    for key in keys:
        hints = [d.hint for d in by_key[key].dimensions]
        size = len(hints)
        while size > 1 and hints[size - 1] == "end flag":
            size -= 1
        names.append(key if size == len(hints) else f"{key}[:{size}]")
        dims.append(size)
        dropped += [f"{key}[{i}]" for i in range(size, len(hints))]
    about = f"{sum(dims)} values" + (f"; left out as end flags: {', '.join(dropped)}" if dropped else "")
    others = [k for k in by_key if k not in keys and not NO_ACTION.search(k)]
    if others:
        about += f"; there are also {', '.join(others)}"
    return tuple(names), tuple(dims), about


def _why_no_action(facts: Facts) -> str:
    parts = [f for f in facts.fields if f.key.partition("/")[0] in ("action", "actions")]
    kept = ", ".join(f.key for f in parts if f.kind == "bytes")
    lists = ", ".join(f.key for f in parts if f.kind == "list")
    others = ", ".join(a.key for a in facts.actions if not NO_ACTION.search(a.key))
    if kept:
        why = f"{kept} is stored as bytes, which cannot be read; write the dataset again with encoding 'none' for it"
    elif lists:
        why = f"{lists} has no fixed length, so it cannot be read; write the dataset again with a fixed length"
    else:
        why = "no numeric field `action`"
    return f"{why}; give the fields of the action in action_keys, from {others}" if others else why


def _choose_angles(facts: Facts, keys: Sequence[str], dims: Sequence[int]) -> tuple[tuple[int, ...], AngleUnit]:
    """The positions (over all keys) of the chosen values that wrap, and their unit: that of most of them."""
    by_key = {a.key: a for a in facts.actions}
    hints = [
        d.hint
        for key, dim in zip(keys, dims, strict=True)
        for d in by_key[field_slice(key)[0]].dimensions[field_slice(key)[1]][:dim]
    ]
    found = {unit: tuple(i for i, h in enumerate(hints) if h == words) for unit, words in WRAPPING.items()}
    unit = max(found, key=lambda u: len(found[u]))
    return found[unit], unit


def window_facts(facts: Facts, stride: int, frames: int) -> WindowFacts:
    """Windows of `frames` at `stride`, counted over the sampled episodes."""
    slicer, min_real = WindowSlicer(frames, stride, stride), min(MIN_TRAIN_FRAMES, frames)
    steps = np.array(facts.steps)
    counts = slicer.count(steps, min_real)
    whole, some, mean = int((steps >= slicer.native_frames).sum()), int((counts > 0).sum()), float(counts.mean())
    return WindowFacts(
        frames, stride, slicer.native_frames, min_real * stride, whole, some, mean, mean * facts.episodes
    )
