"""What to run after looking at data: the command that reads it as it was counted, or why there is none yet."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.presets import get_preset
from experiments.setting import Where, command

if TYPE_CHECKING:
    from data_pipelines.inspection.inspect import Facts


def tokenize_command(directories: Sequence[str], frames: int, registry: Path | None) -> str:
    """The command that tokenises datasets for windows of `frames`, by the preset that is the default."""
    preset = get_preset(Where.preset)
    changes = {}
    if frames != preset.model.frames:
        changes["model.frames"] = frames
    if frames <= preset.eval.prompt_frames:
        changes["eval.prompt_frames"] = max(frames // 2, 1)
    settings = tuple(f"{name}={value}" for name, value in changes.items())
    asked = Where(data=tuple(directories), registry=registry, set=settings).anywhere()
    return command("tokenize", *asked.words())


def no_window(facts: Facts, stride: int, registry: Path | None) -> str:
    """What to run instead for a dataset of which no episode is long enough, and why."""
    longest, known = facts.lengths.longest, (("--registry", registry) if registry else ())
    if longest < 2:
        return "leave it out: its longest episode has one step, so there is no motion to learn"
    if longest // stride >= 2:
        fits = longest // stride
        words = command("data view", facts.directory, "--frames", f"{fits}", *known)
        why = f"so many frames fit its longest episode, {longest} steps; train with --set model.frames={fits}"
        return f"{words}  ({why})"
    words = command("data view", facts.directory, "--stride", "1", "--frames", f"{min(longest, 12)}", *known)
    return f"{words}  (its longest episode has {longest} steps: too short at stride {stride}, every frame is needed)"
