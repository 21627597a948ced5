"""`hma data export`: a dataset in the format of LeRobot, for its policies."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from data_pipelines.errors import DataError, EpisodeError, without_advice
from data_pipelines.registry import find_reader
from experiments.study_setup import UNSET, command, require_local, use_entries
from experiments.terminal.progress import say, step, wrote
from experiments.terminal.words import counted
from hma_jax.config import require


def data_export(
    source: Annotated[Positional[str], arg(metavar="DATASET")],
    out: Annotated[Path, arg(metavar="DIR")],
    split: str = "train",
    hz: Annotated[float | None, UNSET] = None,
    action: Annotated[tuple[str, ...], arg(metavar="[KEY ...]"), UNSET] = (),
    state: Annotated[tuple[str, ...], arg(metavar="[KEY ...]"), UNSET] = (),
    skip_damaged: Annotated[FlagCreatePairsOff[bool], arg(name="skip-damaged"), UNSET] = False,
    registry: Annotated[Path | None, arg(metavar="FILE"), UNSET] = None,
) -> None:
    """Write a dataset in LeRobot's format (version 3.0), with videos, for programs that train policies on it.

    All cameras, actions, observed vectors, rewards, successes and texts are written, as they were recorded. Needs the
    extra 'convert'. Run the same command again after an interruption: it continues.

    Args:
        source: The dataset: an RLDS directory, such as `hma generate` writes, or a robomimic file.
        out: Directory of the new dataset.
        split: The split to read; several are joined by +.
        hz: Frames per second. Default: those of the dataset's registry entry, or else what the files say.
        action: Fields that make up the action, such as action/joints action/gripper or action[:7]. Default: those of
            the registry entry, or else the field `action`, or all of action/* except flags that end an episode.
        state: Fields that make up observation.state. Default: observation/state or observation/proprio.
        skip_damaged: Leave out damaged episodes and count them, instead of stopping.
        registry: TOML file with your own registry entries.
    """
    from data_pipelines.export.fields import choose_fields
    from data_pipelines.export.lerobot import export_lerobot
    from data_pipelines.sources.open import open_source
    from data_pipelines.sources.source import same_rate

    require_local("--out", out)
    require(hz is None or 0 < hz < math.inf, f"--hz must be positive and finite, got {hz}")
    use_entries(registry)
    opened = open_source(source, split, corrupt="skip" if skip_damaged else "raise", max_skipped=sys.maxsize)
    entry = find_reader(opened.name)
    rate = hz or (entry.hz if entry else opened.hz)
    require(rate is not None, f"{source}: its files do not say how many frames a second it has; give --hz")
    if hz is None and opened.hz is not None and not same_rate(opened.hz, rate):
        say(f"note: its files say {opened.hz:g} Hz, but its registry entry {rate:g} Hz, which is used; --hz is another")
    fields = choose_fields(opened, action or (entry.action_keys if entry else ()), state)
    with step(f"write {counted(len(opened), 'episode')} of {opened.name}") as update:
        try:
            done = export_lerobot(opened, fields, out, rate, progress=update)
        except EpisodeError as error:
            raise DataError(f"{without_advice(str(error))} Add --skip-damaged to leave it out.") from error
    say(f"{counted(done.episodes, 'episode')}, {counted(done.frames, 'frame')} at {rate:g} Hz")
    if done.left_out:
        say(f"left out {counted(done.left_out, 'damaged episode')}")
    for name, keys in fields.vectors.items():
        say(
            f"{name}: {counted(len(fields.names[name]), 'value')} of {', '.join(key.removeprefix('steps/') for key in keys)}"
        )
    if "observation.state" not in fields.vectors:
        say("note: there is no observation.state, which some policies of LeRobot need; --state names its fields")
    wrote(out, then=command("data inspect", out))
